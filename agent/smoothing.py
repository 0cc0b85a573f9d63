"""Least squares over all ranges of a robot, or of both, with the odometry's drift along the path.

Unknown are, for each robot, where its anchor M lies in the frame of its odometry, and how that frame is
turned in <W>; and the errors of the odometry at every tick, of which there are many. So the fit is done in the
space of the ranges: what the odometry's noise makes of each pair of ranges is a covariance between them,
and follows from sums along the path. Gauss-Newton, with the path corrected at each step, ends at the maximum
a posteriori of the whole factor graph.

With exact odometry there is no such covariance, and the fit is that of two or six unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.noise import Drift, Noise

Array = NDArray[np.float64]
Places = NDArray[np.intp]

SIGMA_FLOOR = 1e-6
"""m: no range is taken to be better than this"""

STEPS = 8
"""of Gauss-Newton at the most"""

STILL = 1e-4
"""sigmas: a step shorter than this is the last"""

LEAP = 1.0
"""m and rad: no step is longer"""

RIDGE = 1e-12
"""of the information, added to it, so that what the ranges leave open has a large variance and not none"""

FAR = 100.0
"""m: how little an outlier is taken to tell"""


class Track(NamedTuple):
    """A robot's odometry over [0, k], in the frame of tick 0."""

    v: Array
    """m/s, over each tick; shape (k,)"""
    omega: Array
    period: float
    x: Array
    """m, at each tick; shape (k + 1,)"""
    y: Array
    heading: Array


def track(v: Array, omega: Array, period: float) -> Track:
    """Dead reckoning, eq. (1a), from the origin."""
    half = 0.5 * period * omega
    length = v * period * np.sinc(half / math.pi)
    heading = np.concatenate(([0.0], np.cumsum(period * omega)))
    course = heading[:-1] + half
    x = np.concatenate(([0.0], np.cumsum(length * np.cos(course))))
    y = np.concatenate(([0.0], np.cumsum(length * np.sin(course))))
    return Track(v, omega, period, x, y, heading)


class Wander(NamedTuple):
    """What noise in a track's v and omega does to it: sums along it, up to each tick.

    Noise e in omega at tick j moves the position at a later tick t, along u, by (lever - u . b_j) e, where
    lever = T_s u . perp(p_t); noise in v by u . s_j e.
    """

    q_v: Array
    """(m/s)^2: the variances at each tick"""
    q_omega: Array
    b: Array
    """(2, k)"""
    s: Array
    """(2, k)"""
    c0: Array
    """sum of q_omega; shape (k + 1,)"""
    c1: Array
    """of q_omega b; (2, k + 1)"""
    c2: Array
    """of q_omega b b' + q_v s s', its xx, xy, yy; (3, k + 1)"""


def wander(path: Track, drift: Drift, measured: Track) -> Wander:
    """Of `path`, whose odometry measured what `measured` says, with noise of `drift`."""
    q_v = np.square(drift.v * measured.v) + drift.v_floor**2
    q_omega = np.square(drift.omega * measured.omega) + drift.omega_floor**2
    period = path.period
    half = 0.5 * period * path.omega
    unit = period * np.sinc(half / math.pi)
    course = path.heading[:-1] + half
    c, s = np.cos(course), np.sin(course)
    length = path.v * unit
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(
            np.abs(half) < 1e-4, -half / 3.0, (np.cos(half) - np.sinc(half / math.pi)) / half
        ) * (0.5 * period * period * path.v)
    along, across = slope, 0.5 * period * length
    b = np.stack(
        (
            -period * path.y[1:] - (along * c - across * s),
            period * path.x[1:] - (along * s + across * c),
        )
    )
    shift = np.stack((unit * c, unit * s))
    products = np.stack(
        (
            q_omega * b[0] * b[0] + q_v * shift[0] * shift[0],
            q_omega * b[0] * b[1] + q_v * shift[0] * shift[1],
            q_omega * b[1] * b[1] + q_v * shift[1] * shift[1],
        )
    )
    return Wander(q_v, q_omega, b, shift, _summed(q_omega[None])[0], _summed(q_omega * b), _summed(products))


def _summed(values: Array) -> Array:
    """Of all before each tick; shape (n, k) -> (n, k + 1)."""
    sums = np.zeros((values.shape[0], values.shape[1] + 1))
    np.cumsum(values, axis=1, out=sums[:, 1:])
    return sums


