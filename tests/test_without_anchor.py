"""The parts of the localisation of robots without an anchor: facts, resection and the sweep of an area."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest
from agent.estimation.host_pose import host_estimate
from agent.peer.facts import TO_ROBOT, Fact, FactSet, facts_of
from compose.scenario.sweep_strips import STEP, split, strips, sweep_time
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.resection import RangedPlace, is_certain, poses, positions
from compose.errors import BadScenario
from compose.launch.in_process import run_mission
from compose.recording.run import Run, read
from compose.scenario.scenario_file import validate
from protocol.messages import Inconsistent, Localised, Report, RobotConfig
from protocol.mission import Mission
from protocol.motion import ORIGIN, Pose, compose
from tests.groups import R, group_of, table_of

MISSION = Mission(R, 1.0, 1.0, math.pi)
FLOOR = 1e-9
"""The rounding error in m of the places in these tests."""
SIDE = 0.1 * R
SQUARE = [Pose(SIDE, 0.0, 0.0), Pose(SIDE, SIDE, 0.0), Pose(0.0, SIDE, 0.0)]
"""The places of a small square, which a robot drives from the origin."""


def measured(guest: Pose, host: Pose, error: float = 0.0) -> tuple[list[RangedPlace], list[RangedPlace]]:
    """Return the ranges while the host drives a square and the guest stands, then while the guest drives one.

    The host reports its places with its path scaled by 1 + `error`.
    """

    def ranged(of_host: Pose, of_guest: Pose) -> RangedPlace:
        there, here = compose(host, of_host), compose(guest, of_guest)
        told = compose(host, Pose((1.0 + error) * of_host.x, (1.0 + error) * of_host.y, 0.0))
        return RangedPlace((told.x, told.y), of_guest, math.hypot(here.x - there.x, here.y - there.y))

    return [ranged(one, ORIGIN) for one in (ORIGIN, *SQUARE)], [ranged(ORIGIN, one) for one in SQUARE]


ANGLES = st.floats(-math.pi, math.pi)


@given(ANGLES, ANGLES, ANGLES, st.floats(0.05 * R, 0.85 * R))
def test_two_squares_leave_one_pose_which_is_the_true_one(
    own: float, other: float, bearing: float, apart: float
) -> None:
    guest = Pose(40.0 + apart * math.cos(bearing), -7.0 + apart * math.sin(bearing), own)
    standing, moved = measured(guest, Pose(40.0, -7.0, other))
    found = poses(standing, moved, FLOOR)
    assert is_certain(standing, moved, found)
    assert math.dist((found[0].x, found[0].y), (guest.x, guest.y)) < 1e-6
    assert abs(math.remainder(found[0].heading - own, math.tau)) < 1e-6


@given(ANGLES, st.floats(0.1 * R, 0.85 * R))
def test_no_pose_explains_the_ranges_to_a_robot_that_scales_its_path(bearing: float, apart: float) -> None:
    guest = Pose(apart * math.cos(bearing), apart * math.sin(bearing), 1.0)
    assert poses(*measured(guest, ORIGIN, error=0.1), FLOOR) == ()


def test_a_straight_path_leaves_a_mirror_image() -> None:
    standing = [RangedPlace((x, 0.0), ORIGIN, math.hypot(1.0 - x, 2.0)) for x in (0.0, 0.5, 1.5)]
    assert sorted(y for _, y in positions(standing, FLOOR)) == pytest.approx([-2.0, 2.0])


def facts_of_run(run: Run) -> FactSet:
    return facts_of([one for tick in run.observations for one in tick.values()])


def test_facts_in_any_order_and_echoed_round_a_ring_give_the_same_bits() -> None:
    known = facts_of_run(run_mission(group_of(3, 1)))
    expected = [known.log("r0"), known.log("r1"), known.ranges("r0", f"{TO_ROBOT}r1")]
    single = [FactSet(frozenset([one])) for one in sorted(known.facts)]
    for order in range(100):
        random.Random(order).shuffle(single)
        gathered = FactSet()
        for one in single:
            gathered = gathered.merged(one)
        assert gathered == known
        assert [gathered.log("r0"), gathered.log("r1"), gathered.ranges("r0", f"{TO_ROBOT}r1")] == expected
    ring = [FactSet(frozenset(sorted(known.facts)[i::4])) for i in range(4)]
    for step in range(1000):
        ring[(step + 1) % 4] = ring[(step + 1) % 4].merged(ring[step % 4])
    assert ring == [known] * 4
    assert [ring[2].log("r0"), ring[2].log("r1"), ring[2].ranges("r0", f"{TO_ROBOT}r1")] == expected


def helper_of(run: Run) -> tuple[RobotConfig, tuple[Pose, Pose], int]:
    """Return the first visitor, the starts that it and its peer have reported, and the tick of its claim."""
    meeting = run.scenario.meetings[0]
    starts = [
        next(
            framed.report.start
            for step in run.agents[robot].steps
            for framed in step.reports
            if isinstance(framed.report, Report) and framed.report.start is not None
        )
        for robot in (meeting.visitor, meeting.visited)
    ]
    claim = run.claim(meeting.visitor)
    assert claim is not None
    return run.scenario.config(meeting.visitor), (starts[0], starts[1]), claim.tick


def test_the_pose_of_a_helper_follows_from_two_logs_to_the_bit_in_any_order(tmp_path: Path) -> None:
    run_mission(group_of(3, 1), tmp_path)
    run = read(tmp_path)
    config, starts, tick = helper_of(run)
    known = facts_of_run(run)
    found = host_estimate(known, config, starts, tick)
    assert found is not None
    assert isinstance(found.verdict, Localised)
    true = run.truth(config.robot)[tick]
    assert math.dist((found.verdict.pose.x, found.verdict.pose.y), (true.x, true.y)) < 1e-6
    assert abs(math.remainder(found.verdict.pose.heading - true.heading, math.tau)) < 1e-6
    single = [FactSet(frozenset([one])) for one in sorted(known.facts)]
    for order in range(100):
        random.Random(order).shuffle(single)
        gathered = FactSet()
        for one in single:
            gathered = gathered.merged(one)
        assert host_estimate(gathered, config, starts, tick) == found


def test_the_facts_of_a_helper_that_scales_its_path_are_inconsistent(tmp_path: Path) -> None:
    run_mission(group_of(3, 1), tmp_path)
    run = read(tmp_path)
    config, starts, tick = helper_of(run)
    forged = [
        replace(one, values=(1.05 * one.values[0], one.values[1]))
        if one.robot == config.robot and one.kind == "drove"
        else one
        for one in facts_of_run(run).facts
    ]
    found = host_estimate(FactSet(frozenset(forged)), config, starts, tick)
    assert found is not None
    assert isinstance(found.verdict, Inconsistent)


def test_a_robot_that_reports_two_values_of_one_measurement_is_found_in_any_order() -> None:
    one = FactSet(frozenset([Fact("a", 3, "drove", (1.0, 0.0)), Fact("b", 3, "drove", (1.0, 0.0))]))
    other = FactSet(frozenset([Fact("a", 3, "drove", (0.9, 0.0))]))
    assert one.merged(other).contradictory() == other.merged(one).contradictory() == {"a"}


def test_a_log_ends_at_the_first_tick_that_is_missing() -> None:
    known = FactSet(frozenset([Fact("a", tick, "drove", (1.0, 0.0)) for tick in (1, 2, 4)]))
    assert known.log("a").through == 2


LENGTHS = st.floats(0.1, 40.0)


@given(LENGTHS, LENGTHS, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_sweep_measures_each_robot_of_the_area_in_two_ticks(
    wide: float, high: float, x: float, y: float
) -> None:
    place = (5.0 + x * wide, -3.0 + y * high)
    swept: set[tuple[float, float]] = set()
    for strip in strips((5.0, -3.0, 5.0 + wide, -3.0 + high), R):
        (x0, y0), (x1, y1) = strip.start, strip.end
        steps = math.ceil(strip.length / (STEP * R))
        for i in range(steps + 1):
            share = min(1.0, i * STEP * R / strip.length)
            swept.add((x0 + share * (x1 - x0), y0 + share * (y1 - y0)))
    assert sum(math.dist(one, place) <= R for one in swept) >= 2


@pytest.mark.parametrize("sweepers", [1, 2, 3, 7])
def test_the_strips_are_split_without_a_gap(sweepers: int) -> None:
    swept = strips((0.0, 0.0, 30.0, 25.0), R)
    parts = split(swept, sweepers)
    assert [strip for part in parts for strip in part] == list(swept)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert max(sweep_time(part, MISSION) for part in parts) <= sweep_time(swept, MISSION)


def test_a_robot_without_an_anchor_is_refused_in_one_line() -> None:
    table = table_of(4, 1)
    del table["robot"][2]["anchor"]
    with pytest.raises(BadScenario, match=r"group.toml: robot\[2\]: missing field 'anchor'$"):
        validate(table, "group.toml")
