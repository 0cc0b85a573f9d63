"""Initial guesses for the fits, from closed forms of a few ranges; ticks without a detection are ignored.

The guesses for an anchor are the intersections of two range circles. For a placement, one robot is rotated
through all headings, and a mutual range leaves two headings of the other. Each guess is refined by
Gauss-Newton on all ranges of its kind, with odometry noise treated as noise of the ranges.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from msgspec.structs import replace

from agent.estimation.gaussian.odometry_noise import Array, Places, Track, constant_errors, is_noisy, wander
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, PairRanges, Ranges, mixture, placed
from protocol.noise import Noise, VelocityNoise

SEED_RANGES = 10
"""The largest number of ranges that initial guesses are made from.

With more ranges to the anchor, only the remaining hypotheses about its position are followed.
"""

NEAR = 0.02
"""The expected error of an initial guess, as a fraction of R; guesses closer than this are merged."""

SCAN = 72
"""The number of headings that are tried for the robot nearer to its anchor."""

BENT = 0.1
"""The distance, as a fraction of R, below which placements are merged.

A fit moves by itself along directions that the ranges leave undetermined.
"""

POLISHINGS = 4
"""The number of Gauss-Newton steps on an initial guess."""

FINER, FINER_TURN = 0.1, 0.2
"""The factors by which the expected errors of a position and of a heading decrease at each of these steps."""

TURN = 0.3
"""The largest change of a heading (rad) in one of these steps."""

TWINS = 0.3
"""The distance in sigmas of a range below which guesses are merged, in addition to the limits above."""

SHORTEST = 0.1
"""The least lever (m) that is assumed for a heading."""

MOST = 6
"""The maximum number of hypotheses that are followed at once."""


def anchors(
    path: Track,
    ranges: Ranges,
    sensing_range: float,
    noise: Noise,
    known: Sequence[Sequence[float]] = (),
) -> Array:
    """Return initial guesses for the anchor (m) in the frame of the odometry, from the ranges; shape (n, 2).

    `known` contains earlier guesses, which are refined as well.
    """
    points = np.concatenate((np.array(known).reshape(-1, 2), _crossings(path, ranges)))
    if not len(points):
        return points
    variance = np.square(ranges.sigma) + _odometry_variance(path, ranges, noise)
    variance += ranges.loosened(noise.priors)
    return _polished(points, path, ranges, np.sqrt(variance), noise, sensing_range)


def _odometry_variance(path: Track, ranges: Ranges, noise: Noise) -> Array:
    """Return the approximate variance (m^2) that odometry noise adds to each range, without correlations."""
    if not is_noisy(noise):
        return np.zeros_like(ranges.rho)
    model = wander(path, noise.odometry, path, constant_errors(path, noise))
    turn, bx, by, xx, _, yy = model.sums
    lever = path.period
    position = xx + yy + 2.0 * lever * (path.y * bx - path.x * by) + lever**2 * (path.x**2 + path.y**2) * turn
    for turned, x, y in model.moves:
        position = position + np.square(x - lever * path.y * turned) + np.square(y + lever * path.x * turned)
    along: Array = 0.5 * np.maximum(position, 0.0)[np.minimum(ranges.tick, len(path.v))]
    return along


def _spread(count: int) -> Places:
    """Return at most SEED_RANGES of the indices below `count`, evenly spaced."""
    # numpy.unique would import numpy.ma in the first search of a mission
    spread = np.linspace(0, count - 1, SEED_RANGES).round().astype(np.intp)
    return spread[np.diff(spread, prepend=-1) > 0]


def _crossings(path: Track, ranges: Ranges) -> Array:
    """Return the intersections (m) of each two range circles, in the frame of the odometry; shape (n, 2).

    If noise keeps two circles apart, a point between them is used.
    """
    if len(ranges.rho) < 2:
        return np.empty((0, 2))
    chosen = _spread(len(ranges.rho))
    i, j = np.triu_indices(len(chosen), 1)
    i, j = chosen[i], chosen[j]
    x, y, rho = path.x[ranges.tick], path.y[ranges.tick], ranges.rho
    dx, dy = x[j] - x[i], y[j] - y[i]
    apart = np.hypot(dx, dy)
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


def _polished(
    points: Array, path: Track, ranges: Ranges, sigma: Array, noise: Noise, sensing_range: float
) -> Array:
    """Return the most likely of `points` after refinement on all ranges, without duplicates; shape (n, 2)."""
    x, y, rho = path.x[ranges.tick], path.y[ranges.tick], ranges.rho
    near = NEAR * sensing_range

    def residuals_at(points: Array) -> tuple[Array, Array, Array, Array]:
        dx, dy = x - points[:, :1], y - points[:, 1:]
        distance = np.maximum(np.hypot(dx, dy), SIGMA_FLOOR)
        return rho - distance, dx / distance, dy / distance, distance

    for step in range(POLISHINGS):
        s = np.hypot(sigma, near * FINER**step)
        residual, ux, uy, _ = residuals_at(points)
        weight = mixture(residual, s, noise)[1] / np.square(s)
        xx, xy, yy = (np.sum(weight * a * b, 1) for a, b in ((ux, ux), (ux, uy), (uy, uy)))
        gx, gy = -np.sum(weight * ux * residual, 1), -np.sum(weight * uy * residual, 1)
        damping = 1e-6 * (xx + yy) + 1e-12
        xx, yy = xx + damping, yy + damping
        determinant = xx * yy - xy * xy
        change = np.stack(((yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant), 1)
        longest = np.maximum(np.abs(change).max(1, keepdims=True), 1e-12)
        points = points + change * np.minimum(1.0, 0.5 * sensing_range / longest)
    likely = mixture(residuals_at(points)[0], np.hypot(sigma, near * FINER**POLISHINGS), noise)[0]
    return _best(points, likely, near * FINER + TWINS * float(np.min(sigma)))


def _best(points: Array, likely: Array, near: float) -> Array:
    """Return the most likely points, with at least `near` m between any two."""
    return _distinct(points, likely, near, MOST, lambda one, others: np.abs(others - one).sum(1))


UNLIKELY = 25.0
"""The difference in log-likelihood to the best guess beyond which a guess is dropped."""


# --- a pair -----------------------------------------------------------------------------------------


def without_drift(pair: PairRanges) -> PairRanges:
    """Return `pair` with exact odometry, and with its noise added to the variances of the ranges."""
    if not is_noisy(pair.noise):
        return pair
    variance = np.square(pair.ranges.sigma)
    for robot, path in enumerate(pair.paths):
        added = _odometry_variance(path, pair.ranges, pair.noise)
        added[pair.ranges.rows(1 - robot)] = 0.0
        variance = variance + added
    ranges = pair.ranges._replace(sigma=np.sqrt(variance))
    exact = replace(pair.noise, odometry=VelocityNoise(), wheel_scale=0.0, gyro_bias=0.0)
    return pair._replace(ranges=ranges, noise=exact)


def placements(of_a: Array, of_b: Array, pair: PairRanges) -> list[tuple[float, float]]:
    """Return the most likely rotations (rad) of the two odometry frames in <W>, given the mutual ranges.

    `of_a` and `of_b` are the positions (m) of the anchors in these frames.

    The robot nearer to its anchor is rotated through all headings. One mutual range then leaves two headings
    of the other robot, at the intersections of the circles about its anchor and about the first robot
    (Section III.C with one circle rotated). The other mutual ranges determine which of the headings are
    likely.
    """
    mutual = pair.ranges.rows(2)
    ticks, rho, sigma = pair.ranges.tick[mutual], pair.ranges.rho[mutual], pair.ranges.sigma[mutual]
    places = pair.places if len(pair.places) >= SEED_RANGES else np.arange(len(ticks))
    some = places[_spread(len(places))]
    ticks, rho, sigma = ticks[some], rho[some], sigma[some]
    place = [
        placed(np.array([*one, 0.0]), path, ticks) for one, path in zip((of_a, of_b), pair.paths, strict=True)
    ]
    radii = [np.hypot(x, y) for x, y in place]
    near, far = (0, 1) if float(np.mean(radii[0])) < float(np.mean(radii[1])) else (1, 0)
    sign = 1.0 if far == 0 else -1.0
    dx, dy = sign * pair.apart[0], sign * pair.apart[1]  # from the far robot's anchor to the near one's
    scan = np.linspace(-math.pi, math.pi, SCAN, endpoint=False)
    c, s = np.cos(scan), np.sin(scan)
    seeds = []
    for base in sorted({0, len(ticks) - 1}):
        x = dx + c * place[near][0][base] - s * place[near][1][base]
        y = dy + s * place[near][0][base] + c * place[near][1][base]
        gap = np.maximum(np.hypot(x, y), SIGMA_FLOOR)
        radius = max(float(radii[far][base]), SIGMA_FLOOR)
        opening = np.arccos(np.clip((gap**2 + radius**2 - rho[base] ** 2) / (2.0 * gap * radius), -1.0, 1.0))
        bearing = np.arctan2(y, x) - math.atan2(place[far][1][base], place[far][0][base])
        seeds += [np.stack((scan, bearing + opening), 1), np.stack((scan, bearing - opening), 1)]
    turns = np.concatenate(seeds)
    lever = np.array([max(float(np.mean(radii[robot])), SHORTEST) for robot in (near, far)])
    odometry = sum([_odometry_variance(path, pair.ranges, pair.noise)[mutual][some] for path in pair.paths])
    odometry = odometry + pair.ranges.loosened(pair.noise.priors)[mutual][some]
    turns = _turned(
        turns, [place[near], place[far]], rho, np.sqrt(np.square(sigma) + odometry), (dx, dy), lever, pair
    )
    found = [(float(one), float(other)) for one, other in turns]
    return found if near == 0 else [(other, one) for one, other in found]


def _turned(
    turns: Array,
    place: Sequence[tuple[Array, Array]],
    rho: Array,
    sigma: Array,
    apart: tuple[float, float],
    lever: Array,
    pair: PairRanges,
) -> Array:
    """Return the most likely of `turns` (near, far) after refinement by Gauss-Newton on the mutual ranges."""
    coarse = 3.0 * math.tau / SCAN * float(lever[0])

    def residuals_at(turns: Array) -> tuple[Array, Array, Array]:
        (x1, y1), (x2, y2) = place
        c1, s1, c2, s2 = (f(turns[:, i : i + 1]) for i in (0, 1) for f in (np.cos, np.sin))
        nx, ny = c1 * x1 - s1 * y1, s1 * x1 + c1 * y1
        fx, fy = c2 * x2 - s2 * y2, s2 * x2 + c2 * y2
        dx, dy = fx - nx - apart[0], fy - ny - apart[1]
        distance = np.maximum(np.hypot(dx, dy), SIGMA_FLOOR)
        by_near = (dx * ny - dy * nx) / distance
        by_far = (dy * fx - dx * fy) / distance
        return rho - distance, by_near, by_far

    for step in range(POLISHINGS):
        s = np.hypot(sigma, coarse * FINER_TURN**step)
        residual, by_near, by_far = residuals_at(turns)
        weight = mixture(residual, s, pair.noise)[1] / np.square(s)
        nn, nf, ff = (
            np.sum(weight * a * b, 1) for a, b in ((by_near, by_near), (by_near, by_far), (by_far, by_far))
        )
        gn, gf = np.sum(weight * by_near * residual, 1), np.sum(weight * by_far * residual, 1)
        damping = 1e-3 * (nn + ff) + 1e-12
        nn, ff = nn + damping, ff + damping
        determinant = nn * ff - nf * nf
        change = np.stack(((ff * gn - nf * gf) / determinant, (nn * gf - nf * gn) / determinant), 1)
        longest = np.maximum(np.abs(change).max(1, keepdims=True), 1e-12)
        turns = turns + change * np.minimum(1.0, TURN / longest)
    likely = mixture(residuals_at(turns)[0], np.hypot(sigma, FINER * coarse), pair.noise)[0]
    near = BENT * pair.sensing_range + TWINS * float(np.min(sigma))
    return _best_turns(turns, likely, lever, near, MOST)


def _best_turns(turns: Array, likely: Array, lever: Array, near: float, most: int) -> Array:
    """Return the most likely of `turns`, whose resulting positions differ by more than `near` m."""
    apart = lambda one, others: np.abs(np.remainder(others - one + math.pi, math.tau) - math.pi) @ lever  # noqa: E731
    return _distinct(turns, likely, near, most, apart)


def _distinct(
    points: Array, likely: Array, near: float, most: int, apart: Callable[[Array, Array], Array]
) -> Array:
    """Return the most likely of `points`, with more than `near` between any two by the metric `apart`."""
    left = np.flatnonzero(likely >= np.max(likely) - UNLIKELY)
    left = left[np.argsort(-likely[left], kind="stable")]
    chosen: list[int] = []
    while len(left) and len(chosen) < most:
        chosen.append(int(left[0]))
        left = left[apart(points[left[0]], points[left]) > near]
    return points[chosen]