class Seen(NamedTuple):
    """Along what each of N rows looks at a robot: its tick, a direction, and its lever on noise in omega."""

    tick: Places
    u: Array
    """(2, N), in the frame of the odometry; 0 where the row does not look at this robot"""
    lever: Array
    """m s; T_s where the row is a heading"""

    @staticmethod
    def positions(path: Track, tick: Places, u: Array) -> Seen:
        """Rows that look at its position."""
        return Seen(tick, u, path.period * (u[1] * path.x[tick] - u[0] * path.y[tick]))


def spread(drift: Wander, rows: Seen) -> Array:
    """m^2: the covariance, between N rows, that noise in the odometry makes; shape (N, N)."""
    at = np.minimum(rows.tick[:, None], rows.tick[None, :])
    (ux, uy), lever = rows.u, rows.lever
    c1x, c1y = drift.c1[0][at], drift.c1[1][at]
    cross = lever[:, None] * (c1x * ux + c1y * uy)
    xx, xy, yy = drift.c2[0][at], drift.c2[1][at], drift.c2[2][at]
    quadratic = ux[:, None] * (xx * ux + xy * uy) + uy[:, None] * (xy * ux + yy * uy)
    covariance: Array = lever[:, None] * lever * drift.c0[at] - cross - cross.T + quadratic
    return covariance


class Errors(NamedTuple):
    """What a fit holds the odometry's errors to be; shapes (k,)."""

    v: Array
    omega: Array

    @staticmethod
    def none(path: Track) -> Errors:
        """Before there is a fit."""
        return Errors(np.zeros_like(path.v), np.zeros_like(path.omega))

    def corrected(self, measured: Track) -> Track:
        """The path that was driven."""
        return track(measured.v + self.v, measured.omega + self.omega, measured.period)


def moved(drift: Wander, rows: Seen, errors: Errors) -> Array:
    """m: by how much `errors` move what the rows look at, to first order; shape (N,)."""
    turned = _summed(errors.omega[None])[0][rows.tick]
    shifted = _summed(errors.v * drift.s - errors.omega * drift.b)[:, rows.tick]
    move: Array = rows.lever * turned + rows.u[0] * shifted[0] + rows.u[1] * shifted[1]
    return move


def attributed(drift: Wander, rows: Seen, residuals: Array) -> Errors:
    """The odometry's errors that go with `residuals`, weighted by their inverse covariance; shape (N,)."""
    k = len(drift.q_v)
    after = [
        np.cumsum(np.bincount(rows.tick, residuals * weight, k + 1)[::-1])[::-1][1:]
        for weight in (rows.lever, rows.u[0], rows.u[1])
    ]
    lever, x, y = after
    return Errors(
        drift.q_v * (x * drift.s[0] + y * drift.s[1]),
        drift.q_omega * (lever - x * drift.b[0] - y * drift.b[1]),
    )


# --- the ranges ---------------------------------------------------------------------------------------


class Ranges(NamedTuple):
    """N ranges: whose anchor's, or mutual, and when."""

    rho: Array
    """m"""
    tick: Places
    of: Places
    """0: of robot 0 to its anchor; 1: of robot 1 to its anchor; 2: between them"""
    sigma: Array
    """m"""

    @staticmethod
    def of_lists(
        own: Sequence[tuple[int, float]],
        peer: Sequence[tuple[int, float]],
        mutual: Sequence[tuple[int, float]],
        noise: Noise,
    ) -> Ranges:
        """Ticks and ranges, as the robots have logged them."""
        lists = (own, peer, mutual)
        sigmas = (noise.anchor_sigma, noise.anchor_sigma, noise.mutual_sigma)
        return Ranges(
            np.array([rho for ranges in lists for _, rho in ranges]),
            np.array([tick for ranges in lists for tick, _ in ranges], np.intp),
            np.repeat(np.arange(3), [len(ranges) for ranges in lists]),
            np.repeat([max(sigma, SIGMA_FLOOR) for sigma in sigmas], [len(ranges) for ranges in lists]),
        )

    def within(self, sensing_range: float) -> Ranges:
        """Without those that are so long that they cannot be but outliers, who knows by how much."""
        possible = self.rho <= sensing_range + IMPOSSIBLE * self.sigma
        return self if np.all(possible) else Ranges(*[column[possible] for column in self])


