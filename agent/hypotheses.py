"""What a robot, or the pair, still holds possible under noise: hypotheses, each a fit, with their odds.

Closed forms give the seeds, all ranges polish them, ranges and silence weigh them. A hypothesis dies of its
odds, never of one measurement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.odometry import Array, Places, Track, wander
from agent.ranging import SIGMA_FLOOR, Ranges, mixture, turned
from agent.smoothing import STEPS, Fit, fit
from protocol.noise import Drift, Noise

ODDS_KEPT = 1e-7
"""a hypothesis that is less likely than this is given up"""

MOST = 6
"""hypotheses that are followed at once"""

SEED_RANGES = 10
"""with so many ranges to the anchor, where it may lie is settled but for the hypotheses that are left"""

NEAR = 0.02
"""of R: what seeds may be off, and how near each other they are one"""

SAME_SIGMAS = 1.0
"""two fits nearer to each other than this are one, in sigmas"""

SCAN = 72
"""headings of the robot nearer to its anchor that are tried"""

BENT = 0.1
"""of R: seeds nearer than this are one; along what the ranges leave open, a fit finds its way"""

POLISHINGS = 4

ROUGH_STEPS = 2
"""of Gauss-Newton, from a seed; then it shows which are worth more"""

WARM_STEPS = 1
"""of Gauss-Newton, from the guess of a tick ago; before a claim it is done to the end"""


class Hypothesis(NamedTuple):
    """One way in which all that was measured may have come about."""

    guess: tuple[float, ...]
    """see `ranging.predict`: of each robot, where its anchor lies in the frame of its odometry, and how
    that frame is turned in <W>"""
    odds: float
    """the probability that it is the true one; of all that are left they sum to 1"""


class Weighed(NamedTuple):
    """A hypothesis and the fit that it is."""

    hypothesis: Hypothesis
    fit: Fit
    silence: float
    """the log of how likely it makes it to have been in range where it was, and out of it where it was not"""


def with_odds(fits: Sequence[tuple[Fit, float]]) -> tuple[Weighed, ...]:
    """The likeliest first, each once; of those that are left. A fit comes with what silence says of it."""
    weighed = [(one.log_likelihood + 0.5 * _log_volume(one) + silent, one, silent) for one, silent in fits]
    weighed.sort(key=lambda one: -one[0])
    left: list[tuple[float, Fit, float]] = []
    for weight, one, silent in weighed:
        if weighed[0][0] - weight > -math.log(ODDS_KEPT) or len(left) == MOST:
            break
        if not any(_same(one, other) for _, other, _ in left):
            left.append((math.exp(weight - weighed[0][0]), one, silent))
    total = sum([odds for odds, _, _ in left])
    return tuple(
        Weighed(Hypothesis(tuple(one.guess.tolist()), odds / total), one, silent)
        for odds, one, silent in left
    )


def _same(one: Fit, other: Fit) -> bool:
    change = one.guess - other.guess
    change[2::3] = np.remainder(change[2::3] + math.pi, 2.0 * math.pi) - math.pi
    if len(change) == 3:
        change = change[:2]
    return float(change @ one.information @ change) < SAME_SIGMAS**2


def silence(beyond: Array, sigma: float, drop_outs: float) -> float:
    """The log-likelihood of as many silent ticks, by how far `beyond` R (m) each was predicted to be.

    What the prediction is off by, of standard deviation `sigma`, is common to all of them: they are one
    path. A tick that was in range after all is silent with the probability `drop_outs`.
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
"""silent ticks, the ones nearest to the beacon, that are looked at"""


def _log_cdf(x: float) -> float:
    """Of the normal distribution."""
    if x > -30.0:
        return math.log(0.5 * math.erfc(-x / math.sqrt(2.0)))
    return -0.5 * x * x - math.log(-x * math.sqrt(2.0 * math.pi))


# --- one robot and its anchor -------------------------------------------------------------------------


def of_anchor(
    before: Iterable[Hypothesis],
    path: Track,
    ranges: Ranges,
    silent: Places,
    sensing_range: float,
    noise: Noise,
) -> tuple[Weighed, ...]:
    """Where its anchor may lie in the frame of a robot's odometry: phase 1. `before` is what was left a
    tick ago; at the ticks `silent` there was no range."""
    known = tuple(before)
    lost = bool(len(silent)) and silent[-1] == len(path.x) - 1
    if known and len(ranges.rho) > SEED_RANGES and not lost:
        starts = [np.array(one.guess) for one in known]
        steps = WARM_STEPS
    else:
        places = [one.guess[:2] for one in known]
        starts = [np.array([*point, 0.0]) for point in anchors(path, ranges, sensing_range, noise, places)]
        steps = STEPS
    fits = [fit(guess, [path], ranges, noise, steps=steps) for guess in starts]
    return with_odds([(one, _within(one, 0, silent, ranges.tick, sensing_range, noise)) for one in fits])


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
    variance = np.square(ranges.sigma) + _wandered(path, ranges, noise)
    return _polished(points, path, ranges, np.sqrt(variance), noise, sensing_range)


