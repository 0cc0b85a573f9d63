"""The measurement model: predicted ranges for a guess, and their likelihood.

A guess contains, for each robot, the position of its anchor in the frame of its odometry and the rotation of
that frame in <W>. Outliers follow a mixture: a range is an inlier, or too long by a uniformly distributed
bias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian.odometry_noise import Array, Places, Projection, Track
from protocol.noise import Noise, Priors, VelocityNoise

SIGMA_FLOOR = 1e-6
"""The least standard deviation (m) that is assumed for a range."""

ELSEWHERE = 0.01
"""The fraction of R that a robot must have moved for a range to count as one from another place."""

IMPOSSIBLE = 6.0
"""The number of sigmas beyond R from which a range is an outlier under any guess."""


MOST_RANGES = 96
"""The most ranges of a kind that a fit weighs if odometry is noisy.

The cost of a fit is cubic in their number: with 3 x 96, a search takes about 0.2 s. Old ranges tell little of
the present pose then. Missions of the sweep `noise` have up to 70; with a bound of less than that, they would
take longer, and with 1000, a search would take seconds.
"""

MOST_RANGES_BY_EXACT_ODOMETRY = 2048
"""The most ranges of a kind without white odometry noise. The cost is linear, and old ranges tell as much as
new ones.

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

    def rows(self, kind: int) -> slice:
        """Return the rows of a kind: 0 and 1 are the ranges of that robot to its anchor, 2 is mutual."""
        begin = sum(self.counts[:kind])
        return slice(begin, begin + self.counts[kind])

    def only(self, kind: int) -> Ranges:
        """Return the ranges of one robot to its anchor, as the ranges of a single robot."""
        rows = self.rows(kind)
        return Ranges(self.rho[rows], self.tick[rows], self.sigma[rows], (self.counts[kind], 0, 0))

    def common_errors(self, priors: Priors) -> Array:
        """Return the effect (m) of one sigma of each constant error on the ranges; shape (N, m).

        The errors are a bias of all ranges, one of each pair of radios, and a scale. The scale multiplies the
        measured ranges: then the effects are the same under each guess.
        """
        columns = []
        if priors.range_bias:
            columns.append(np.full(len(self.rho), priors.range_bias))
        if priors.range_scale:
            columns.append(priors.range_scale * self.rho)
        if priors.pair_bias:
            for kind in range(3):
                if self.counts[kind]:
                    column = np.zeros(len(self.rho))
                    column[self.rows(kind)] = priors.pair_bias
                    columns.append(column)
        return np.stack(columns, 1) if columns else np.zeros((len(self.rho), 0))

    def slow_errors(self, priors: Priors, period: float) -> Array | None:
        """Return the covariance (m^2) of slowly varying errors, within each pair of radios; None without."""
        if not priors.slow_sigma:
            return None
        covariance = np.zeros((len(self.rho), len(self.rho)))
        for kind in range(3):
            rows = self.rows(kind)
            apart = np.abs(np.subtract.outer(self.tick[rows], self.tick[rows])) * (period / priors.slow_time)
            covariance[rows, rows] = priors.slow_sigma**2 * np.exp(-apart)
        return covariance

    def loosened(self, priors: Priors) -> Array:
        """Return the variance (m^2) that constant and slow errors add to each range; shape (N,)."""
        variance: Array = np.sum(np.square(self.common_errors(priors)), 1) + priors.slow_sigma**2
        return variance

    def within(self, sensing_range: float, priors: Priors) -> Ranges:
        """Return the ranges without those that are too long to be anything but outliers."""
        sigma = np.sqrt(np.square(self.sigma) + self.loosened(priors))
        return self._only(self.rho <= sensing_range + IMPOSSIBLE * sigma)

    def thinned(self, noise: Noise) -> Ranges:
        """Return at most MOST_RANGES of each kind, or MOST_RANGES_BY_EXACT_ODOMETRY: all recent, some older.

        It bounds the cost of a tick. Which of the older ones are left changes only when their number doubles.
        """
        correlated = noise.odometry != VelocityNoise() or noise.priors.slow_sigma > 0.0
        most = MOST_RANGES if correlated else MOST_RANGES_BY_EXACT_ODOMETRY
        if max(self.counts) <= most:
            return self
        left = np.zeros(len(self.rho), np.bool)
        for kind in range(3):
            rows, older = left[self.rows(kind)], self.counts[kind] - most // 2
            if self.counts[kind] <= most:
                rows[:] = True
                continue
            rows[older:] = True
            rows[: older : 2 ** math.ceil(math.log2(older / (most - most // 2)))] = True
        return self._only(left)

    def _only(self, some: NDArray[np.bool]) -> Ranges:
        """Return the ranges selected by `some`."""
        if np.all(some):
            return self
        first, second, mutual = (int(np.count_nonzero(some[self.rows(kind)])) for kind in range(3))
        return Ranges(self.rho[some], self.tick[some], self.sigma[some], (first, second, mutual))


class PairRanges(NamedTuple):
    """The measurements of both robots; robot 0 is the paper's a."""

    paths: tuple[Track, Track]
    ranges: Ranges
    silent: tuple[Places, Places, Places]
    """The ticks without a range: of a to its anchor, of b to its anchor, and between the two."""
    apart: tuple[float, float]
    """The vector M2 - M1 (m) in <W>."""
    sensing_range: float
    noise: Noise

    @property
    def places(self) -> Places:
        """Return the indices of the first mutual range, and of each that follows a motion of a robot."""
        ticks = self.ranges.tick[self.ranges.rows(2)]
        moved = np.zeros(len(ticks), bool)
        moved[:1] = True
        for path in self.paths:
            x, y = path.x[ticks], path.y[ticks]
            moved[1:] |= np.hypot(np.diff(x), np.diff(y)) > ELSEWHERE * self.sensing_range
        return np.flatnonzero(moved)


class Predicted(NamedTuple):
    """The ranges that a guess predicts, and their derivatives."""

    distance: Array
    """The predicted ranges (m); shape (N,)."""
    jacobian: Array
    """The derivatives with respect to the guess; shape (N, 3 robots)."""
    directions: tuple[Array, ...]
    """The derivatives with respect to each robot's position, in the frame of its odometry; shapes (2, N).

    They are 0 if a range does not involve the robot.
    """

    def seen(self, paths: Sequence[Track], ranges: Ranges) -> list[Projection]:
        """Return the derivatives as rows along the paths."""
        return [
            Projection.positions(path, ranges.tick, u) for path, u in zip(paths, self.directions, strict=True)
        ]


def predict(guess: Array, paths: Sequence[Track], ranges: Ranges, apart: tuple[float, float]) -> Predicted:
    """Return the ranges that `guess` predicts.

    `guess` contains for each robot the x and y (m) of its anchor in the frame of its odometry, and the
    rotation (rad) of this frame in <W>; shape (3,) or (6,). `apart` is M2 - M1 (m) in <W>. With a single path
    there are only ranges to its anchor, and they do not determine the rotation.
    """
    n, ticks = len(ranges.rho), ranges.tick
    distance, jacobian = np.empty(n), np.zeros((n, len(guess)))
    directions = tuple([np.zeros((2, n)) for _ in paths])
    for robot, path in enumerate(paths):
        rows = ranges.rows(robot)
        mx, my = guess[3 * robot : 3 * robot + 2]
        x, y = path.x[ticks[rows]] - mx, path.y[ticks[rows]] - my
        rho = np.maximum(np.hypot(x, y), TINY)
        distance[rows] = rho
        directions[robot][:, rows] = x / rho, y / rho
    if len(paths) == 2 and ranges.counts[2]:
        rows = ranges.rows(2)
        (ax, ay), (bx, by) = (
            placed(guess[3 * robot : 3 * robot + 3], path, ticks[rows]) for robot, path in enumerate(paths)
        )
        dx, dy = ax - bx - apart[0], ay - by - apart[1]
        gap = np.maximum(np.hypot(dx, dy), TINY)
        distance[rows] = gap
        nx, ny = dx / gap, dy / gap
        jacobian[rows, 2], jacobian[rows, 5] = ny * ax - nx * ay, nx * by - ny * bx
        for robot, sign in ((0, 1.0), (1, -1.0)):
            theta = guess[3 * robot + 2]
            c, s = sign * math.cos(theta), sign * math.sin(theta)
            directions[robot][:, rows] = c * nx + s * ny, c * ny - s * nx
    for robot, u in enumerate(directions):
        jacobian[:, 3 * robot : 3 * robot + 2] = -u.T
    return Predicted(distance, jacobian, directions)


TINY = 1e-12
"""The distance (m) below which a direction is not defined."""


def placed(guess: Array, path: Track, ticks: Places) -> tuple[Array, Array]:
    """Return the position (m) of a robot at `ticks`, relative to its anchor, along the axes of <W>."""
    mx, my, theta = guess
    c, s = math.cos(theta), math.sin(theta)
    x, y = path.x[ticks] - mx, path.y[ticks] - my
    return c * x - s * y, s * x + c * y


def mixture(residuals: Array, sigma: Array, noise: Noise) -> tuple[Array, Array]:
    """Return the log-likelihood of the residuals (m), and the probability that each is an inlier.

    The log-likelihood is summed over the last axis; the probabilities have the shape of the residuals.
    """
    good = inliers(residuals, sigma, noise)
    if not (noise.outliers or noise.strays):
        return np.sum(good, -1), np.ones_like(residuals)
    both = np.logaddexp(good, outliers(residuals, sigma, noise))
    return np.sum(both, -1), np.exp(good - both)


def inliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the joint log-density of each residual and of its being an inlier."""
    density: Array = -0.5 * np.square(residuals / sigma) - np.log(sigma)
    return density + (math.log1p(-noise.outliers - noise.strays) - 0.5 * math.log(2.0 * math.pi))


def outliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the joint log-density of each residual and of its being an outlier or a stray.

    The bias of an outlier is uniform, and the ends of its density are smoothed by `sigma`. A stray may be
    anywhere (see STRAY_WIDTH).
    """
    stray = None
    if noise.strays:
        stray = np.broadcast_to(math.log(noise.strays / STRAY_WIDTH) - np.log(sigma), residuals.shape)
        if not noise.outliers:
            return stray
    least, most = noise.outlier_bias
    beyond = np.maximum(np.maximum(least - residuals, residuals - most), 0.0)
    density: Array = -np.log(np.maximum(most - least, sigma)) - 0.5 * np.square(beyond / sigma)
    density += math.log(noise.outliers)
    return density if stray is None else np.logaddexp(density, stray)


STRAY_WIDTH = 100.0
"""The width of the uniform density of strays, in sigmas of a range.

With the default rate of strays, a range is more probably a stray than not from 4.6 sigmas on.
"""
