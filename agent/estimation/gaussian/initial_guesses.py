"""Seeds: where closed forms say that fits may begin, from a few ranges and without regard to silence.

Of an anchor: where the circles of two ranges meet. Of a placement: one robot is turned through all its
headings, and a mutual range leaves two of the other's. Each is polished by Gauss-Newton on all ranges of its
kind, odometry's drift taken for noise of theirs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from msgspec.structs import replace

from agent.estimation.gaussian.odometry_noise import Array, Track, wander
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, PairRanges, Ranges, mixture, placed
from protocol.noise import Noise, VelocityNoise

SEED_RANGES = 10
"""with so many ranges to the anchor, where it may lie is settled but for the hypotheses that are left"""

NEAR = 0.02
"""of R: what seeds may be off, and how near each other they are one"""

SCAN = 72
"""headings of the robot nearer to its anchor that are tried"""

BENT = 0.1
"""of R: seeds nearer than this are one; along what the ranges leave open, a fit finds its way"""

POLISHINGS = 4
"""steps of Gauss-Newton on a seed"""

FINER, FINER_TURN = 0.1, 0.2
"""by how much less a seed, and a heading, is taken to be off at each of them"""

TURN = 0.3
"""rad: no heading is turned by more in one of them"""

TWINS = 0.3
"""sigmas of a range: seeds nearer than this are one, too"""

SHORTEST = 0.1
"""m: a lever on a heading is taken to be no shorter"""

MOST = 6
"""hypotheses that are followed at once"""


def anchors(
    path: Track,
    ranges: Ranges,
    sensing_range: float,
    noise: Noise,
    known: Sequence[Sequence[float]] = (),
) -> Array:
    """Where its anchor may lie in the frame of a robot's odometry (m), by its ranges alone; (n, 2)."""
    points = np.concatenate((np.array(known).reshape(-1, 2), _crossings(path, ranges)))
    if not len(points):
        return points
    variance = np.square(ranges.sigma) + _loosened(path, ranges, noise)
    return _polished(points, path, ranges, np.sqrt(variance), noise, sensing_range)


def _loosened(path: Track, ranges: Ranges, noise: Noise) -> Array:
    """m^2: about how much drift may move a range, without its correlations."""
    if noise.odometry == VelocityNoise():
        return np.zeros_like(ranges.rho)
    drift = wander(path, noise.odometry, path)
    turn, bx, by, xx, _, yy = drift.sums
    lever = path.period
    position = xx + yy + 2.0 * lever * (path.y * bx - path.x * by) + lever**2 * (path.x**2 + path.y**2) * turn
    along: Array = 0.5 * np.maximum(position, 0.0)[np.minimum(ranges.tick, len(path.v))]
    return along


