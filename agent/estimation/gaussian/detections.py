"""The likelihood of detections, and of ticks without one, under a fit."""

from __future__ import annotations

import math

import numpy as np

from agent.estimation.elementary import hypot, quadratic
from agent.estimation.fit import Fit, deviation
from agent.estimation.gaussian.joint_ranges import JointMeasurements, Silence
from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from protocol.motion import rotated_back


def detection_log_likelihood(one: Fit, measured: JointMeasurements) -> float:
    """Return the log-likelihood of all detections and of the ticks without one, given the fit.

    It is 0 if a missing range says nothing.
    """
    weight = 0.0
    for silence in measured.silent:
        if silence.second < 0:
            ranged = measured.ranges.tick[measured.ranges.to_anchors(silence.first)]
            weight += _anchor_log_likelihood(one, silence, ranged, measured)
        else:
            weight += _mutual_log_likelihood(one, silence, measured)
    return weight


def _mutual_log_likelihood(one: Fit, silence: Silence, measured: JointMeasurements) -> float:
    """Return the log-likelihood of no detection between two robots at the ticks without one."""
    first, second, silent = silence
    if not len(silent):
        return 0.0
    (wx, wy), (vx, vy) = (one.places(robot, silent) for robot in (first, second))
    dx, dy = wx - vx, wy - vy
    distance = hypot(dx, dy)
    k = int(np.argmin(distance))
    beyond = distance - measured.reach
    if beyond[k] > CLEAR * measured.reach:
        return 0.0
    nx, ny = dx[k] / max(distance[k], SIGMA_FLOOR), dy[k] / max(distance[k], SIGMA_FLOOR)
    gradient, pivot = np.zeros(one.start.poses.size), one.problem.measured.pivot
    for robot, at, sign in ((first, (wx[k], wy[k]), 1.0), (second, (vx[k], vy[k]), -1.0)):
        x, y = at - pivot[robot]
        theta = one.start.poses[robot, 2]
        c, s = math.cos(theta), math.sin(theta)
        along, across = rotated_back(c, s, nx, ny)
        gradient[3 * robot : 3 * robot + 3] = (-sign * along, -sign * across, sign * (ny * x - nx * y))
    sigma = math.hypot(deviation(quadratic(one.of_start, gradient)), EDGE * measured.reach)
    return no_detection_log_likelihood(beyond, sigma, measured.noise.drop_outs)


def _anchor_log_likelihood(one: Fit, silence: Silence, ranged: Places, measured: JointMeasurements) -> float:
    """Return the log-likelihood of detections by the anchor at `ranged`, and of none in the `silence`."""
    robot, weight, reach = silence.first, 0.0, measured.reach
    columns = slice(3 * robot, 3 * robot + 2)
    place = one.of_start[columns, columns]
    anchor, turn = one.problem.measured.pivot[robot], one.start.poses[robot, 2]
    c, s = math.cos(turn), math.sin(turn)
    for ticks, sign in ((silence.ticks, 1.0), (ranged, -1.0)):
        if not len(ticks):
            continue
        x, y = one.places(robot, ticks) - anchor[:, None]
        beyond = sign * (hypot(x, y) - reach)
        worst = int(np.argmin(beyond))
        if beyond[worst] > CLEAR * reach:
            continue
        along = np.array(rotated_back(c, s, x[worst], y[worst]))
        u = along / max(math.hypot(x[worst], y[worst]), SIGMA_FLOOR)
        sigma = math.hypot(deviation(quadratic(place, u)), EDGE * reach)
        if sign > 0.0:
            weight += no_detection_log_likelihood(beyond, sigma, measured.noise.drop_outs)
        else:
            weight += _log_cdf(float(beyond[worst]) / sigma)
    return weight


EDGE = 0.005
"""The assumed uncertainty of R, as a fraction of R, which is added to the uncertainty of the pose."""

CLEAR = 0.5
"""The fraction of R beyond R from which a tick without a detection contains no information."""


def no_detection_log_likelihood(beyond: Array, sigma: float, drop_outs: float) -> float:
    """Return the log-likelihood of no detection at several ticks.

    `beyond` is the predicted distance (m) beyond R at each of these ticks. The prediction has an error of
    standard deviation `sigma` (m), which is common to all ticks because they lie on one path. A tick within R
    has no detection with the probability `drop_outs`.
    """
    if not len(beyond):
        return 0.0
    margins = np.sort(beyond)[:SILENT] / max(sigma, SIGMA_FLOOR)
    if not drop_outs:
        return _log_cdf(float(margins[0]))
    likelihood, below = 0.0, 0.0
    for n, margin in enumerate([*margins.tolist(), math.inf]):
        up_to = 0.5 * math.erfc(-margin / math.sqrt(2.0))
        likelihood += drop_outs**n * (up_to - below)
        below = up_to
    return math.log(max(likelihood, 1e-300))


SILENT = 12
"""The maximum number of ticks without a detection that are evaluated, those closest to the beacon."""


def _log_cdf(x: float) -> float:
    """Return the logarithm of the standard normal distribution function."""
    if x > -30.0:
        return math.log(0.5 * math.erfc(-x / math.sqrt(2.0)))
    return -0.5 * x * x - math.log(-x * math.sqrt(2.0 * math.pi))
