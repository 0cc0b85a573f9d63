"""The evidence for a fit: the Bayes factor against unrelated ranges, and the likelihood of the detections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from agent.estimation.compiled import address, library
from agent.estimation.elementary import hypot, log
from agent.estimation.fit import Fit, Start, fits
from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges


def anchor_evidence(one: Fit, own: JointMeasurements) -> float:
    """Return the logarithm of the Bayes factor for the fit of one robot, against ranges by chance.

    It compares marginal likelihoods: that of the ranges if the anchor is anywhere within R of the start, with
    the other unknowns integrated out (Laplace), and that of ranges that have nothing to do with each other
    (see `_log_widths`).
    """
    prior = math.log(math.pi * own.reach**2)
    return one.weight + math.log(2.0 * math.pi) - prior + _log_widths(own, own.ranges)


@lru_cache(maxsize=4)
def own_fit(joint: Fit, robot: int, measured: JointMeasurements) -> Fit | None:
    """Return the fit of one robot to its own anchor alone, which begins at that of all robots.

    There is none if a number is too large for a float.
    """
    guess = joint.guess[3 * robot : 3 * robot + 2]
    start = Start(np.array([[-guess[0], -guess[1], 0.0]]), joint.start.errors[robot : robot + 1])
    return next(iter(fits(measured.alone(robot), [start])), None)


@lru_cache(maxsize=2)
def mutual_evidence(one: Fit, pair: JointMeasurements) -> float:
    """Return the logarithm of the Bayes factor for the mutual ranges under a fit of both robots.

    It is that of `anchor_evidence`, given the ranges to the anchors. All headings are equally probable.
    Without a fit to these ranges, there is no evidence at all.
    """
    own = [fit.weight for robot in (0, 1) if (fit := own_fit(one, robot, pair)) is not None]
    if len(own) < 2:
        return -math.inf
    weight = one.weight - math.log(2.0 * math.pi)
    weight -= sum(own)
    return weight + _log_widths(pair, pair.ranges.rows(pair.ranges.mutual))


def _log_widths(measured: JointMeasurements, ranges: JointRanges) -> float:
    """Return the logarithm of the volume (m^n) over which n ranges spread that fit each other by chance.

    The first is anywhere within R. Each of the others differs from the last by as much as the robots have
    moved since at the most, and by the noise.
    """
    moved, sensing_range = np.zeros(max(len(ranges.tick) - 1, 0)), measured.reach
    for path in measured.paths:
        ticks = np.minimum(ranges.tick, len(path.v))
        moved += hypot(np.diff(path.x[ticks]), np.diff(path.y[ticks]))
    width = np.full(len(ranges.tick), sensing_range)
    width[1:] = np.minimum(hypot(2.0 * moved, CHANCE_SIGMAS * ranges.sigma[1:]), sensing_range)
    return float(np.sum(log(width)))


CHANCE_SIGMAS = 6.0
"""The least width, in sigmas of a range, over which ranges by chance spread.

It contains all of a normal distribution. With less, ranges from a robot at rest would speak for any fit; with
more, they would be worth more than their noise allows.
"""


# --- detections ---------------------------------------------------------------------------------------


def detection_log_likelihoods(found: Sequence[Fit], measured: JointMeasurements) -> list[float]:
    """Return the log-likelihood of all detections and of the ticks without one, given each fit.

    It is 0 if a missing range says nothing. The error of a prediction is common to all ticks, because they
    lie on one path: that of the tick in which the beacon was nearest, or in which it was farthest and
    detected. A tick within R has no detection with the probability of drop-outs.
    """
    if not measured.silent:
        return [0.0] * len(found)
    by = address(np.array((measured.reach, CLEAR, EDGE, measured.noise.drop_outs, SILENT)))
    terms, ticks, ranges = [], [], measured.ranges
    for first, second, silent in measured.silent:
        terms.append((first, second, 1, len(silent)))
        ticks.append(silent)
        if second < 0:
            ticks.append(ranges.tick[ranges.to_anchors(first)])
            terms.append((first, second, -1, len(ticks[-1])))
    given = (by, len(terms), address(np.array(terms)), address(np.concatenate(ticks)))
    weights = np.empty((len(found), 1))
    for one, weight in zip(found, weights, strict=True):
        pivot, inverse = one.problem.measured.pivot, one.linear.step.inverse
        at = [address(part) for part in (one.paths, one.start.poses, pivot)]
        fit = (len(one.paths), one.paths.shape[1], *at, one.level, address(inverse), len(inverse))
        library().detections(*given, *fit, address(weight))
    return list(weights[:, 0].tolist())


EDGE = 0.005
"""The assumed uncertainty of R, as a fraction of R, which is added to the uncertainty of the pose."""

CLEAR = 0.5
"""The fraction of R beyond R from which a tick without a detection contains no information."""

SILENT = 12
"""The maximum number of ticks without a detection that are evaluated, those closest to the beacon."""
