"""The ranges of one robot or of two, and the likelihood of their residuals.

Outliers follow a mixture: a range is an inlier, or too long by a uniformly distributed bias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.elementary import exp, log, logaddexp
from agent.estimation.gaussian.odometry_noise import Array, Places
from protocol.noise import Noise, Priors, VelocityNoise

SIGMA_FLOOR = 1e-6
"""The least standard deviation (m) that is assumed for a range."""

IMPOSSIBLE = 6.0
"""The number of sigmas beyond R from which a range is an outlier under any guess."""


MOST_CORRELATED_RANGES = 96
"""The most ranges of a kind that a fit weighs if odometry is noisy.

The cost of a fit is linear in their number. Old ranges tell little of the present pose then. Missions of the
sweep `noise` have up to 70; with a bound of less than that, they would take longer; with more, each search.
"""

MOST_RANGES_BY_EXACT_ODOMETRY = 2048
"""The most ranges of a kind without white odometry noise. The cost is linear, and old ranges tell as
much as new ones.

With it, a tick takes 10 ms. A mission that needs more ranges than that does not reach its accuracy.
"""


class Ranges(NamedTuple):
    """N ranges: robot 0 to its anchor, then robot 1 to its own, then the mutual ranges."""

    rho: Array
    """The measured ranges (m); shape (N,)."""
    tick: Places
    sigma: Array
    """The standard deviation (m) of each range; shape (N,)."""
    counts: tuple[int, int, int]
    """The number of ranges of each of the three kinds."""
    place: Array | None = None
    """The position (m) of each range's anchor in <W>, relative to the anchor of the robot's guess; 0 for
    mutual ranges; shape (N, 2). None if each robot has one anchor."""
    radio: Places | None = None
    """The index of each range's pair of radios; shape (N,). None if each robot has one anchor."""

    @staticmethod
    def of_lists(
        first: Sequence[tuple[int, float]],
        second: Sequence[tuple[int, float]],
        mutual: Sequence[tuple[int, float]],
        noise: Noise,
    ) -> Ranges:
        """Return the ranges from three lists of (tick, range in m), as the robots log them."""
        lists = (first, second, mutual)
        counts = (len(first), len(second), len(mutual))
        sigmas = (noise.anchor_sigma, noise.anchor_sigma, noise.mutual_sigma)
        return Ranges(
            np.array([rho for ranges in lists for _, rho in ranges]),
            np.array([tick for ranges in lists for tick, _ in ranges], np.intp),
            np.repeat([max(sigma, SIGMA_FLOOR) for sigma in sigmas], counts),
            counts,
        )

    @property
    def content(self) -> tuple[object, ...]:
        """Return all ranges as values that can be compared."""
        parts = (*self[:3], self.place, self.radio)
        return (*[None if part is None else part.tobytes() for part in parts], self.counts)

    @property
    def pairs(self) -> list[NDArray[np.bool]]:
        """Return the ranges of each pair of radios that has some; shapes (N,)."""
        if self.radio is None:
            kinds = np.repeat(np.arange(3), self.counts)
            return [kinds == kind for kind in range(3) if self.counts[kind]]
        # numpy.unique would import numpy.ma in the first search of a mission
        return [self.radio == one for one in sorted(set(self.radio.tolist()) - {-1})]

    def rows(self, kind: int) -> slice:
        """Return the rows of a kind: 0 and 1 are the ranges of that robot to its anchor, 2 is mutual."""
        begin = sum(self.counts[:kind])
        return slice(begin, begin + self.counts[kind])

    def only(self, kind: int) -> Ranges:
        """Return the ranges of one kind, as the ranges of a single robot."""
        rows = self.rows(kind)
        return Ranges(self.rho[rows], self.tick[rows], self.sigma[rows], (self.counts[kind], 0, 0))

    def common_errors(self, priors: Priors) -> Array:
        """Return the effect (m) of one sigma of each constant error on the ranges; shape (N, m).

        The errors are a bias of all ranges, a scale, a bias of each pair of radios, and a delay. The scale
        multiplies the measured ranges: then the effects are the same under each guess. The column of the
        delay is in s: its effect is minus the range rate (see `smoother`).
        """
        rho = self.rho
        columns: list[Array] = []
        if priors.range_bias:
            columns.append(np.full(len(rho), priors.range_bias))
        if priors.range_scale:
            columns.append(priors.range_scale * rho)
        if priors.pair_bias:
            columns += [np.where(own, priors.pair_bias, 0.0) for own in self.pairs]
        if priors.range_delay:
            columns.append(np.full(len(rho), priors.range_delay))
        return np.array(columns).T if columns else np.zeros((len(rho), 0))

    def loosened(self, priors: Priors, speed: Array | float) -> Array:
        """Return the variance (m^2) that constant and slow errors add to each range; shape (N,).

        `speed` (m/s) is the largest possible rate of the ranges, which a delay multiplies.
        """
        of_biases = priors.range_bias**2 + priors.pair_bias**2 + priors.slow_sigma**2
        variance: Array = np.square(priors.range_scale * self.rho) + of_biases
        variance += np.square(priors.range_delay * speed)
        return variance

    def within(self, sensing_range: float, priors: Priors, speed: float) -> Ranges:
        """Return the ranges without those that are too long to be anything but outliers.

        `speed` (m/s) is as in `loosened`.
        """
        sigma = np.sqrt(np.square(self.sigma) + self.loosened(priors, speed))
        return self._only(self.rho <= sensing_range + IMPOSSIBLE * sigma)

    def thinned(self, noise: Noise) -> Ranges:
        """Return at most MOST_CORRELATED_RANGES of each kind, or MOST_RANGES_BY_EXACT_ODOMETRY.

        All recent ones are among them, and some older ones.

        It bounds the cost of a tick. Which of the older ones are left changes only when their number doubles.
        """
        correlated = noise.odometry != VelocityNoise() or noise.priors.slow_sigma > 0.0
        most = MOST_CORRELATED_RANGES if correlated else MOST_RANGES_BY_EXACT_ODOMETRY
        return self if max(self.counts) <= most else self.thinned_after(-1, most)

    def thinned_after(self, tick: int, most: int) -> Ranges:
        """Return all ranges up to `tick`, and at most `most` of each kind after it, mostly recent ones."""
        left = self.tick <= tick
        for kind in range(3):
            rows = left[self.rows(kind)]
            begin, count = int(np.count_nonzero(rows)), len(rows)
            older = count - most // 2
            if count - begin <= most:
                rows[:] = True
                continue
            rows[older:] = True
            step = 2 ** math.ceil(math.log2((older - begin) / (most - most // 2)))
            rows[begin:older:step] = True
        return self._only(left)

    def _only(self, some: NDArray[np.bool]) -> Ranges:
        """Return the ranges selected by `some`."""
        if np.all(some):
            return self
        first, second, mutual = (int(np.count_nonzero(some[self.rows(kind)])) for kind in range(3))
        place = None if self.place is None else self.place[some]
        radio = None if self.radio is None else self.radio[some]
        counts = (first, second, mutual)
        return Ranges(self.rho[some], self.tick[some], self.sigma[some], counts, place, radio)


def inlier_probability(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that the range of each residual (m) is an inlier."""
    if not (noise.outliers or noise.strays):
        return np.ones_like(residuals)
    # the log-density of outliers and strays, less that of inliers
    misfit, told = 0.5 * np.square(residuals / sigma), _log_inlier(noise)
    ratio = misfit + (math.log(noise.strays / STRAY_WIDTH) - told) if noise.strays else None
    if noise.outliers:
        least, most = noise.outlier_bias
        beyond = residuals - np.minimum(np.maximum(residuals, least), most)
        wide = log(sigma / np.maximum(most - least, sigma)) + (math.log(noise.outliers) - told)
        outlier = misfit - 0.5 * np.square(beyond / sigma) + wide
        ratio = outlier if ratio is None else logaddexp(outlier, ratio)
    assert ratio is not None
    probability: Array = 1.0 / (1.0 + exp(np.minimum(ratio, LARGEST_RATIO)))
    return probability


LARGEST_RATIO = 700.0
"""The log-ratio beyond which an exponential would overflow."""


def mixture(residuals: Array, sigma: Array, noise: Noise) -> tuple[Array, Array]:
    """Return the log-likelihood of the residuals (m), and the probability that each is an inlier.

    The log-likelihood is summed over the last axis; the probabilities have the shape of the residuals.
    """
    good = inliers(residuals, sigma, noise)
    if not (noise.outliers or noise.strays):
        return np.sum(good, -1), np.ones_like(residuals)
    both = logaddexp(good, outliers(residuals, sigma, noise))
    return np.sum(both, -1), exp(good - both)


def inliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the joint log-density of each residual and of its being an inlier."""
    density: Array = -0.5 * np.square(residuals / sigma) - log(sigma)
    return density + _log_inlier(noise)


def _log_inlier(noise: Noise) -> float:
    """Return the joint log-density of being an inlier and of a residual of 0, in units of sigma."""
    return math.log1p(-noise.outliers - noise.strays) - 0.5 * math.log(2.0 * math.pi)


def outliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the joint log-density of each residual and of its being an outlier or a stray.

    The bias of an outlier is uniform, and the ends of its density are smoothed by `sigma`. A stray may be
    anywhere (see STRAY_WIDTH).
    """
    stray = None
    if noise.strays:
        stray = np.broadcast_to(math.log(noise.strays / STRAY_WIDTH) - log(sigma), residuals.shape)
        if not noise.outliers:
            return stray
    least, most = noise.outlier_bias
    beyond = np.maximum(np.maximum(least - residuals, residuals - most), 0.0)
    density: Array = -log(np.maximum(most - least, sigma)) - 0.5 * np.square(beyond / sigma)
    density += math.log(noise.outliers)
    return density if stray is None else logaddexp(density, stray)


STRAY_WIDTH = 100.0
"""The width of the uniform density of strays, in sigmas of a range.

With the default rate of strays, a range is more probably a stray than not from 4.6 sigmas on.
"""
