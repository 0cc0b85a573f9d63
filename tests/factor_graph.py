"""Factor graphs of two robots for gtsam, an independent solver: poses, manoeuvres, and their optimum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from agent.estimation.fit import Fit
from protocol.motion import Pose
from tests.pair_starts import pair_start

Array = NDArray[np.float64]

STILL = 1e-7
"""The size of a step, in m, m/s and rad, below which gtsam's Gauss-Newton iteration ends."""
ROUNDED, SAME_ERROR = 1e-3, 1e-9
"""The size of a step, and the relative change of the error, that may be due to rounding.

Where constant errors are hardly determined, steps stay at up to 1e-4, and the error has ten equal digits.
"""
STEPS = 200
"""The maximum number of steps."""


class Optimum(NamedTuple):
    """The optimum of the graph, computed by gtsam."""

    mean: Array
    """The poses of both robots at the last tick, in the order of `Fit.poses`."""
    covariance: Array
    error: float
    """Half the sum of squared residuals."""
    values: gtsam.Values


def pose_of(robot: int, tick: int) -> int:
    return int(gtsam.symbol("ab"[robot], tick))


def manoeuvre_of(robot: int, tick: int) -> int:
    """Return the key of the executed v and omega over [tick, tick + 1]."""
    return int(gtsam.symbol("vw"[robot], tick))


def arc(robot: int, tick: int, period: float, slip: float = 0.0) -> gtsam.CustomFactor:
    """Return the factor of the exact unicycle step: an exponential map of SE(2) over a tick.

    The displacement is rotated by `slip`, in rad.
    """
    sideways = gtsam.Rot2(slip)
    aside = np.eye(3)
    aside[:2, :2] = sideways.matrix()
    keys = [pose_of(robot, tick), manoeuvre_of(robot, tick), pose_of(robot, tick + 1)]

    def broken(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        v, omega = values.atPoint2(keys[1])
        twist = np.array((v * period, 0.0, omega * period))
        straight = gtsam.Pose2.Expmap(twist)
        driven = gtsam.Pose2(straight.rotation(), sideways.rotate(straight.translation()))
        ahead = values.atPose2(keys[2]).between(values.atPose2(keys[0]).compose(driven))
        if jacobians is not None:
            by_end = gtsam.Pose2.LogmapDerivative(ahead)
            jacobians[0] = by_end @ driven.inverse().AdjointMap()
            jacobians[1] = by_end @ aside @ gtsam.Pose2.ExpmapDerivative(twist)[:, [0, 2]] * period
            jacobians[2] = -by_end @ ahead.inverse().AdjointMap()
        return np.asarray(gtsam.Pose2.Logmap(ahead))

    return gtsam.CustomFactor(gtsam.noiseModel.Constrained.All(3), keys, broken)


def optimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: Sequence[int]) -> Optimum:
    """Return the optimum, by single Gauss-Newton steps: gtsam's `optimize` ends when the error grows once."""
    error = math.inf
    for _ in range(STEPS):
        optimiser = gtsam.GaussNewtonOptimizer(graph, values)
        optimiser.iterate()
        change = values.localCoordinates(optimiser.values()).norm()
        values = optimiser.values()
        before, error = error, float(graph.error(values))
        if change < STILL or (change < ROUNDED and abs(before - error) < SAME_ERROR * error):
            break
    else:
        raise AssertionError("gtsam has found no optimum")
    return optimum_at(graph, values, last)


def optimum_at(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: Sequence[int]) -> Optimum:
    """Return the optimum if it is at `values`, with the covariance of `graph` there."""
    local = gtsam.Marginals(graph, values).jointMarginalCovariance(last).fullMatrix()
    mean, turn = np.empty(6), np.zeros((6, 6))
    for robot, key in enumerate(last):  # gtsam's covariance is in the frame of the robot
        pose, i = values.atPose2(key), 3 * robot
        mean[i : i + 3] = pose.x(), pose.y(), pose.theta()
        turn[i : i + 2, i : i + 2] = pose.rotation().matrix()
        turn[i + 2, i + 2] = 1.0
    return Optimum(mean, turn @ local @ turn.T, graph.error(values), values)


def nudged(fit: Fit, apart: tuple[float, float], draw: np.random.Generator) -> list[Pose]:
    """Return random starts of both robots, drawn from the estimated distribution."""
    start = pair_start(draw.multivariate_normal(fit.guess, fit.of_start), apart)
    return [Pose(x, y, heading) for x, y, heading in start.poses.tolist()]


def wrapped(change: Array) -> Array:
    """Return the difference of two means, with headings wrapped to [-pi, pi]."""
    change = change.copy()
    change[2::3] = np.remainder(change[2::3] + math.pi, math.tau) - math.pi
    return change
