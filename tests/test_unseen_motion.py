"""Odometry that deviates: between two poses of it, and where wheels slip."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.fit import Fit, Start, fits
from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.noise_files import AssumedNoise
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
from protocol.noise import Noise
from tests.moving_groups import NOISE, PERIOD_S, MovingGroup, joint_measurements, moving_group

POSE_S, SIGMA, RESTING = 0.1, 0.05, 0.01
PLACES = [(0.0, 0.0), (8.0, 0.3), (7.6, 8.0), (0.2, 7.7)]


def driven(seed: int, duration_s: float) -> Numbers:
    """Return the poses each POSE_S of a robot that drives to random goals; headings are not wrapped."""
    draw = random.Random(seed)
    pose, goal, poses = Pose(4.0, 4.0, 0.0), (2.0, 6.0), []
    turned = 0.0
    for _ in range(round(duration_s / POSE_S) + 1):
        poses.append((pose.x, pose.y, turned))
        if math.dist((pose.x, pose.y), goal) < 0.4:
            goal = draw.uniform(1.0, 7.0), draw.uniform(1.0, 7.0)
        off = wrap(math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.heading)
        v, omega = 0.7 * max(0.1, math.cos(off)), max(-1.2, min(1.2, 1.5 * off))
        pose, turned = step(pose, v, omega, POSE_S), turned + omega * POSE_S
    return np.array(poses)


def times(count: int) -> Numbers:
    """Return so many times in s, POSE_S apart."""
    return np.asarray(POSE_S * np.arange(count), np.float64)


def logged(poses: Numbers, every: int) -> RobotOdometry:
    """Return the odometry of which each so many of the `poses` are in the log."""
    kept, t = poses[::every], times(len(poses))[::every]
    moved = relative(kept[:-1], kept[1:])
    return RobotOdometry(t[:-1], t[1:], moved, np.full((len(moved), 3, 3), np.nan))


def recorded(every: int, seed: int) -> RangeRecording:
    """Return a recording of 100 s with a pose each so many POSE_S, and a range in each."""
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
    t = odometry.t0 + 0.5 * every * POSE_S
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
    end = step(Pose(0.0, 0.0, 0.0), v, omega, POSE_S * ticks)
    moved = np.tile((end.x, end.y, omega * POSE_S * ticks), (29, 1))
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
        unseen_motion(logged(poses, 50), RESTING).sigmas(t - stood * POSE_S),
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
    assert sum(map(is_wrong, estimate().rows)) > 10


SHARE = 0.05


def measured(group: MovingGroup, told: float) -> JointMeasurements:
    return joint_measurements(group.facts, replace(NOISE, odometry_strays=told), PERIOD_S)


def fit_of(group: MovingGroup, of: JointMeasurements) -> Fit:
    starts = group.starts.copy()
    starts[:, :2] -= of.origin
    (fit,) = fits(of, [Start(starts)])
    return fit


def ended(seed: int, simulated: float, told: float) -> tuple[list[float], float]:
    """Return the NEES of two robots after 60 ticks, and the root of the trace of their covariance."""
    group = moving_group(2, seed, ticks=60, noise=replace(NOISE, odometry_strays=simulated))
    of = measured(group, told)
    fit = fit_of(group, of)
    off = fit.poses - (group.ends - (*of.origin, 0.0))
    off[:, 2] = [wrap(one) for one in off[:, 2]]
    own = [fit.covariance[k : k + 3, k : k + 3] for k in (0, 3)]
    nees = [float(one @ np.linalg.solve(c, one)) for one, c in zip(off, own, strict=True)]
    assert fit.last_step < FINISHED
    return nees, math.sqrt(np.trace(fit.covariance))


def test_pairs_with_strays_know_their_poses_within_their_sigmas_only_if_they_are_told() -> None:
    untold, told = (np.array([ended(seed, SHARE, one)[0] for seed in range(60)]) for one in (0.0, SHARE))
    assert np.mean(untold) > 5.5
    assert np.mean(told) < 4.3
    beyond = 16.27  # 0.1 % of chi-square
    assert np.mean(told > beyond) <= 0.01
    assert np.mean(untold > beyond) > 0.05


def test_pairs_that_are_told_of_strays_and_have_none_are_about_as_sure() -> None:
    untold, told = ([ended(seed, 0.0, one) for seed in range(40)] for one in (0.0, 0.02))
    assert 2.0 < np.mean([nees for nees, _ in told]) < 3.3
    assert 1.0 < np.mean([sigma for _, sigma in told]) / np.mean([sigma for _, sigma in untold]) < 1.06


def test_a_stray_has_the_noise_of_one_about_its_tick_and_nowhere_else() -> None:
    group = moving_group(2, 3, ticks=60)
    of = measured(group, 0.02)
    omega = of.paths[0].omega.copy()
    omega[25] += 0.3
    strange = replace(of, paths=(of.paths[0]._replace(omega=omega), of.paths[1]))
    fit = fit_of(group, strange)
    kernel = fit.linear.kernel.of
    share = (kernel.white - fit.problem.measured.white)[:, 1] / (kernel.stray - fit.problem.measured.white)[
        :, 1
    ]
    robot, tick = np.nonzero(share > 0.3)
    assert set(robot) == {0}
    assert np.all(np.abs(tick - 25) <= 1), "a neighbour explains the same ranges"
    assert abs(np.sum(fit.start.errors[0].omega[22:29]) + 0.3) < 0.1
    (blind,) = fits(replace(strange, noise=NOISE), [Start(fit.start.poses)])
    assert fit.weight > blind.weight + 5.0, "the evidence contains the strays"


def test_without_a_prior_nothing_is_computed_of_strays() -> None:
    group = moving_group(2, 1)
    fit = fit_of(group, measured(group, 0.0))
    assert fit.linear.step.shocks.size == 0
    assert fit.linear.kernel is fit.problem.kernel


def test_strays_are_noise() -> None:
    assert not Noise(odometry_strays=0.01).exact
    assert Noise(odometry_strays=0.01).as_told.exact


def test_the_rate_of_a_recording_is_that_of_its_increments_whatever_the_step_of_a_fit() -> None:
    assumed = AssumedNoise("told", Noise(odometry_strays=0.04))
    assert assumed.of_fit(4.0).odometry_strays == 0.01
    assert assumed.of_fit(0.5).odometry_strays == 0.04
