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
