"""What a robot, or the pair, still holds possible under noise: hypotheses, each a fit, with their probability.

Each begins at a seed (see `seeding`) and is fitted to all ranges; ranges and silence weigh it. A hypothesis
dies of its probability, never of one measurement.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.initial_guesses import MOST, SEED_RANGES, anchors, placements, without_drift
from agent.estimation.gaussian.least_squares import STEPS, Fit, deviation, fit
from agent.estimation.gaussian.odometry_noise import Array, Places, Track
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, PairRanges, Ranges, placed
from protocol.noise import Noise

ODDS_KEPT = 1e-7
"""a hypothesis that is less likely than this is given up"""

SAME_SIGMAS = 1.0
"""two fits nearer to each other than this are one, in sigmas"""

ROUGH_STEPS = 2
"""of Gauss-Newton, from a seed; then it shows which are worth more"""

WARM_STEPS = 1
"""of Gauss-Newton, from the guess of a tick ago; before a claim it is done to the end"""


class Hypothesis(NamedTuple):
    """One way in which all that was measured may have come about."""

    guess: tuple[float, ...]
    """see `ranging.predict`: of each robot, where its anchor lies in the frame of its odometry, and how
    that frame is turned in <W>"""
    probability: float
    """the probability that it is the true one; of all that are left they sum to 1"""


class ScoredHypothesis(NamedTuple):
    """A hypothesis and the fit that it is."""

    hypothesis: Hypothesis
    fit: Fit
    silence: float
    """the log of how likely it makes it to have been in range where it was, and out of it where it was not"""


def with_probability(fits: Sequence[tuple[Fit, float]]) -> tuple[ScoredHypothesis, ...]:
    """The likeliest first, each once; of those that are left. A fit comes with what silence says of it."""
    scored = [(one.log_likelihood + 0.5 * _log_volume(one) + silent, one, silent) for one, silent in fits]
    scored.sort(key=lambda one: -one[0])
    left: list[tuple[float, Fit, float]] = []
    for weight, one, silent in scored:
        if scored[0][0] - weight > -math.log(ODDS_KEPT) or len(left) == MOST:
            break
        if not any(_same(one, other) for _, other, _ in left):
            left.append((math.exp(weight - scored[0][0]), one, silent))
    total = sum([probability for probability, _, _ in left])
    return tuple(
        ScoredHypothesis(Hypothesis(tuple(one.guess.tolist()), probability / total), one, silent)
        for probability, one, silent in left
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
) -> tuple[ScoredHypothesis, ...]:
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
    return with_probability(
        [(one, _within(one, 0, silent, ranges.tick, sensing_range, noise)) for one in fits]
    )


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
        sigma = math.hypot(deviation(float(u @ place @ u)), EDGE * sensing_range)
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


# --- the pair -----------------------------------------------------------------------------------------


def search(pair: PairRanges) -> tuple[ScoredHypothesis, ...]:
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
    rough = _fitted(seeds, without_drift(pair), ROUGH_STEPS)
    return _fitted([one.fit.guess for one in rough], pair, STEPS)


def follow(before: Sequence[Hypothesis], pair: PairRanges) -> tuple[ScoredHypothesis, ...]:
    """What is left of what was held `before`, after another tick."""
    return _fitted([np.array(one.guess) for one in before], pair, WARM_STEPS)


def _fitted(guesses: Sequence[Array], pair: PairRanges, steps: int) -> tuple[ScoredHypothesis, ...]:
    fits = [fit(guess, pair.paths, pair.ranges, pair.noise, pair.apart, steps) for guess in guesses]
    return with_probability([(one, _silence(one, pair)) for one in fits])


def _silence(one: Fit, pair: PairRanges) -> float:
    """The log of how likely the fit makes it who was in range of what, and when."""
    weight = 0.0
    for robot in (0, 1):
        ranged = pair.ranges.tick[pair.ranges.rows(robot)]
        weight += _within(one, robot, pair.silent[robot], ranged, pair.sensing_range, pair.noise)
    return weight + _together(one, pair)


def _together(one: Fit, pair: PairRanges) -> float:
    """Of being out of each other's range at the silent ticks."""
    silent = pair.silent[2]
    if not len(silent):
        return 0.0
    (wx, wy), (vx, vy) = (placed(one.guess[3 * r : 3 * r + 3], one.paths[r], silent) for r in (0, 1))
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
    sigma = math.hypot(deviation(float(gradient @ one.covariance @ gradient)), EDGE * pair.sensing_range)
    return silence(beyond, sigma, pair.noise.drop_outs)
