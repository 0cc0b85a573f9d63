"""Two robots that range each other keep the safety distance under every remaining hypothesis."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.planning import separation
from compose.audit.claim_rules import distance
from compose.launch.in_process import run_mission
from compose.recording.closest_approach import nearest
from compose.scenario.scenario_file import load, validate
from protocol.motion import Controls, Pose, step
from tests.commands import tandem
from tests.missions import outcome
from tests.series import series
from world.scenario import Scenario

SAFE = 1.0
NEAR = 75
"""The seed of a random mission in which b's last manoeuvre ends 0.75 m from a without a safety distance."""


def safe(seed: int, distance: float = SAFE, **noise: float) -> Scenario:
    scenario = load("random", seed=seed)
    mission = scenario.mission
    return replace(
        scenario,
        mission=replace(mission, safety_distance=distance, noise=replace(mission.noise, **noise)),
    )


speeds = st.floats(-1.0, 1.0)
turns = st.floats(-math.pi, math.pi)
places = st.floats(-2.0, 2.0)


@given(speeds, turns, turns, places, places)
def test_the_bound_on_the_distance_of_an_arc_is_safe_and_tight(
    v: float, omega: float, heading: float, x: float, y: float
) -> None:
    pose = Pose(0.3, -0.2, heading)
    told = float(separation.nearest(pose, np.array([v]), np.array([omega]), (x, y), 1.0)[0])
    way = [step(pose, v, omega, i / 2000) for i in range(2001)]
    true = min(math.hypot(at.x - x, at.y - y) for at in way)
    assert told <= true + 1e-12
    assert told >= true - 0.005


@given(speeds, turns, st.floats(0.0, 2.0))
def test_a_robot_goes_the_same_arc_only_not_so_far(v: float, omega: float, metres: float) -> None:
    mission = load("random").mission
    slowed = separation.slowed(Controls(v, omega), metres, mission)
    assert abs(slowed.v) * mission.period <= max(metres, 0.0) + 1e-12
    assert slowed.v * omega == pytest.approx(slowed.omega * v, abs=1e-12)
    if abs(v) * mission.period <= metres:
        assert slowed == Controls(v, omega)


def test_robots_that_may_come_near_do() -> None:
    recording = run_mission(load("random", seed=NEAR))
    found = nearest(recording)
    assert found is not None
    assert found < 0.8


@pytest.mark.parametrize("seed", series([NEAR, *range(1, 40)], 10))
def test_none_comes_nearer_and_both_localise(seed: int) -> None:
    recording = run_mission(safe(seed))
    assert outcome(recording) == "localised"
    found = nearest(recording)
    assert found is not None
    assert found >= SAFE


@pytest.mark.parametrize("seed", series(range(1, 9), 2))
def test_none_comes_nearer_under_noise(seed: int) -> None:
    recording = run_mission(safe(seed, anchor_sigma=0.05, mutual_sigma=0.05))
    assert outcome(recording) == "localised"
    found = nearest(recording)
    assert found is not None
    assert found >= SAFE


def test_what_ranges_cannot_tell_is_no_violation() -> None:
    mission = load("noisy", seed=196).mission
    recording = run_mission(replace(load("noisy", seed=196), mission=replace(mission, safety_distance=0.3)))
    found = nearest(recording)
    assert found is not None
    assert 0.3 - 3.0 * mission.noise.mutual_sigma < found < 0.3
    assert not any(distance(recording))


@settings(max_examples=20)
@given(st.integers(1, 10**6), st.floats(0.0, 0.9), st.integers(0, 8))
def test_none_comes_nearer_however_many_reports_are_lost_or_late(seed: int, loss: float, least: int) -> None:
    faults = [f"a<->b: loss={loss:.3f}", f"b->a: delay={least}..{least + 3}"]
    scenario = load("random", seed=seed, faults=faults)
    recording = run_mission(replace(scenario, mission=replace(scenario.mission, safety_distance=SAFE)))
    assert outcome(recording) == "localised"
    found = nearest(recording)
    assert found is not None
    assert found >= SAFE


@pytest.mark.parametrize("seed", range(1, 30))
def test_robots_that_begin_in_range_of_each_other_come_no_nearer_than_that(seed: int) -> None:
    table = {
        "name": "near",
        "mission": {
            "sensing_range": 3.0,
            "period": 1.0,
            "max_speed": 1.0,
            "max_turn_rate": math.pi,
            "safety_distance": SAFE,
        },
        "robot": [{"id": "a", "anchor": [0.0, 0.0]}, {"id": "b", "anchor": [3.0, 0.0]}],
        "max_ticks": 60,
    }
    recording = run_mission(validate(table, "near.toml").seeded(seed))
    assert outcome(recording) in ("localised", "undecided")
    a, b = recording.ticks[0].truth.poses
    found = nearest(recording)
    assert found is not None
    assert found >= min(SAFE, math.hypot(a.x - b.x, a.y - b.y)) - 1e-9


def test_the_paper_planner_keeps_the_safety_distance_or_gives_up() -> None:
    outcomes = set()
    for seed in range(1, 40):
        recording = run_mission(replace(safe(seed), planner_name="paper"))
        assert recording.end is not None
        outcomes.add(recording.end.outcome)
        found = nearest(recording)
        assert found is None or found >= SAFE
    assert outcomes <= {"localised", "undecided"}
    assert "localised" in outcomes


def test_a_safety_distance_above_that_at_first_contact_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "safe.toml"
    text = (Path("compose/scenario/shipped") / "random.toml").read_text()
    file.write_text(text.replace("[mission]", "[mission]\nsafety_distance = 1.01"))
    ended = tandem("run", file)
    assert ended.status == 2
    assert ended.err == (
        f"tandem run: {file}: mission.safety_distance: 1.01 m, but robots that approach each other at "
        "max_speed may be 1 m apart at their first contact (sensing_range - 2 max_speed period)\n"
    )
