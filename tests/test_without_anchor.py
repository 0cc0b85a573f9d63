"""The localisation of robots without an anchor from ranges, and the coverage in which they are found."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.resection import RangedPlace, is_certain, is_fixed, poses, positions
from agent.planning import coverage, drive
from agent.planning.state import RobotState
from agent.planning.tasks import Covering, Looping
from compose.scenario.scenario_file import load
from protocol.coverage_strips import SIDE, STRIP_REACH, SweptArea
from protocol.coverage_ticks import way_ticks
from protocol.mission import Mission
from protocol.motion import ORIGIN, Pose, compose, step
from tests.groups import R

FLOOR = 1e-9
"""The rounding error in m of the places in these tests."""
FAR = SIDE * R
SQUARE = [Pose(FAR, 0.0, 0.0), Pose(FAR, FAR, 0.0), Pose(0.0, FAR, 0.0)]
"""The places of a small square, which a robot drives from the origin."""
MISSION = Mission(R, 1.0, 1.0, math.pi)

Ranges = tuple[list[RangedPlace], list[RangedPlace]]


def measured(found: Pose, finder: Pose, error: float = 0.0) -> Ranges:
    """Return the ranges while the finder drives a square, then while the robot that it has found does.

    The finder reports its places with its path scaled by 1 + `error`.
    """

    def ranged(of_finder: Pose, of_found: Pose) -> RangedPlace:
        there, here = compose(finder, of_finder), compose(found, of_found)
        told = compose(finder, Pose((1.0 + error) * of_finder.x, (1.0 + error) * of_finder.y, 0.0))
        return RangedPlace((told.x, told.y), of_found, math.hypot(here.x - there.x, here.y - there.y))

    return [ranged(one, ORIGIN) for one in (ORIGIN, *SQUARE)], [ranged(ORIGIN, one) for one in SQUARE]


ANGLES = st.floats(-math.pi, math.pi)


@given(ANGLES, ANGLES, ANGLES, st.floats(0.05 * R, STRIP_REACH * R))
@example(-2.1953125, 0.0, 3.0, 1.25)  # the other heading leads to it slowly
def test_two_squares_leave_one_pose_which_is_the_true_one(
    own: float, other: float, bearing: float, apart: float
) -> None:
    true = Pose(40.0 + apart * math.cos(bearing), -7.0 + apart * math.sin(bearing), own)
    standing, moved = measured(true, Pose(40.0, -7.0, other))
    found = poses(standing, moved, FLOOR)
    assert is_certain(standing, moved, found)
    assert math.dist((found[0].x, found[0].y), (true.x, true.y)) < 1e-9
    assert abs(math.remainder(found[0].heading - own, math.tau)) < 1e-9


@given(ANGLES, st.floats(0.1 * R, STRIP_REACH * R))
def test_no_pose_explains_the_ranges_to_a_robot_that_scales_its_path(bearing: float, apart: float) -> None:
    true = Pose(apart * math.cos(bearing), apart * math.sin(bearing), 1.0)
    assert poses(*measured(true, ORIGIN, error=0.1), FLOOR) == ()


def test_a_straight_path_leaves_a_mirror_image() -> None:
    standing = [RangedPlace((x, 0.0), ORIGIN, math.hypot(1.0 - x, 2.0)) for x in (0.0, 0.5, 1.5)]
    assert sorted(y for _, y in positions(standing, FLOOR)) == pytest.approx([-2.0, 2.0])


def test_ranges_from_a_line_through_the_robot_do_not_fix_its_position() -> None:
    """A rounding error of the ranges moves it far aside."""
    standing = [RangedPlace((x, 0.0), ORIGIN, 2.0 - x) for x in (0.0, 0.05, 0.1, 0.15)]
    found = positions(standing, FLOOR)
    assert found
    assert not any(is_fixed(standing, place) for place in found)


def test_ranges_along_one_straight_do_not_determine_a_heading_on_the_line_of_sight() -> None:
    standing, _ = measured(Pose(1.0, 0.0, math.pi), ORIGIN)
    moved = [RangedPlace((0.0, 0.0), Pose(x, 0.0, 0.0), 1.0 - x) for x in (0.05, 0.1, 0.15)]
    found = poses(standing, moved, FLOOR)
    assert len(found) == 1
    assert not is_certain(standing, moved, found)


# --- the coverage ----------------------------------------------------------------------------------------

LENGTHS = st.floats(0.0, 40.0)


def driven(places: tuple[tuple[float, float], ...], start: Pose, mission: Mission = MISSION) -> list[Pose]:
    """Return the poses of each tick of a robot that drives to `places`, one after the other."""
    path, config = [start], replace(load("paper-1").config("a"), mission=mission)
    task: Covering | Looping = Covering(places)
    while True:
        state = RobotState(config, odometry=path[-1])
        task = coverage.onward(state, task)
        if not task.places:
            return path
        driven = drive.controls(state.doing(task))
        path.append(step(path[-1], driven.v, driven.omega, mission.period))


@given(LENGTHS, LENGTHS, st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.sampled_from([0.4, 1.0, 20.0]))
def test_a_sweep_comes_near_each_place_of_the_area_in_a_tick(
    wide: float, high: float, x: float, y: float, speed: float
) -> None:
    area = SweptArea(5.0, -3.0, 5.0 + wide, -3.0 + high, 1)
    path = driven(area.path(area.strips_of(0, R), R), Pose(0.0, 0.0, 1.0), Mission(R, 1.0, speed, 0.7))
    place = (5.0 + x * wide, -3.0 + y * high)
    # the robot may be on a square of its own, because another one has passed
    assert min(math.dist((pose.x, pose.y), place) for pose in path) <= STRIP_REACH * R - math.sqrt(2.0) * FAR


@given(LENGTHS, LENGTHS, st.floats(0.1, 7.0), st.floats(0.1, 7.0))
def test_a_sweep_takes_no_more_ticks_than_its_bound(
    wide: float, high: float, speed: float, turn_rate: float
) -> None:
    mission = Mission(R, 1.0, speed, turn_rate)
    area = SweptArea(5.0, -3.0, 5.0 + wide, -3.0 + high, 1)
    places = area.path(area.strips_of(0, R), R)
    path = driven(places, Pose(0.0, 0.0, 1.0), mission)
    assert len(path) - 1 <= way_ticks([(0.0, 0.0), *places], mission)


@pytest.mark.parametrize("parts", [1, 2, 3, 7, 30])
def test_the_strips_are_split_into_parts_without_a_gap(parts: int) -> None:
    area = SweptArea(0.0, 0.0, 30.0, 25.0, parts)
    whole = area.path((0, area.strips(R)), R)
    split = [area.path(area.strips_of(part, R), R) for part in range(parts)]
    assert [place for part in split for place in part] == list(whole)
    assert max(map(len, split)) - min(map(len, split)) <= 2
