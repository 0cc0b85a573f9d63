"""Thousands of random starts at the parameters of Section IV, and starts close to singularities."""

from __future__ import annotations

import math
from collections import Counter
from itertools import product

import pytest
from msgspec.structs import replace

from compose.launch import in_process
from compose.scenario import scenario_file, shipped_files
from compose.scenario.scenario_file import load, parse
from protocol.messages import Localised
from tests.commands import SECTION_IV
from tests.missions import outcome
from tests.series import series
from world.referee import errors
from world.scenario import Scenario

STARTS = 2000
SHARES, OF_PAPER = 10, 4
"""The numbers of tests among which the starts are divided, for parallel execution."""


def started(seed: int, planner_name: str) -> Scenario:
    text = shipped_files.shipped()["random"].read_text()
    return scenario_file.parse(f'{text}\n[planner]\nname = "{planner_name}"\n', "random", seed=seed)


def share(number: int, shares: int) -> range:
    return range(number * STARTS // shares, (number + 1) * STARTS // shares)


def assert_localised(scenario: Scenario) -> None:
    recording = in_process.run_mission(scenario)
    assert outcome(recording) == "localised", f"seed {scenario.seed}: {recording.end}"
    last = recording.ticks[-1]
    for robot, truth in zip(scenario.robots, last.truth.poses, strict=True):
        verdict = last.commands[robot.id].verdict
        assert isinstance(verdict, Localised)
        assert max(errors(verdict.pose, truth)) < 1e-6, f"seed {scenario.seed}"


@pytest.mark.parametrize("number", series(range(SHARES)))
def test_assured_localises_every_random_start_to_a_micrometre(number: int) -> None:
    for seed in share(number, SHARES):
        assert_localised(started(seed, "assured"))


@pytest.mark.parametrize("number", range(OF_PAPER))
@pytest.mark.long
def test_the_paper_planner_localises_most_random_starts_and_makes_no_wrong_claim(number: int) -> None:
    outcomes = Counter(
        [outcome(in_process.run_mission(started(seed, "paper"))) for seed in share(number, OF_PAPER)]
    )
    # 93 to 95 % of 5000 localise; three standard deviations of 500 of them are 3.2 %
    assert set(outcomes) <= {"localised", "undecided"}
    assert 0.905 <= outcomes["localised"] / outcomes.total() <= 0.975


R = 3.0
RADII = (0.0, 1e-15, 1e-12, 1e-10, 1e-9, 3e-9, 1e-6, 1e-3, 0.5, 2.4, R - 1e-12, R)
OFFSETS = (0.0, *(sign * 10.0**-n for n in (15, 12, 9, 8, 6, 3) for sign in (1, -1)))
HEADINGS = {"outward": 0.0, "inward": math.pi, "tangent left": math.pi / 2, "tangent right": -math.pi / 2}


def with_start(rho0: float, heading: float) -> Scenario:
    """Return a scenario in which a starts on the x-axis, `rho0` m from its anchor."""
    scenario = load("random", seed=11)
    a, b = scenario.robots
    return replace(scenario, robots=(replace(a, start=replace(a.start, x=rho0, y=0.0, heading=heading)), b))


@pytest.mark.parametrize("direction", HEADINGS)
@pytest.mark.parametrize("rho0", series(RADII, 6))
def test_nearly_indistinguishable_starts_localise(rho0: float, direction: str) -> None:
    for offset in OFFSETS:
        assert_localised(with_start(rho0, HEADINGS[direction] + offset))


@pytest.mark.parametrize("angle", ["3.14159265", "3.141592653589793", "0.0", "-3.1415926"])
def test_a_start_straight_towards_the_anchor_as_a_user_types_it_localises(angle: str) -> None:
    text = f'name = "typed"\n{SECTION_IV}'
    for x in ("0.3", "1.0", "1.7", "2.4", "3.0"):
        robots = (
            f'[[robot]]\nid = "a"\nanchor = [0.0, 0.0]\nstart = [{x}, 0.0, {angle}]\n'
            '[[robot]]\nid = "b"\nanchor = [10.0, 0.0]\nstart = [10.0, 1.0, 1.0]\n'
        )
        assert_localised(parse(text + robots, "typed"))


@pytest.mark.parametrize(
    ("sensing_range", "distance", "period", "speed", "turn_rate"),
    [
        *((3.0, 10.0, 1.0, speed, 3.14) for speed in (0.3, 2.0, 2.9, 5.0, 20.0, 100.0)),
        (3.0, 10.0, 1.0, 100.0, 1000.0),
        (3.0, 10.0, 0.05, 1.0, 0.2),
        (3.0, 7.0, 0.5, 1.0, 0.5),
        (1.0, 10.0, 1.0, 1.0, 3.14),
        (5.0, 10.0, 1.0, 1.0, 3.14),
    ],
)
def test_settings_far_from_the_papers_localise(
    sensing_range: float, distance: float, period: float, speed: float, turn_rate: float
) -> None:
    for seed, offset in product(range(5), (0.0, 1e4)):
        text = (
            f'name = "setting"\nseed = {seed}\n[mission]\nsensing_range = {sensing_range}\n'
            f"period = {period}\nmax_speed = {speed}\nmax_turn_rate = {turn_rate}\n"
            f'[[robot]]\nid = "a"\nanchor = [{offset}, {offset}]\n'
            f'[[robot]]\nid = "b"\nanchor = [{offset}, {offset - distance}]\n'
        )
        assert_localised(parse(text, "setting"))
