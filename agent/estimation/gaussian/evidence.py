"""The evidence for a fit: the Bayes factor against ranges that have nothing to do with each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from agent.estimation.gaussian.fitted import Fit
from agent.estimation.gaussian.least_squares import own_fit
from agent.estimation.gaussian.odometry_noise import Track
from agent.estimation.gaussian.range_model import PairRanges, Ranges


def anchor_evidence(one: Fit, path: Track, ranges: Ranges, sensing_range: float) -> float:
    """Return the logarithm of the Bayes factor for the fit of one robot, against ranges by chance.

    It compares marginal likelihoods: that of the ranges if the anchor is anywhere within R of the start, with
    the other unknowns integrated out (Laplace), and that of ranges that have nothing to do with each other
    (see `_log_widths`).
    """
    prior = math.log(math.pi * sensing_range**2)
    volume = math.log(2.0 * math.pi) + 0.5 * one.log_volume
    return one.log_likelihood + volume - prior + _log_widths((path,), ranges, sensing_range)


@lru_cache(maxsize=2)
def mutual_evidence(one: Fit, pair: PairRanges) -> float:
    """Return the logarithm of the Bayes factor for the mutual ranges under a fit of both robots.

    It is that of `anchor_evidence`, given the ranges to the anchors. All headings are equally probable.
    """
    weight = one.log_likelihood + 0.5 * one.log_volume - math.log(2.0 * math.pi)
    for robot in (0, 1):
        own = own_fit(one, robot, pair.paths, pair.ranges, pair.noise)
        weight -= own.log_likelihood + 0.5 * own.log_volume
        for others in pair.ranges.to_others(robot):
            weight += _log_widths((pair.paths[robot],), others, pair.sensing_range)
    return weight + _log_widths(pair.paths, pair.ranges.only(2), pair.sensing_range)


def _log_widths(paths: Sequence[Track], ranges: Ranges, sensing_range: float) -> float:
    """Return the logarithm of the volume (m^n) over which n ranges spread that fit each other by chance.

    The first is anywhere within R. Each of the others differs from the last by as much as the robots have
    moved since at the most, and by the noise.
    """
    moved = np.zeros(max(len(ranges.tick) - 1, 0))
    for path in paths:
        ticks = np.minimum(ranges.tick, len(path.v))
        moved += np.hypot(np.diff(path.x[ticks]), np.diff(path.y[ticks]))
    width = np.full(len(ranges.tick), sensing_range)
    width[1:] = np.minimum(np.hypot(2.0 * moved, CHANCE_SIGMAS * ranges.sigma[1:]), sensing_range)
    return float(np.sum(np.log(width)))


CHANCE_SIGMAS = 6.0
"""The least width, in sigmas of a range, over which ranges by chance spread.

It contains all of a normal distribution. With less, ranges from a robot at rest would speak for any fit; with
more, they would be worth more than their noise allows.
"""
