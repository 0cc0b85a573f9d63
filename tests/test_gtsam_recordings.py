"""The estimate of recorded robots is the optimum of the complete factor graph, computed by gtsam.

Five windows of recorded UWB ranges are estimated with a noise profile. The graph shares the model with the
estimator, but no code of it: all poses and manoeuvres, the scale and bias of each robot's odometry, and the
errors that the ranges have in common. A range that may be an outlier has the weight that the fit gave it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from agent.estimation.fit import Fit
from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_files import read_ranges
from protocol.motion import Pose, step
from tests.range_tables import SAMPLE

pytest.importorskip("gtsam", reason="gtsam has no wheel for this platform or this Python")
import gtsam

from tests.factor_graph import (
    Array,
    Optimum,
    arc,
    manoeuvre_of,
    nudged,
    optimum,
    optimum_at,
    pose_of,
    wrapped,
)
from tests.pair_starts import kinds, m2

pytestmark = pytest.mark.long

WINDOWS = 5
LENGTH_S, APART_S = 20.0, 2.0
"""The length of a window, and the time in s from the beginning of one to that of the next."""
PROFILE = "uwb-calibrated"
MORE = 1.001
AGREED = 0.01
"""The maximum difference of a pose from gtsam's in standard deviations, and of a standard deviation."""


def constants_of(robot: int) -> int:
    """Return the key of the constant errors of a robot's odometry, in their sigmas."""
    return int(gtsam.symbol("cd"[robot], 0))


COMMON, SLOW = int(gtsam.symbol("e", 0)), int(gtsam.symbol("u", 0))
"""The keys of the constant errors of the ranges, in their sigmas, and of the slow ones, in m."""


def odometry(robot: int, tick: int, told: Array, effects: Array, sigmas: Array) -> gtsam.NoiseModelFactor:
    """Return the factor of the measured v and omega over a tick; `effects` are those of constant errors."""
    white = gtsam.noiseModel.Constrained.MixedSigmas(1.0, sigmas)  # a sigma of 0 makes it a constraint
    keys = [manoeuvre_of(robot, tick), constants_of(robot)]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.eye(2), -effects.T
        off = values.atPoint2(keys[0]) - told - effects.T @ values.atVector(keys[1])
        return np.asarray(off)

    return gtsam.CustomFactor(white, keys, error)


def measured_range(
    ends: list[tuple[int, Array | None]], rho: float, common: Array, row: int, sigma: float, *, slow: bool
) -> gtsam.NoiseModelFactor:
    """Return the factor of a range between two poses, or between a pose and the place of an anchor.

    `common` are the effects of the constant errors on this range, which is number `row`.
    """
    keys = [key for key, place in ends if place is None]
    errors = [COMMON, SLOW] if slow else [COMMON]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        places = [values.atPose2(key).translation() if place is None else place for key, place in ends]
        away = places[0] - places[1]
        distance = float(np.hypot(*away))
        off = distance - rho + common @ values.atVector(COMMON)
        if slow:
            off += values.atVector(SLOW)[row]
        if jacobians is not None:
            for i, key in enumerate(keys):
                sign = 1.0 if key == ends[0][0] else -1.0
                by_place = sign * away / distance @ values.atPose2(key).rotation().matrix()
                jacobians[i] = np.array([[*by_place, 0.0]])
            jacobians[len(keys)] = common[None, :]
            if slow:
                jacobians[len(keys) + 1] = np.eye(len(values.atVector(SLOW)))[row : row + 1]
        return np.array([off])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), keys + errors, error)


def graph_of(pair: JointMeasurements, fit: Fit, larger: float = 1.0) -> gtsam.NonlinearFactorGraph:
    """Return the graph of all poses, manoeuvres, ranges and common errors, without priors on the starts.

    The variances of white errors are `larger` than told by this factor.
    """
    graph, ranges = gtsam.NonlinearFactorGraph(), pair.ranges
    unit = gtsam.noiseModel.Unit.Create
    priors, noise = pair.noise.priors, pair.noise.odometry
    for robot, path in enumerate(pair.paths):
        rest = pair.noise.standstill_bound
        for tick, (v, omega) in enumerate(zip(path.v.tolist(), path.omega.tolist(), strict=True)):
            moving = abs(v) > rest[0] or abs(omega) > rest[1]
            effects = np.array(
                (
                    (priors.wheel_scale * v, 0.0),
                    (0.0, priors.wheel_scale * omega),
                    (0.0, priors.gyro_bias * moving),
                )
            )
            white = np.array(noise.variances(v, omega))
            if path.extra is not None:
                white = white + path.extra[:, tick]
            graph.add(odometry(robot, tick, np.array((v, omega)), effects, np.sqrt(larger * white)))
            graph.add(arc(robot, tick, path.period, 0.0 if path.slip is None else float(path.slip[tick])))
        graph.add(gtsam.PriorFactorVector(constants_of(robot), np.zeros(3), unit(3)))
    columns, covariance = common_errors(pair), slow_covariance(pair)
    graph.add(gtsam.PriorFactorVector(COMMON, np.zeros(columns.shape[1]), unit(columns.shape[1])))
    if priors.slow_sigma:
        of_slow = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorVector(SLOW, np.zeros(len(ranges.rho)), of_slow))
    sigmas = ranges.sigma * np.sqrt(larger / fit.weights)
    places = np.zeros(2), np.array(m2(pair))
    for row, (rho, tick, sigma) in enumerate(
        zip(ranges.rho.tolist(), ranges.tick.tolist(), sigmas, strict=True)
    ):
        kind = int(kinds(pair)[row])
        ends: list[tuple[int, Array | None]]
        if kind == 2:
            ends = [(pose_of(0, tick), None), (pose_of(1, tick), None)]
        else:
            ends = [(pose_of(kind, tick), None), (-1, places[kind])]
        graph.add(measured_range(ends, rho, columns[row], row, float(sigma), slow=priors.slow_sigma > 0.0))
    return graph