def _within(
    one: Fit, robot: int, silent: Places, ranged: Places, sensing_range: float, noise: Noise
) -> float:
    """Of being out of its anchor's range at the ticks `silent`, and in it at those `ranged`."""
    columns = slice(3 * robot, 3 * robot + 2)
    place = one.covariance[columns, columns]
    mx, my = one.guess[columns]
    path, weight = one.paths[robot], 0.0
    for ticks, sign in ((silent, 1.0), (ranged, -1.0)):
        if not len(ticks):
            continue
        x, y = path.x[ticks] - mx, path.y[ticks] - my
        beyond = sign * (np.hypot(x, y) - sensing_range)
        worst = int(np.argmin(beyond))
        if beyond[worst] > CLEAR * sensing_range:
            continue
        u = np.array((x[worst], y[worst])) / max(math.hypot(x[worst], y[worst]), SIGMA_FLOOR)
        sigma = math.hypot(math.sqrt(float(u @ place @ u)), EDGE * sensing_range)
        if sign > 0.0:
            weight += silence(beyond, sigma, noise.drop_outs)
        else:
            weight += _log_cdf(float(beyond[worst]) / sigma)
    return weight


EDGE = 0.005
"""of R: how sharp the rim of a range is taken to be, beside what is not known of the pose"""

CLEAR = 0.5
"""of R: a tick so far out of range tells nothing by its silence"""


def missing(ticks: Places, end: int) -> Places:
    """The ticks before `end` that are not among `ticks`."""
    silent = np.ones(end, bool)
    silent[ticks] = False
    return np.flatnonzero(silent)


def _log_volume(one: Fit) -> float:
    """Of the posterior, in the unknowns: how many guesses share the likelihood of the best one."""
    return -float(np.linalg.slogdet(one.information)[1])


def _wandered(path: Track, ranges: Ranges, noise: Noise) -> Array:
    """m^2: about how much drift may move a range; without its correlations, for seeds."""
    if noise.odometry == Drift():
        return np.zeros_like(ranges.rho)
    drift = wander(path, noise.odometry, path)
    turn, bx, by, xx, _, yy = drift.sums
    lever = path.period
    position = xx + yy + 2.0 * lever * (path.y * bx - path.x * by) + lever**2 * (path.x**2 + path.y**2) * turn
    spread: Array = 0.5 * np.maximum(position, 0.0)[ranges.tick]
    return spread


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
        s = np.hypot(sigma, near * 0.1**step)
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
    likely = mixture(look(points)[0], np.hypot(sigma, near * 0.1**POLISHINGS), noise)[0]
    return _best(points, likely, near * 0.1 + 0.3 * float(np.min(sigma)))


def _best(points: Array, likely: Array, near: float) -> Array:
    """The likeliest few, no two of them nearer to each other than `near`."""
    return _distinct(points, likely, near, MOST, lambda one, others: np.abs(others - one).sum(1))


UNLIKELY = 25.0
"""in log-likelihood: a seed that is so far behind the best is left"""


# --- the pair -----------------------------------------------------------------------------------------


class Pair(NamedTuple):
    """All that both robots have measured; robot 0 is the paper's a."""

    paths: tuple[Track, Track]
    ranges: Ranges
    silent: tuple[Places, Places, Places]
    """the ticks at which a, b and the two together were not ranged"""
    apart: tuple[float, float]
    """m: M2 - M1 in <W>"""
    sensing_range: float
    noise: Noise

    def without_drift(self) -> Pair:
        """The same, with ranges as much less sure as the odometry's drift makes them."""
        if self.noise.odometry == Drift():
            return self
        variance = np.square(self.ranges.sigma)
        for robot, path in enumerate(self.paths):
            wandered = _wandered(path, self.ranges, self.noise)
            wandered[self.ranges.rows(1 - robot)] = 0.0
            variance = variance + wandered
        return self._replace(
            ranges=self.ranges._replace(sigma=np.sqrt(variance)),
            noise=replace(self.noise, odometry=Drift()),
        )


