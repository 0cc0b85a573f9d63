"""The likelihood of detections, and of ticks without one, under a fit."""

from __future__ import annotations

import math

import numpy as np

from agent.estimation.elementary import hypot, quadratic
from agent.estimation.fit import Fit, deviation
from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.pair_ranges import PairRanges
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from protocol.motion import rotated_back
from protocol.noise import Noise


def detection_log_likelihood(one: Fit, pair: PairRanges) -> float:
    """Return the log-likelihood of all detections and ticks without one, given the fit."""
    weight = 0.0
    for robot in (0, 1):
        ranged = pair.ranges.only(robot).tick
        weight += anchor_log_likelihood(
            one, robot, pair.silent[robot], ranged, pair.sensing_range, pair.noise
        )
    return weight + _mutual_log_likelihood(one, pair)


def _mutual_log_likelihood(one: Fit, pair: PairRanges) -> float:
    """Return the log-likelihood of no mutual detection at the ticks without a mutual range."""
    silent = pair.silent[2]
    if not len(silent):
        return 0.0
    (wx, wy), (vx, vy) = (one.places(robot, silent) for robot in (0, 1))
    dx, dy = wx - vx, wy - vy
    distance = hypot(dx, dy)
    k = int(np.argmin(distance))
    beyond = distance - pair.sensing_range
    if beyond[k] > CLEAR * pair.sensing_range:
        return 0.0
    nx, ny = dx[k] / max(distance[k], SIGMA_FLOOR), dy[k] / max(distance[k], SIGMA_FLOOR)
    gradient = np.empty(6)
    beside = (vx[k] - pair.apart[0], vy[k] - pair.apart[1])
    for robot, (x, y), sign in ((0, (wx[k], wy[k]), 1.0), (1, beside, -1.0)):
        theta = one.start.poses[robot, 2]
        c, s = math.cos(theta), math.sin(theta)
        along, across = rotated_back(c, s, nx, ny)
        gradient[3 * robot : 3 * robot + 3] = (-sign * along, -sign * across, sign * (ny * x - nx * y))
    sigma = math.hypot(deviation(quadratic(one.of_start, gradient)), EDGE * pair.sensing_range)
    return no_detection_log_likelihood(beyond, sigma, pair.noise.drop_outs)


def anchor_log_likelihood(
    one: Fit, robot: int, silent: Places, ranged: Places, sensing_range: float, noise: Noise
) -> float:
    """Return the log-likelihood of detections by the anchor at `ranged`, and of none at `silent` (ticks)."""
    columns = slice(3 * robot, 3 * robot + 2)
    place, weight = one.of_start[columns, columns], 0.0
    anchor, turn = one.problem.measured.pivot[robot], one.start.poses[robot, 2]
    c, s = math.cos(turn), math.sin(turn)
    for ticks, sign in ((silent, 1.0), (ranged, -1.0)):
        if not len(ticks):
            continue
        x, y = one.places(robot, ticks) - anchor[:, None]
        beyond = sign * (hypot(x, y) - sensing_range)
        worst = int(np.argmin(beyond))
        if beyond[worst] > CLEAR * sensing_range:
            continue
        along = np.array(rotated_back(c, s, x[worst], y[worst]))
        u = along / max(math.hypot(x[worst], y[worst]), SIGMA_FLOOR)
        sigma = math.hypot(deviation(quadratic(place, u)), EDGE * sensing_range)
        if sign > 0.0:
            weight += no_detection_log_likelihood(beyond, sigma, noise.drop_outs)
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