def common_errors(pair: JointMeasurements) -> Array:
    """Return the effect of one sigma of each constant error on the ranges: common bias, scale, one a pair."""
    priors, ranges = pair.noise.priors, pair.ranges
    kind = kinds(pair)
    columns = [np.full(len(kind), priors.range_bias), priors.range_scale * ranges.rho]
    return np.stack([*columns, *[priors.pair_bias * (kind == one) for one in range(3)]], 1)


def slow_covariance(pair: JointMeasurements) -> Array:
    """Return the covariance (m^2) of the slow errors of the ranges; each pair of radios has its own."""
    priors, ranges = pair.noise.priors, pair.ranges
    kind = kinds(pair)
    apart = pair.paths[0].period * np.abs(ranges.tick[:, None] - ranges.tick)
    correlation = np.exp(-apart / priors.slow_time) * (kind[:, None] == kind)
    return np.asarray(priors.slow_sigma**2 * correlation)


def begun(pair: JointMeasurements, starts: list[Pose]) -> gtsam.Values:
    """Return the initial values: the measured odometry from `starts`, and no constant or slow errors."""
    values = gtsam.Values()
    for robot, (path, start) in enumerate(zip(pair.paths, starts, strict=True)):
        values.insert(constants_of(robot), np.zeros(3))
        track = [start]
        slips = np.zeros(len(path.v)) if path.slip is None else path.slip
        for tick, (v, omega, slip) in enumerate(
            zip(path.v.tolist(), path.omega.tolist(), slips.tolist(), strict=True)
        ):
            values.insert(manoeuvre_of(robot, tick), np.array((v, omega)))
            before = track[-1]
            after = step(Pose(before.x, before.y, before.heading + slip), v, omega, path.period)
            track.append(Pose(after.x, after.y, after.heading - slip))
        for tick, pose in enumerate(track):
            values.insert(pose_of(robot, tick), gtsam.Pose2(pose.x, pose.y, pose.heading))
    values.insert(COMMON, np.zeros(common_errors(pair).shape[1]))
    if pair.noise.priors.slow_sigma:
        values.insert(SLOW, np.zeros(len(pair.ranges.rho)))
    return values


class Compared(NamedTuple):
    """The results of both methods for one window."""

    pair: JointMeasurements
    ours: Fit
    theirs: Optimum
    more: Array
    """The covariance of theirs if the variances of white errors are MORE times as large."""


@pytest.fixture(scope="module", params=range(WINDOWS))
def window(request: pytest.FixtureRequest) -> Compared:
    begin_s = APART_S * request.param
    problem = measurements(read_ranges(SAMPLE), None, PROFILE, (begin_s, begin_s + LENGTH_S))
    last = estimated(problem, ClaimRule()).epochs[-1]
    assert last.fitted is not None
    ours, pair = last.fitted.fit, last.fitted.used
    starts = nudged(ours, m2(pair), np.random.default_rng(request.param))
    ends = [pose_of(robot, len(path.v)) for robot, path in enumerate(pair.paths)]
    theirs = optimum(graph_of(pair, ours), begun(pair, starts), ends)
    more = optimum_at(graph_of(pair, ours, MORE), theirs.values, ends).covariance
    return Compared(pair, ours, theirs, more)


def test_both_recorded_poses_are_gtsams_within_a_hundredth_of_a_sigma(window: Compared) -> None:
    sigmas = np.sqrt(np.diagonal(window.theirs.covariance))
    off = np.abs(wrapped(window.ours.poses.ravel() - window.theirs.mean)) / sigmas
    assert off.max() <= AGREED, off


def test_the_covariance_of_both_recorded_poses_is_gtsams_within_a_hundredth(window: Compared) -> None:
    """The noise level multiplies the part of white errors: the derivative by the log of their variance."""
    assert window.ours.level < 1.0
    white = (window.more - window.theirs.covariance) / (MORE - 1.0)
    theirs = window.theirs.covariance - (1.0 - window.ours.level) * white
    sigmas = np.sqrt(np.diagonal(theirs))
    off = np.abs(window.ours.covariance - theirs) / np.outer(sigmas, sigmas)
    assert off.max() <= (1.0 + AGREED) ** 2 - 1.0, off