def _crossings(path: Track, ranges: Ranges) -> Array:
    """Where the circles of each two ranges meet, in the frame of the odometry, m; shape (n, 2).

    Circles that noise has kept apart meet half way.
    """
    if len(ranges.rho) < 2:
        return np.empty((0, 2))
    chosen = np.unique(np.linspace(0, len(ranges.rho) - 1, SEED_RANGES).round().astype(np.intp))
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
    """The most likely of `points`, each once, moved to where all ranges fit best; shape (n, 2)."""
    x, y, rho = path.x[ranges.tick], path.y[ranges.tick], ranges.rho
    near = NEAR * sensing_range

    def look(points: Array) -> tuple[Array, Array, Array, Array]:
        dx, dy = x - points[:, :1], y - points[:, 1:]
        distance = np.maximum(np.hypot(dx, dy), SIGMA_FLOOR)
        return rho - distance, dx / distance, dy / distance, distance

    for step in range(POLISHINGS):
        s = np.hypot(sigma, near * FINER**step)
        residual, ux, uy, _ = look(points)
        weight = mixture(residual, s, noise)[1] / np.square(s)
        xx, xy, yy = (np.sum(weight * a * b, 1) for a, b in ((ux, ux), (ux, uy), (uy, uy)))
        gx, gy = -np.sum(weight * ux * residual, 1), -np.sum(weight * uy * residual, 1)
        damping = 1e-6 * (xx + yy) + 1e-12
        xx, yy = xx + damping, yy + damping
        determinant = xx * yy - xy * xy
        change = np.stack(((yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant), 1)
        longest = np.maximum(np.abs(change).max(1, keepdims=True), 1e-12)
        points = points + change * np.minimum(1.0, 0.5 * sensing_range / longest)
    likely = mixture(look(points)[0], np.hypot(sigma, near * FINER**POLISHINGS), noise)[0]
    return _best(points, likely, near * FINER + TWINS * float(np.min(sigma)))


def _best(points: Array, likely: Array, near: float) -> Array:
    """The likeliest few, no two of them nearer to each other than `near`."""
    return _distinct(points, likely, near, MOST, lambda one, others: np.abs(others - one).sum(1))


UNLIKELY = 25.0
"""in log-likelihood: a seed that is so far behind the best is left"""


# --- a pair -----------------------------------------------------------------------------------------


def without_drift(pair: PairRanges) -> PairRanges:
    """The same, with ranges as much less sure as the odometry's drift makes them."""
    if pair.noise.odometry == VelocityNoise():
        return pair
    variance = np.square(pair.ranges.sigma)
    for robot, path in enumerate(pair.paths):
        loosened = _loosened(path, pair.ranges, pair.noise)
        loosened[pair.ranges.rows(1 - robot)] = 0.0
        variance = variance + loosened
    ranges = pair.ranges._replace(sigma=np.sqrt(variance))
    return pair._replace(ranges=ranges, noise=replace(pair.noise, odometry=VelocityNoise()))


def placements(of_a: Array, of_b: Array, pair: PairRanges) -> list[tuple[float, float]]:
    """Headings of the odometry frames in <W> that may explain the mutual ranges, the likeliest few.

    The anchors are at `of_a` and `of_b` (m) in these frames.

    The robot nearer to its anchor is turned through all its headings; one mutual range then leaves two
    headings of the other, where the circles about its anchor and about the first robot meet (Section III.C
    with one circle turned), and the others tell which.
    """
    mutual = pair.ranges.rows(2)
    ticks, rho, sigma = pair.ranges.tick[mutual], pair.ranges.rho[mutual], pair.ranges.sigma[mutual]
    places = pair.places if len(pair.places) >= SEED_RANGES else np.arange(len(ticks))
    some = places[np.unique(np.linspace(0, len(places) - 1, SEED_RANGES).round().astype(np.intp))]
    ticks, rho, sigma = ticks[some], rho[some], sigma[some]
    place = [
        placed(np.array([*one, 0.0]), path, ticks) for one, path in zip((of_a, of_b), pair.paths, strict=True)
    ]
    radii = [np.hypot(x, y) for x, y in place]
    near, far = (0, 1) if float(np.mean(radii[0])) < float(np.mean(radii[1])) else (1, 0)
    sign = 1.0 if far == 0 else -1.0
    dx, dy = sign * pair.apart[0], sign * pair.apart[1]  # from the far one's anchor to the near one's
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
    wandered = sum([_loosened(path, pair.ranges, pair.noise)[mutual][some] for path in pair.paths])
    turns = _turned(
        turns, [place[near], place[far]], rho, np.sqrt(np.square(sigma) + wandered), (dx, dy), lever, pair
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
    """The most likely of `turns` (near, far), polished by Gauss-Newton on the mutual ranges alone."""
    coarse = 3.0 * math.tau / SCAN * float(lever[0])

    def look(turns: Array) -> tuple[Array, Array, Array]:
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
        residual, by_near, by_far = look(turns)
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
    likely = mixture(look(turns)[0], np.hypot(sigma, FINER * coarse), pair.noise)[0]
    near = BENT * pair.sensing_range + TWINS * float(np.min(sigma))
    return _best_turns(turns, likely, lever, near, MOST)


def _best_turns(turns: Array, likely: Array, lever: Array, near: float, most: int) -> Array:
    """The likeliest of `turns`, no two of which lead nearer to each other than `near` (m)."""
    apart = lambda one, others: np.abs(np.remainder(others - one + math.pi, math.tau) - math.pi) @ lever  # noqa: E731
    return _distinct(turns, likely, near, most, apart)


def _distinct(
    points: Array, likely: Array, near: float, most: int, apart: Callable[[Array, Array], Array]
) -> Array:
    """The likeliest of `points`, no two of them nearer to each other than `near`."""
    left = np.flatnonzero(likely >= np.max(likely) - UNLIKELY)
    left = left[np.argsort(-likely[left], kind="stable")]
    chosen: list[int] = []
    while len(left) and len(chosen) < most:
        chosen.append(int(left[0]))
        left = left[apart(points[left[0]], points[left]) > near]
    return points[chosen]