IMPOSSIBLE = 6.0
"""sigmas beyond R"""


class Predicted(NamedTuple):
    """What a guess predicts of N ranges."""

    distance: Array
    """m; (N,)"""
    jacobian: Array
    """by the unknowns; (N, 3 robots)"""
    seen: tuple[Seen, ...]
    """of each robot"""


def predict(guess: Array, paths: Sequence[Track], ranges: Ranges, apart: tuple[float, float]) -> Predicted:
    """`guess`: of each robot the anchor's x, y in the frame of its odometry, and the frame's heading in <W>.

    `apart` is M2 - M1 in <W>, in m. With one path only the ranges to its anchor count, and the heading is
    unknowable: shape (3,) or (6,).
    """
    n = len(ranges.rho)
    jacobian = np.zeros((n, len(guess)))
    local, world = [], []
    for robot, path in enumerate(paths):
        mx, my, theta = guess[3 * robot : 3 * robot + 3]
        x, y = path.x[ranges.tick] - mx, path.y[ranges.tick] - my
        c, s = math.cos(theta), math.sin(theta)
        local.append((x, y, c, s))
        world.append((c * x - s * y, s * x + c * y))
    if len(paths) > 1:
        dx = world[0][0] - world[1][0] - apart[0]
        dy = world[0][1] - world[1][1] - apart[1]
    else:
        dx = dy = np.zeros(n)
    mutual = ranges.of == 2
    gap = np.where(mutual, np.hypot(dx, dy), 1.0)
    gap = np.where(gap > 0.0, gap, 1.0)
    nx, ny = dx / gap, dy / gap
    distance = np.where(mutual, gap, 0.0)
    seen = []
    for robot, (path, (x, y, c, s), (wx, wy)) in enumerate(zip(paths, local, world, strict=True)):
        own = ranges.of == robot
        rho = np.hypot(x, y)
        safe = np.where(rho > 0.0, rho, 1.0)
        sign = 1.0 if robot == 0 else -1.0
        ux = np.where(own, x / safe, np.where(mutual, sign * (c * nx + s * ny), 0.0))
        uy = np.where(own, y / safe, np.where(mutual, sign * (c * ny - s * nx), 0.0))
        distance = np.where(own, rho, distance)
        jacobian[:, 3 * robot] = -ux
        jacobian[:, 3 * robot + 1] = -uy
        jacobian[:, 3 * robot + 2] = np.where(mutual, sign * (ny * wx - nx * wy), 0.0)
        seen.append(Seen.positions(path, ranges.tick, np.stack((ux, uy))))
    return Predicted(distance, jacobian, tuple(seen))


class Fit(NamedTuple):
    """The most probable guess near where it was begun, and what is known about it."""

    guess: Array
    paths: tuple[Track, ...]
    """as driven, by this fit"""
    log_likelihood: float
    """of the ranges, the odometry's errors integrated out"""
    residuals: Array
    """m; (N,)"""
    weights: Array
    """(N,): how probable it is that each is no outlier"""
    covariance: Array
    """of the guess"""
    chi2: float
    """the squared innovations of what is no outlier, over their covariance"""
    predicted: Predicted
    drifts: tuple[Wander, ...]
    solved: Solved


