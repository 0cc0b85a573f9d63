"""Between two poses of its odometry, a robot may be anywhere near the arc that joins them."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.following import ClaimRule
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_recording import (
    FixedAnchor,
    Numbers,
    RangeRecording,
    RangeSeries,
    RecordedRobot,
    RobotOdometry,
    TruePath,
)
from compose.recording.ranging.range_steps import relative, within
from compose.recording.ranging.unseen_motion import UnseenMotion, unseen_motion
from docs.recorded_windows import is_wrong
from protocol.motion import Pose, step, wrap

PERIOD_S, SIGMA, RESTING = 0.1, 0.05, 0.01
PLACES = [(0.0, 0.0), (8.0, 0.3), (7.6, 8.0), (0.2, 7.7)]


def driven(seed: int, duration_s: float) -> Numbers:
    """Return the poses each PERIOD_S of a robot that drives to random goals; headings are not wrapped."""
    draw = random.Random(seed)
    pose, goal, poses = Pose(4.0, 4.0, 0.0), (2.0, 6.0), []
    turned = 0.0
    for _ in range(round(duration_s / PERIOD_S) + 1):
        poses.append((pose.x, pose.y, turned))
        if math.dist((pose.x, pose.y), goal) < 0.4:
            goal = draw.uniform(1.0, 7.0), draw.uniform(1.0, 7.0)
        off = wrap(math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.heading)
        v, omega = 0.7 * max(0.1, math.cos(off)), max(-1.2, min(1.2, 1.5 * off))
        pose, turned = step(pose, v, omega, PERIOD_S), turned + omega * PERIOD_S
    return np.array(poses)


def times(count: int) -> Numbers:
    """Return so many times in s, PERIOD_S apart."""
    return np.asarray(PERIOD_S * np.arange(count), np.float64)


def logged(poses: Numbers, every: int) -> RobotOdometry:
    """Return the odometry of which each so many of the `poses` are in the log."""
    kept, t = poses[::every], times(len(poses))[::every]
    moved = relative(kept[:-1], kept[1:])
    return RobotOdometry(t[:-1], t[1:], moved, np.full((len(moved), 3, 3), np.nan))


def recorded(every: int, seed: int) -> RangeRecording:
    """Return a recording of 100 s with a pose each so many PERIOD_S, and a range in each."""
    poses, draw = driven(seed, 100.0), np.random.default_rng(seed)
    t = times(len(poses))
    anchors = np.arange(len(t)) % len(PLACES)
    measured = np.hypot(*(poses[:, :2] - np.array(PLACES)[anchors]).T) + draw.normal(0.0, SIGMA, len(t))
    ranges = RangeSeries(t, np.zeros(len(t), np.intp), anchors + 1, measured, np.full(len(t), np.nan))
    robot = RecordedRobot("r", logged(poses, every), truth=TruePath(t, poses))
    places = tuple([FixedAnchor(str(i), *place) for i, place in enumerate(PLACES)])
    return RangeRecording("it", (robot,), places, ranges)


@pytest.mark.parametrize("every", [2, 10, 50])
def test_the_motion_between_poses_deviates_as_the_odometry_says(every: int) -> None:
    poses = driven(1, 2000.0)
    odometry = logged(poses, every)
    t = odometry.t0 + 0.5 * every * PERIOD_S
    middle = poses[every // 2 :: every][: len(t)]
    arc = within(odometry.increments, np.full(len(t), 0.5))
    off = relative(poses[:-1:every], middle) - arc
    x, y, heading = np.sqrt(np.mean(np.square(off), axis=0)).tolist()
    along, turn = unseen_motion(odometry, RESTING).sigmas(t)[-1].tolist()
    assert 0.8 < along / math.hypot(x, y) * math.sqrt(2.0) < 3.0
    assert 0.8 < turn / heading < 3.0


@given(st.floats(-2.0, 2.0), st.floats(-0.35, 0.35), st.integers(1, 20))
def test_where_a_robot_drives_one_arc_nothing_is_unseen(v: float, omega: float, ticks: int) -> None:
    """Windows of up to four increments turn by less than half a turn: beyond it, there are several arcs."""
    t = ticks * times(30)
    end = step(Pose(0.0, 0.0, 0.0), v, omega, PERIOD_S * ticks)
    moved = np.tile((end.x, end.y, omega * PERIOD_S * ticks), (29, 1))
    odometry = RobotOdometry(t[:-1], t[1:], moved, np.zeros((29, 3, 3)))
    assert np.all(unseen_motion(odometry, RESTING).sigmas(np.linspace(t[8], t[-1], 100)) < 1e-6)


@given(st.integers(3, 60), st.sampled_from([1, 7, 20]))
def test_what_is_unseen_is_known_by_what_came_before(kept: int, every: int) -> None:
    odometry = logged(driven(1, 120.0), every)
    early = RobotOdometry(*[column[:kept] for column in odometry])
    t = np.linspace(0.0, early.t1[-1], 50)[:-1]
    assert np.array_equal(unseen_motion(early, RESTING).sigmas(t), unseen_motion(odometry, RESTING).sigmas(t))


@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_that_a_robot_stood_tells_nothing_of_its_motion(jitter: float) -> None:
    poses, stood = driven(1, 100.0), 3000
    noise = np.random.default_rng(1).normal(0.0, jitter, (stood, 3))
    after = logged(np.concatenate((poses[0] + noise, poses)), 50)
    t = after.t0[stood // 50 + 4 :] + 2.0
    found, alone = (
        unseen_motion(after, RESTING).sigmas(t),
        unseen_motion(logged(poses, 50), RESTING).sigmas(t - stood * PERIOD_S),
    )
    assert np.all(found > 0.7 * alone)
    assert np.max(unseen_motion(after, RESTING).sigmas(after.t0[8 : stood // 50] + 2.0)) <= 10.0 * jitter


def test_a_pose_of_the_log_is_known() -> None:
    odometry = logged(driven(1, 60.0), 50)
    known = unseen_motion(odometry, RESTING)
    assert np.all(known.sigmas(np.append(odometry.t0, odometry.t1)) == 0.0)
    assert np.all(known.sigmas(odometry.t0 + 1.0) > 0.1)


def test_with_a_pose_each_5_s_claims_wait_for_it_and_are_right(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded(50, 3)

    def estimate() -> RecordingEstimate:
        return estimated(measurements(recording, None, "uwb"), ClaimRule())

    found = estimate()
    claims = [row for row in found.rows if row.claim]
    assert len(claims) > 10
    assert not any(map(is_wrong, claims))
    why = [epoch.blocking_reason for epoch in found.epochs]
    assert any(one.startswith("r: between two poses of its odometry, it may be ") for one in why)
    monkeypatch.setattr(UnseenMotion, "sigmas", lambda _, t: np.zeros((len(t), 2)))
    assert sum(map(is_wrong, [row for row in estimate().rows if row.claim])) > 10
