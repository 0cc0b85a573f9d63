"""Initial guesses for an anchor in the frame of the odometry: the intersections of two range circles.

Each guess is refined by Gauss-Newton on all ranges, with odometry noise treated as noise of the ranges. Ticks
without a detection are ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from agent.estimation.elementary import hypot
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Places,
    constant_errors,
    is_noisy,
    variances,
    wander,
)
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, inlier_probability, log_likelihood

SEED_RANGES = 10
"""The largest number of ranges that initial guesses are made from.

With more ranges to the anchor, only the remaining hypotheses about its position are followed.
"""

SAME_POSITION = 0.02
"""The expected error of an initial guess, as a fraction of R; guesses closer than this are merged."""

POLISHINGS = 4
"""The least number of Gauss-Newton steps on an initial guess, after that on the rotations of a placement."""

POSITION_FINER = 0.1
"""The factor by which the expected error of a position decreases at each of these steps."""

TWINS = 0.3
"""The distance in sigmas of a range below which guesses are merged, in addition to the limits above."""

UNLIKELY = 25.0
"""The difference in log-likelihood to the best guess beyond which a guess is dropped."""

MOST_GUESSES = 6
"""The largest number of guesses for an anchor."""


def anchors(own: JointMeasurements, known: Sequence[Sequence[float]] = ()) -> Array:
    """Return initial guesses for the anchor (m) of a robot in the frame of its odometry; shape (n, 2).

    `known` contains earlier guesses, which are refined as well.
    """
    points = np.concatenate((np.array(known).reshape(-1, 2), _crossings(own)))
    if not len(points):
        return points
    variance = np.square(own.ranges.sigma) + _odometry_variance(own) + own.loosened
    return _polished(points, own, np.sqrt(variance))


def _odometry_variance(own: JointMeasurements) -> Array:
    """Return the approximate variance (m^2) that odometry noise adds to each range, without correlations."""
    path, noise = own.paths[0], own.noise
    if not is_noisy(noise):
        return np.zeros_like(own.ranges.rho)
    v, omega = path.v, path.omega
    white = variances(v, omega, noise.odometry)
    if path.extra is not None:
        white += path.extra
    model = wander(path, np.zeros(path.shift.shape), constant_errors(v, omega, noise), white)
    lever, position = path.period, np.zeros(len(path.x))
    if model.sums is not None:
        turn, bx, by, xx, _, yy = model.sums
        position = xx + yy - 2.0 * lever * (path.y * bx - path.x * by)
        position += lever**2 * (path.x**2 + path.y**2) * turn
    for turned, x, y in model.moves[:-1]:
        position = position + np.square(x - lever * path.y * turned) + np.square(y + lever * path.x * turned)
    along: Array = 0.5 * np.maximum(position, 0.0)[np.minimum(own.ranges.tick, len(path.v))]
    return along


@cache
def spread_out(count: int) -> Places:
    """Return at most SEED_RANGES of the indices below `count`, evenly spaced."""
    # numpy.unique would import numpy.ma in the first search of a mission
    spread = np.linspace(0, count - 1, SEED_RANGES).round().astype(np.intp)
    return spread[np.diff(spread, prepend=-1) > 0]


@cache
def _couples(count: int) -> tuple[Places, Places]:
    """Return the first and the second of each two of the indices `spread_out`."""
    chosen = spread_out(count)
    i, j = np.triu_indices(len(chosen), 1)
    return chosen[i], chosen[j]


def _crossings(own: JointMeasurements) -> Array:
    """Return the intersections (m) of each two range circles, in the frame of the odometry; shape (n, 2).

    If noise keeps two circles apart, a point between them is used.
    """
    path, ranges = own.paths[0], own.ranges
    if len(ranges.rho) < 2:
        return np.empty((0, 2))
    i, j = _couples(len(ranges.rho))
    x, y, rho = path.x[ranges.tick], path.y[ranges.tick], ranges.rho
    dx, dy = x[j] - x[i], y[j] - y[i]
    apart = hypot(dx, dy)
    some = apart > SIGMA_FLOOR
    i, j, dx, dy, apart = i[some], j[some], dx[some], dy[some], apart[some]
    along = (apart**2 + rho[i] ** 2 - rho[j] ** 2) / (2.0 * apart)
    across = np.sqrt(np.maximum(rho[i] ** 2 - along**2, 0.0))
    points = [
        np.stack(
            (
                (x[i] + (along * dx - s * across * dy) / apart),
                (y[i] + (along * dy + s * across * dx) / apart),
            ),
            1,
        )
        for s in (1.0, -1.0)
    ]
    return np.concatenate(points)


def _polished(points: Array, own: JointMeasurements, sigma: Array) -> Array:
    """Return the most likely of `points` after refinement on all ranges, without duplicates; shape (n, 2)."""
    path, ranges, noise, sensing_range = own.paths[0], own.ranges, own.noise, own.reach
    x, y, rho = path.x[ranges.tick], path.y[ranges.tick], ranges.rho
    near = SAME_POSITION * sensing_range

    def residuals_at(points: Array) -> tuple[Array, Array, Array, Array]:
        dx, dy = x - points[:, :1], y - points[:, 1:]
        distance = np.maximum(hypot(dx, dy), SIGMA_FLOOR)
        return rho - distance, dx / distance, dy / distance, distance

    for step in range(POLISHINGS):
        s = hypot(sigma, near * POSITION_FINER**step)
        residual, ux, uy, _ = residuals_at(points)
        weight = inlier_probability(residual, s, noise) / np.square(s)
        wx, wy = weight * ux, weight * uy
        xx, xy, yy = np.add.reduce(wx * ux, 1), np.add.reduce(wx * uy, 1), np.add.reduce(wy * uy, 1)
        gx, gy = -np.add.reduce(wx * residual, 1), -np.add.reduce(wy * residual, 1)
        damping = 1e-6 * (xx + yy) + 1e-12
        xx, yy = xx + damping, yy + damping
        determinant = xx * yy - xy * xy
        change = np.stack(((yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant), 1)
        longest = np.maximum(np.abs(change).max(1, keepdims=True), 1e-12)
        points = points + change * np.minimum(1.0, 0.5 * sensing_range / longest)
    likely = log_likelihood(residuals_at(points)[0], hypot(sigma, near * POSITION_FINER**POLISHINGS), noise)
    return _best(points, likely, near * POSITION_FINER + TWINS * float(np.min(sigma)))


def _best(points: Array, likely: Array, near: float) -> Array:
    """Return the most likely points, with more than `near` m between any two."""
    left = np.flatnonzero(likely >= np.max(likely) - UNLIKELY)
    left = left[np.argsort(-likely[left], kind="stable")]
    chosen: list[int] = []
    while len(left) and len(chosen) < MOST_GUESSES:
        chosen.append(int(left[0]))
        left = left[np.abs(points[left] - points[left[0]]).sum(1) > near]
    return points[chosen]