def fit(
    guess: Array,
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = STEPS,
) -> Fit:
    """Gauss-Newton from `guess` (see `predict`); outliers lose their weight on the way."""
    free = slice(0, 2) if len(measured) == 1 else slice(0, 6)
    paths = tuple(measured)
    errors: tuple[Errors, ...] = ()
    guess = guess.copy()
    weights = np.ones_like(ranges.rho)
    for step in range(steps + 1):
        predicted = predict(guess, paths, ranges, apart)
        residuals = ranges.rho - predicted.distance
        drifts = (
            tuple(wander(path, noise.odometry, was) for path, was in zip(paths, measured, strict=True))
            if noise.odometry != Drift()
            else ()
        )
        if noise.outliers and step == 0:
            sigma = (
                np.sqrt(
                    np.square(ranges.sigma)
                    + sum(
                        [
                            np.diagonal(spread(one, seen))
                            for one, seen in zip(drifts, predicted.seen, strict=True)
                        ],
                        np.zeros_like(ranges.sigma),
                    )
                )
                if drifts
                else ranges.sigma
            )
            weights = mixture(residuals, sigma, noise)[1]
        solved = _solved(predicted, residuals, weights, ranges.sigma, drifts, errors, free)
        if noise.outliers and step:
            weights = _trust(solved, residuals, weights, ranges.sigma, noise)
            solved = _solved(predicted, residuals, weights, ranges.sigma, drifts, errors, free)
        change = solved.change
        if step == steps or float(change @ solved.information @ change) < STILL**2:
            break
        longest = float(np.max(np.abs(change)))
        if longest > LEAP:
            change = change * (LEAP / longest)
        guess[free] += change
        if drifts:
            multipliers = solved.weighted[:, -1] - solved.weighted[:, :-1] @ change
            errors = tuple(
                attributed(one, seen, multipliers) for one, seen in zip(drifts, predicted.seen, strict=True)
            )
            paths = tuple(error.corrected(was) for error, was in zip(errors, measured, strict=True))
    return Fit(
        guess,
        paths,
        _log_likelihood(solved, residuals, weights, ranges.sigma, noise),
        residuals,
        weights,
        solved.covariance,
        _misfit(solved),
        predicted,
        drifts,
        solved,
    )


class Solved(NamedTuple):
    """One step of Gauss-Newton."""

    jacobian: Array
    weighted: Array
    """the inverse covariance of the ranges, times the Jacobian and the innovation; (N, unknowns + 1)"""
    information: Array
    covariance: Array
    change: Array
    innovation: Array
    of_ranges: Array
    """m^2: the covariance of the ranges; (N, N), or its diagonal where odometry is exact"""


def _solved(predicted, residuals, weights, sigma, drifts, errors, free):
    variance = _variance(sigma, weights)
    jacobian = predicted.jacobian[:, free]
    innovation = residuals
    columns = np.column_stack
    if drifts:
        of_ranges = np.diag(variance)
        for one, seen in zip(drifts, predicted.seen, strict=True):
            of_ranges += spread(one, seen)
        for one, seen, error in zip(drifts, predicted.seen, errors, strict=False):
            innovation = innovation + moved(one, seen, error)
        weighted = np.linalg.solve(of_ranges, np.column_stack((jacobian, innovation)))
    else:
        of_ranges = variance
        weighted = np.column_stack((jacobian, innovation)) / variance[:, None]
    information = jacobian.T @ weighted[:, :-1]
    information.flat[:: len(information) + 1] += RIDGE + RIDGE * np.diagonal(information)
    covariance = np.linalg.inv(information)
    return Solved(
        jacobian,
        weighted,
        information,
        covariance,
        covariance @ (jacobian.T @ weighted[:, -1]),
        innovation,
        of_ranges,
    )


def _variance(sigma: Array, weights: Array) -> Array:
    """m^2: of each range; large where it has no weight."""
    variance: Array = np.square(sigma) / np.maximum(weights, np.square(sigma / FAR))
    return variance


def _trust(solved, residuals, weights, sigma, noise):
    """How probable it is that each range is no outlier: by what all others predict of it."""
    if solved.of_ranges.ndim == 2:
        inverse = np.linalg.inv(solved.of_ranges)
        diagonal = np.diagonal(inverse)
    else:
        diagonal = 1.0 / solved.of_ranges
    weighted = solved.weighted[:, :-1]
    precision = diagonal - np.einsum("ij,jk,ik->i", weighted, solved.covariance, weighted)
    multipliers = solved.weighted[:, -1] - weighted @ solved.change
    used = _variance(sigma, weights)
    precision = np.maximum(precision, 1e-9 * diagonal)
    error = multipliers / precision
    variance = np.maximum(1.0 / precision - used, 0.0) + np.square(sigma)
    least, most = noise.outlier_bias
    s = np.sqrt(variance)
    sure = (
        math.log1p(-noise.outliers) - 0.5 * np.square(error) / variance - np.log(s * math.sqrt(2.0 * math.pi))
    )
    beyond = np.maximum(np.maximum(least - error, error - most), 0.0)
    doubtful = (
        math.log(noise.outliers) - math.log(max(most - least, SIGMA_FLOOR)) - 0.5 * np.square(beyond / s)
    )
    return 1.0 / (1.0 + np.exp(np.clip(doubtful - sure, -700.0, 700.0)))