def search(pair: Pair) -> tuple[Weighed, ...]:
    """How the two may lie in <W>, wherever that is: branch of a, branch of b, and placement.

    First by fits that take the odometry's drift for noise of the ranges; then the likely ones in full.
    """
    of_a, of_b = (
        anchors(path, pair.ranges.only(robot), pair.sensing_range, pair.noise)
        for robot, path in enumerate(pair.paths)
    )
    seeds = [
        np.array([*a, theta_a, *b, theta_b])
        for a in of_a
        for b in of_b
        for theta_a, theta_b in placements(a, b, pair)
    ]
    rough = _fitted(seeds, pair.without_drift(), ROUGH_STEPS)
    return _fitted([one.fit.guess for one in rough], pair, STEPS)


def follow(before: Sequence[Hypothesis], pair: Pair) -> tuple[Weighed, ...]:
    """What is left of what was held `before`, after another tick."""
    return _fitted([np.array(one.guess) for one in before], pair, WARM_STEPS)


def _fitted(guesses: Sequence[Array], pair: Pair, steps: int) -> tuple[Weighed, ...]:
    fits = [fit(guess, pair.paths, pair.ranges, pair.noise, pair.apart, steps) for guess in guesses]
    return with_odds([(one, _silence(one, pair)) for one in fits])


def _silence(one: Fit, pair: Pair) -> float:
    """The log of how likely the fit makes it who was in range of what, and when."""
    weight = 0.0
    for robot in (0, 1):
        ranged = pair.ranges.tick[pair.ranges.rows(robot)]
        weight += _within(one, robot, pair.silent[robot], ranged, pair.sensing_range, pair.noise)
    return weight + _together(one, pair)


def _together(one: Fit, pair: Pair) -> float:
    """Of being out of each other's range at the silent ticks."""
    silent = pair.silent[2]
    if not len(silent):
        return 0.0
    (wx, wy), (vx, vy) = (turned(one.guess[3 * r : 3 * r + 3], one.paths[r], silent) for r in (0, 1))
    dx, dy = wx - vx - pair.apart[0], wy - vy - pair.apart[1]
    distance = np.hypot(dx, dy)
    k = int(np.argmin(distance))
    beyond = distance - pair.sensing_range
    if beyond[k] > CLEAR * pair.sensing_range:
        return 0.0
    nx, ny = dx[k] / max(distance[k], SIGMA_FLOOR), dy[k] / max(distance[k], SIGMA_FLOOR)
    gradient = np.empty(6)
    for robot, (x, y), sign in ((0, (wx[k], wy[k]), 1.0), (1, (vx[k], vy[k]), -1.0)):
        theta = one.guess[3 * robot + 2]
        c, s = math.cos(theta), math.sin(theta)
        gradient[3 * robot : 3 * robot + 3] = (
            -sign * (c * nx + s * ny),
            -sign * (c * ny - s * nx),
            sign * (ny * x - nx * y),
        )
    sigma = math.hypot(math.sqrt(float(gradient @ one.covariance @ gradient)), EDGE * pair.sensing_range)
    return silence(beyond, sigma, pair.noise.drop_outs)


def placements(of_a: Array, of_b: Array, pair: Pair) -> list[tuple[float, float]]:
    """Headings of the odometry frames in <W> that may explain the mutual ranges, the likeliest few.

    The anchors are at `of_a` and `of_b` (m) in these frames.

    The robot nearer to its anchor is turned through all its headings; one mutual range then leaves two
    headings of the other, where the circles about its anchor and about the first robot meet (Section III.C
    with one circle turned), and the others tell which.
    """
    mutual = pair.ranges.rows(2)
    ticks, rho, sigma = pair.ranges.tick[mutual], pair.ranges.rho[mutual], pair.ranges.sigma[mutual]
    some = np.unique(np.linspace(0, len(ticks) - 1, SEED_RANGES).round().astype(np.intp))
    ticks, rho, sigma = ticks[some], rho[some], sigma[some]
    place = [
        turned(np.array([*one, 0.0]), path, ticks) for one, path in zip((of_a, of_b), pair.paths, strict=True)
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
    lever = np.array([max(float(np.mean(radii[robot])), 0.1) for robot in (near, far)])
    wandered = sum([_wandered(path, pair.ranges, pair.noise)[mutual][some] for path in pair.paths])
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
    pair: Pair,
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
        s = np.hypot(sigma, coarse * 0.2**step)
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
        turns = turns + change * np.minimum(1.0, 0.3 / longest)
    likely = mixture(look(turns)[0], np.hypot(sigma, 0.1 * coarse), pair.noise)[0]
    near = BENT * pair.sensing_range + 0.3 * float(np.min(sigma))
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
