"""The ranges of one robot or of both, what a guess predicts of them, and how likely that makes them.

A guess holds, for each robot, where its anchor lies in the frame of its odometry, and how that frame is
turned in <W>. Outliers are a mixture: a range is good, or too long by a bias that is uniform.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.odometry_noise import Array, Places, Projection, Track
from protocol.noise import Noise

SIGMA_FLOOR = 1e-6
"""m: no range is taken to be better than this"""

ELSEWHERE = 0.01
"""of R: a range from no farther off than this says again what the last one said"""

IMPOSSIBLE = 6.0
"""sigmas beyond R: a range so long is an outlier, whatever the guess"""


class Ranges(NamedTuple):
    """N ranges: those of robot 0 to its anchor, then those of robot 1 to its own, then those between them."""

    rho: Array
    """m"""
    tick: Places
    sigma: Array
    """m"""
    counts: tuple[int, int, int]
    """how many there are of each kind"""

    @staticmethod
    def of_lists(
        first: Sequence[tuple[int, float]],
        second: Sequence[tuple[int, float]],
        mutual: Sequence[tuple[int, float]],
        noise: Noise,
    ) -> Ranges:
        """Ticks and ranges, as the robots have logged them."""
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
        """Where those of a kind are: 0, 1: of this robot to its anchor; 2: mutual."""
        begin = sum(self.counts[:kind])
        return slice(begin, begin + self.counts[kind])

    def only(self, kind: int) -> Ranges:
        """The ranges of one robot to its anchor, as if there were no other."""
        rows = self.rows(kind)
        return Ranges(self.rho[rows], self.tick[rows], self.sigma[rows], (self.counts[kind], 0, 0))

    def within(self, sensing_range: float) -> Ranges:
        """Without those that are so long that they cannot but be outliers, who knows by how much."""
        possible = self.rho <= sensing_range + IMPOSSIBLE * self.sigma
        if np.all(possible):
            return self
        first, second, mutual = (int(np.count_nonzero(possible[self.rows(kind)])) for kind in range(3))
        return Ranges(self.rho[possible], self.tick[possible], self.sigma[possible], (first, second, mutual))


class PairRanges(NamedTuple):
    """All that both robots have measured; robot 0 is the paper's a."""

    paths: tuple[Track, Track]
    ranges: Ranges
    silent: tuple[Places, Places, Places]
    """the ticks at which a, b and the two together were not ranged"""
    apart: tuple[float, float]
    """m: M2 - M1 in <W>"""
    sensing_range: float
    noise: Noise

    @property
    def places(self) -> Places:
        """Which of the mutual ranges were taken from elsewhere than the last: one robot had moved."""
        ticks = self.ranges.tick[self.ranges.rows(2)]
        moved = np.zeros(len(ticks), bool)
        moved[:1] = True
        for path in self.paths:
            x, y = path.x[ticks], path.y[ticks]
            moved[1:] |= np.hypot(np.diff(x), np.diff(y)) > ELSEWHERE * self.sensing_range
        return np.flatnonzero(moved)


class Predicted(NamedTuple):
    """What a guess predicts of N ranges."""

    distance: Array
    """m; (N,)"""
    jacobian: Array
    """by the guess; (N, 3 robots)"""
    directions: tuple[Array, ...]
    """along what each range looks at each robot, in the frame of its odometry; 0 where it does not; (2, N)"""

    def seen(self, paths: Sequence[Track], ranges: Ranges) -> list[Projection]:
        """The same, as rows along the paths."""
        return [
            Projection.positions(path, ranges.tick, u) for path, u in zip(paths, self.directions, strict=True)
        ]


def predict(guess: Array, paths: Sequence[Track], ranges: Ranges, apart: tuple[float, float]) -> Predicted:
    """`guess`: of each robot the anchor's x, y in the frame of its odometry, and the frame's heading in <W>.

    `apart` is M2 - M1 in <W>, in m. With one path there are only ranges to its anchor, which do not tell the
    heading: shape (3,), or (6,).
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
"""m: nearer than this, a direction is none"""


def placed(guess: Array, path: Track, ticks: Places) -> tuple[Array, Array]:
    """m: where a robot is at `ticks`, relative to its anchor, along the axes of <W>."""
    mx, my, theta = guess
    c, s = math.cos(theta), math.sin(theta)
    x, y = path.x[ticks] - mx, path.y[ticks] - my
    return c * x - s * y, s * x + c * y


def mixture(residuals: Array, sigma: Array, noise: Noise) -> tuple[Array, Array]:
    """The log-likelihood of residuals (m), summed over the last axis; and how probable it is that each is no
    outlier, of the same shape."""
    good = inliers(residuals, sigma, noise)
    if not noise.outliers:
        return np.sum(good, -1), np.ones_like(residuals)
    both = np.logaddexp(good, outliers(residuals, sigma, noise))
    return np.sum(both, -1), np.exp(good - both)


def inliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """The log-density of each residual, and that it is no outlier."""
    density: Array = -0.5 * np.square(residuals / sigma) - np.log(sigma)
    return density + (math.log1p(-noise.outliers) - 0.5 * math.log(2.0 * math.pi))


def outliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """The log-density of each residual, and that it is an outlier: a uniform bias, with soft ends."""
    least, most = noise.outlier_bias
    beyond = np.maximum(np.maximum(least - residuals, residuals - most), 0.0)
    density: Array = -np.log(np.maximum(most - least, sigma)) - 0.5 * np.square(beyond / sigma)
    return density + math.log(noise.outliers)
