"""Ranges that are stamped late: simulated, told to the robots, learned, and noticed where nobody tells it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from agent.estimation.following import ClaimRule
from compose.launch.in_process import run_mission
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import (
    FixedAnchor,
    RangeRecording,
    RangeSeries,
    RecordedRobot,
    RobotOdometry,
    TruePath,
)
from compose.recording.ranging.range_steps import relative
from compose.scenario.scenario_file import parse
from protocol.motion import Controls, Pose, step
from tests.missions import own_ranges
from tests.test_world_noise import near
from world.sensors import mutual_ranges
from world.tick import release

LATE = Path(__file__).parent / "data" / "cases" / "late-ranges"
"""One robot that drives 1 m/s among three anchors; its ranges are 0.3 s late, and have a sigma of 0.05 m."""
DELAY_S = 0.3
CONTRADICTION = "the ranges and the odometry contradict the assumed noise; the profile 'uwb' explains them"


# --- the world --------------------------------------------------------------------------------------------


def test_late_ranges_are_those_of_the_poses_before() -> None:
    told = "anchor_sigma = 0.0\nmutual_sigma = 0.0\ngyro_bias = 0.1"
    late, prompt = near(f"range_delay = {DELAY_S}", told=told), near("", told=told)
    still = release(late).truth
    assert own_ranges(still, late) == own_ranges(still, prompt), "the robots were at rest before"
    driven = Controls(0.3, 0.8), Controls(-0.2, 0.4)
    moved = still.moved(driven, 1.0)
    places = zip(still.local, driven, strict=True)
    early = [step(pose, one.v, one.omega, 1.0 - DELAY_S) for pose, one in places]
    for i, rho in enumerate(own_ranges(moved, late)):
        anchor, origin = late.robots[i].anchor, still.origins[i]
        assert rho == pytest.approx(apart(early[i], Pose(anchor.x - origin.x, anchor.y - origin.y, 0.0)))
    (contact,) = mutual_ranges(moved, late, [(0, 1)])
    assert contact is not None
    assert contact.range == pytest.approx(apart(*early))


def apart(one: Pose, other: Pose) -> float:
    """Return the distance of two poses in m."""
    return math.hypot(one.x - other.x, one.y - other.y)


RANDOM = """
name = "late"
seed = {seed}
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.14159
accuracy = 0.1
[mission.noise]
anchor_sigma = 0.05
mutual_sigma = 0.05
range_delay = {told}
[world.noise]
range_delay = 0.3
[[robot]]
id = "a"
anchor = [0.0, 0.0]
[[robot]]
id = "b"
anchor = [10.0, 0.0]
"""


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_robots_that_are_told_of_a_delay_localise_and_others_do_not_claim(seed: int) -> None:
    for told, outcome in ((0.3, "localised"), (0.0, "undecided")):
        end = run_mission(parse(RANDOM.format(seed=seed, told=told), "late")).end
        assert end is not None
        assert end.outcome == outcome


# --- recordings -------------------------------------------------------------------------------------------


def estimate_of(recording: RangeRecording, noise: str | None, seconds: float = 60.0) -> RecordingEstimate:
    return estimated(measurements(recording, None, noise, (0.0, seconds)), ClaimRule())


def is_wrong(row: PoseEstimateRow) -> bool:
    """Return whether a pose is off by more than 5 sigmas along an axis, or in heading."""
    assert row.position_error_m is not None
    assert row.heading_error_rad is not None
    sigmas = math.sqrt(0.5 * (row.xx + row.yy)), math.sqrt(row.hh)
    errors = row.position_error_m, abs(row.heading_error_rad)
    return any(error > max(1e-6, 5.0 * sigma) for error, sigma in zip(errors, sigmas, strict=True))


@pytest.mark.long
@pytest.mark.parametrize(("noise", "wrong", "least"), [(None, 2, 105), ("uwb", 0, 50)])
def test_late_ranges_are_learned_and_hardly_a_claim_is_wrong(
    noise: str | None, wrong: int, least: int
) -> None:
    """With `uwb`, the biases that radios may have leave half of the poses less accurate than 0.3 m."""
    found = estimate_of(read_ranges(LATE), noise)
    claims = [row for row in found.rows if row.claim]
    assert len(claims) >= least
    assert sum(map(is_wrong, claims)) <= wrong
    learned = found.summary.calibration
    assert learned is not None
    assert learned.range_delay_s is not None
    assert abs(learned.range_delay_s.value - DELAY_S) < 2.0 * learned.range_delay_s.sigma < 0.1


def test_late_ranges_contradict_a_profile_without_a_delay() -> None:
    found = estimate_of(read_ranges(LATE), "uwb-calibrated", 20.0)
    assert CONTRADICTION in found.summary.blocking_reason
    assert found.summary.blocking_reason.endswith("try --noise uwb, or calibrate the sensors")


def late_pair() -> RangeRecording:
    """Return a recording of two robots with an anchor each, at 1 m/s, whose ranges are 0.4 s late."""
    t, draws = 0.02 * np.arange(2001.0), np.random.default_rng(1)
    robots, places = [], []
    for name, begin, rate in (("A", 2.0 + 1.0j, 0.7), ("B", 6.0 + 3.0j, -0.6)):
        turn = rate * 0.02 * np.where(np.sin(0.3 * t[:-1]) > -0.5, 1.0, -1.0)
        heading = np.append(0.0, np.cumsum(turn))
        place = begin + np.append(0.0, np.cumsum(0.02 * np.exp(1j * (heading[:-1] + 0.5 * turn))))
        poses = np.stack((place.real, place.imag, heading), 1)
        odometry = RobotOdometry(
            t[:-1], t[1:], relative(poses[:-1], poses[1:]), np.full((2000, 3, 3), np.nan)
        )
        robots.append(RecordedRobot(name, odometry, TruePath(t, poses)))
        places.append(place)
    anchors = FixedAnchor("M1", 0.0, 0.0), FixedAnchor("M2", 9.0, 2.0)
    at = np.arange(25, 2001, 25)
    a, b = places[0][at - 20], places[1][at - 20]
    lengths = np.stack((np.abs(a), np.abs(b - (9.0 + 2.0j)), np.abs(a - b)), 1).ravel()
    lengths += 0.05 * draws.normal(size=len(lengths))
    first, second = (np.tile(np.array(one), len(at)) for one in ((0, 1, 0), (2, 3, 1)))
    series = RangeSeries(np.repeat(t[at], 3), first, second, lengths, np.full(len(lengths), 0.05))
    return RangeRecording("late", tuple(robots), anchors, series)


@pytest.mark.long
def test_a_delay_is_learned_from_two_robots_and_noticed_where_none_is_told() -> None:
    recording = late_pair()
    learned = estimate_of(recording, "uwb").summary.calibration
    assert learned is not None
    assert learned.range_delay_s is not None
    assert abs(learned.range_delay_s.value - 0.4) < 4.0 * learned.range_delay_s.sigma < 0.2
    told = estimate_of(recording, "wheels")
    noticed = [epoch.t for epoch in told.epochs if CONTRADICTION in epoch.blocking_reason]
    assert noticed[0] < 20.0
    assert not any(is_wrong(row) for row in told.rows if row.claim and row.t_s >= noticed[0])