def _misfit(solved: Solved) -> float:
    multipliers = solved.weighted[:, -1] - solved.weighted[:, :-1] @ solved.change
    return float(solved.innovation @ multipliers)


def _log_likelihood(solved, residuals, weights, sigma, noise):
    misfit = _misfit(solved)
    sure = weights > 0.5
    used = _variance(sigma, weights)
    if solved.of_ranges.ndim == 2:
        volume = float(np.linalg.slogdet(solved.of_ranges)[1])
    else:
        volume = float(np.sum(np.log(used)))
    volume -= float(np.sum(np.log(used[~sure])))
    known = int(np.count_nonzero(sure))
    log_likelihood = -0.5 * (misfit + volume + math.log(2.0 * math.pi) * known)
    if noise.outliers:
        least, most = noise.outlier_bias
        out = residuals[~sure]
        beyond = np.maximum(np.maximum(least - out, out - most), 0.0)
        log_likelihood += known * math.log1p(-noise.outliers) + len(out) * (
            math.log(noise.outliers) - math.log(max(most - least, SIGMA_FLOOR))
        )
        log_likelihood -= 0.5 * float(np.sum(np.square(beyond / np.maximum(sigma[~sure], 0.1 * least))))
    return log_likelihood


def poses(fitted: Fit, apart):
    """In <W> (relative to M1): the mean (6,) and covariance (6, 6) of both robots' poses at the last tick."""
    guess, predicted, solved = fitted.guess, fitted.predicted, fitted.solved
    mean = np.empty(6)
    turn = np.zeros((6, 6))
    rows = []
    for robot, path in enumerate(fitted.paths):
        mx, my, theta = guess[3 * robot : 3 * robot + 3]
        c, s = math.cos(theta), math.sin(theta)
        x, y = float(path.x[-1]) - mx, float(path.y[-1]) - my
        wx, wy = c * x - s * y, s * x + c * y
        i = 3 * robot
        mean[i : i + 3] = wx, wy, theta + float(path.heading[-1])
        turn[i : i + 3, i : i + 3] = ((-c, s, -wy), (-s, -c, wx), (0.0, 0.0, 1.0))
        if robot == 1:
            mean[3] += apart[0]
            mean[4] += apart[1]
        if fitted.drifts:
            end = np.full(3, len(path.v), np.intp)
            u = np.array(((c, s, 0.0), (-s, c, 0.0)))
            seen = Seen.positions(path, end, u)
            seen.lever[2] = path.period
            rows.append(seen)
    if not fitted.drifts:
        return mean, turn @ solved.covariance @ turn.T
    prior = np.zeros((6, 6))
    cross = np.zeros((6, len(solved.innovation)))
    for robot, (drift, seen, row) in enumerate(zip(fitted.drifts, predicted.seen, rows, strict=True)):
        i = 3 * robot
        both = Seen(
            np.concatenate((row.tick, seen.tick)),
            np.concatenate((row.u, seen.u), axis=1),
            np.concatenate((row.lever, seen.lever)),
        )
        all_of_them = spread(drift, both)
        prior[i : i + 3, i : i + 3] = all_of_them[:3, :3]
        cross[i : i + 3] = all_of_them[:3, 3:]
    gain = np.linalg.solve(solved.of_ranges, cross.T).T
    left = turn - gain @ solved.jacobian
    return mean, prior - gain @ cross.T + left @ solved.covariance @ left.T


def mixture(residuals: Array, sigma: Array, noise: Noise) -> tuple[Array, Array]:
    """Log-likelihoods (summed over the last axis) and weights of residuals, outliers taken into account."""
    sure = -0.5 * np.square(residuals / sigma) - np.log(sigma) - 0.5 * math.log(2.0 * math.pi)
    if not noise.outliers:
        return np.sum(sure, -1), np.ones_like(residuals)
    least, most = noise.outlier_bias
    beyond = np.maximum(np.maximum(least - residuals, residuals - most), 0.0)
    sure = sure + math.log1p(-noise.outliers)
    doubtful = (
        math.log(noise.outliers) - np.log(np.maximum(most - least, sigma)) - 0.5 * np.square(beyond / sigma)
    )
    both = np.logaddexp(sure, doubtful)
    return np.sum(both, -1), np.exp(sure - both)
