"""Least squares over all ranges of a robot, or of both, with the odometry's drift along the path.

Unknown are, for each robot, where its anchor lies in the frame of its odometry, and how that frame is
turned in <W>; and the errors of the odometry at every tick, of which there are many. So the fit is done in
the space of the ranges: what the odometry's noise makes of each two of them is a covariance. Gauss-Newton,
with the path corrected at each step, ends at the maximum a posteriori of the whole factor graph.

With exact odometry there is no such covariance, and the fit is that of two or six unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    OdometryNoiseModel,
    Places,
    Projection,
    Track,
    attributed,
    shifted,
    spread,
    wander,
)
from agent.estimation.gaussian.range_model import Ranges, mixture, outliers, predict
from protocol.noise import Noise, VelocityNoise

STEPS = 8
"""of Gauss-Newton at the most"""

STILL = 1e-4
"""sigmas: a step shorter than this is the last"""

SETTLED = 1e-2
"""weights that change by less than this are what they will be"""

LEAP = 1.0
"""m and rad: no step is longer"""

RIDGE = 1e-12
"""of the information, added to it, so that what the ranges leave open has a large variance and not none"""

FAR = 100.0
"""m: how little an outlier is taken to tell"""

GRAIN = 1e-12
"""of the largest variance that drift makes: no range is taken to be better, so that floats can tell it"""

BLIND = 1e-9
"""of a range's information: what the others say of it is taken to be no less than this"""


class Fit(NamedTuple):
    """The most probable guess near where it was begun, and what is known about it."""

    guess: Array
    paths: tuple[Track, ...]
    """as driven, by this fit"""
    errors: tuple[Errors, ...]
    """of the odometry, by this fit; none where it is exact"""
    log_likelihood: float
    """of the ranges, the odometry's errors integrated out"""
    residuals: Array
    """m; (N,)"""
    weights: Array
    """how probable it is that each range is no outlier; (N,)"""
    covariance: Array
    """of the guess: (2, 2) of one robot's, whose heading is unknowable, or (6, 6)"""
    information: Array
    """its inverse"""
    chi2: float
    """the squared innovations, over their covariance"""
    last_step: float
    """sigmas: the step of Gauss-Newton that would have come next"""
    ticks: Places
    """of the ranges"""
    directions: tuple[Array, ...]
    """see `Predicted`"""
    drifts: tuple[OdometryNoiseModel, ...]
    """along each path; none where odometry is exact"""
    system: NormalEquations


class NormalEquations(NamedTuple):
    """One step of Gauss-Newton: what is left to explain, and in which units."""

    jacobian: Array
    """(N, unknowns)"""
    innovation: Array
    """m: what the ranges are off from where the odometry, uncorrected, puts them; (N,)"""
    covariance: Array
    """m^2: of the ranges; (N, N), or its diagonal where odometry is exact"""
    weighted: Array
    """its inverse, times the Jacobian and the innovation; (N, unknowns + 1)"""
    inverse: Array | None
    """of the covariance, where its diagonal is asked for"""
    information: Array
    of_guess: Array
    """the covariance of the guess"""
    change: Array
    """of the guess"""
    multipliers: Array
    """the innovation that is left after the change, weighted; (N,)"""


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
    paths: tuple[Track, ...] = tuple(measured)
    drifts: tuple[OdometryNoiseModel, ...] = ()
    errors: tuple[Errors, ...] = ()
    guess, weights = guess.copy(), np.ones_like(ranges.rho)
    drifting = noise.odometry != VelocityNoise()
    for step in range(steps + 1):
        predicted = predict(guess, paths, ranges, apart)
        residuals = ranges.rho - predicted.distance
        wandered, innovation = None, residuals
        if drifting:
            seen = predicted.seen(paths, ranges)
            drifts = tuple(
                [wander(path, noise.odometry, was) for path, was in zip(paths, measured, strict=True)]
            )
            wandered = _wandered(drifts, seen)
            for drift, rows, error in zip(drifts, seen, errors, strict=False):
                innovation = innovation + shifted(drift, rows, error)
        if noise.outliers and step == 0:
            loose = np.zeros_like(residuals) if wandered is None else np.diagonal(wandered)
            weights = mixture(residuals, np.sqrt(np.square(ranges.sigma) + loose), noise)[1]
        variance = _variance(ranges.sigma, weights)
        system = _solved(predicted.jacobian[:, free], innovation, variance, wandered, bool(noise.outliers))
        trust = _trust(system, weights, ranges.sigma, noise) if noise.outliers else weights
        change = system.change
        last_step = math.sqrt(abs(float(change @ system.information @ change)))
        still = last_step < STILL and float(np.max(np.abs(trust - weights))) < SETTLED
        if step == steps or (still and (errors or not drifting)):  # a path is corrected at least once
            break
        weights = trust
        change = change * min(1.0, LEAP / max(float(np.max(np.abs(change))), LEAP))
        guess[free] += change
        if drifting:
            left = system.weighted[:, -1] - system.weighted[:, :-1] @ change
            errors = tuple([attributed(drift, rows, left) for drift, rows in zip(drifts, seen, strict=True)])
            paths = tuple([error.corrected(was) for error, was in zip(errors, measured, strict=True)])
    chi2 = float(system.innovation @ system.multipliers)
    return Fit(
        guess,
        paths,
        errors,
        _log_likelihood(system, chi2, residuals, weights, ranges.sigma, noise),
        residuals,
        weights,
        system.of_guess,
        system.information,
        chi2,
        last_step,
        ranges.tick,
        predicted.directions,
        drifts,
        system,
    )


def _wandered(drifts: Sequence[OdometryNoiseModel], seen: Sequence[Projection]) -> Array:
    """m^2: the covariance that all robots' odometry makes between the ranges; (N, N)."""
    first, *others = [spread(drift, rows) for drift, rows in zip(drifts, seen, strict=True)]
    for other in others:
        first += other
    return first


def _variance(sigma: Array, weights: Array) -> Array:
    """m^2: of each range; large where it has no weight."""
    variance: Array = np.square(sigma) / np.maximum(weights, np.square(sigma / FAR))
    return variance


def _solved(
    jacobian: Array, innovation: Array, variance: Array, wandered: Array | None, invert: bool
) -> NormalEquations:
    columns = np.column_stack((jacobian, innovation))
    covariance, inverse = variance, None
    weighted: Array
    if wandered is None:
        weighted = columns / variance[:, None]
    else:
        covariance = wandered + np.diag(variance + GRAIN * float(np.max(np.diagonal(wandered))))
        if invert:
            inverse = inverse_of(covariance)
            weighted = np.dot(inverse, columns)
        else:
            weighted = np.asarray(np.linalg.solve(covariance, columns), np.float64)
    information = jacobian.T @ weighted[:, :-1]
    information.flat[:: len(information) + 1] += RIDGE + RIDGE * np.diagonal(information)
    of_guess = inverse_of(information)
    change = of_guess @ (jacobian.T @ weighted[:, -1])
    multipliers = weighted[:, -1] - weighted[:, :-1] @ change
    return NormalEquations(
        jacobian, innovation, covariance, weighted, inverse, information, of_guess, change, multipliers
    )


def deviation(variance: float) -> float:
    """The standard deviation; infinite where rounding has left a variance that is none."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def inverse_of(matrix: Array) -> Array:
    """Of one matrix, or of each of several."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _trust(system: NormalEquations, weights: Array, sigma: Array, noise: Noise) -> Array:
    """How probable it is that each range is no outlier, by what all the others predict of it."""
    alone = 1.0 / system.covariance if system.inverse is None else np.diagonal(system.inverse)
    explained = np.sum((system.weighted[:, :-1] @ system.of_guess) * system.weighted[:, :-1], 1)
    precision = np.maximum(alone - explained, BLIND * alone)
    error = system.multipliers / precision
    variance = np.maximum(1.0 / precision - _variance(sigma, weights), 0.0) + np.square(sigma)
    return mixture(error, np.sqrt(variance), noise)[1]


def _log_likelihood(
    system: NormalEquations, chi2: float, residuals: Array, weights: Array, sigma: Array, noise: Noise
) -> float:
    """Of what is no outlier, by its covariance; and of outliers by their bias."""
    good = weights > 0.5
    if system.covariance.ndim == 2:
        volume = float(np.linalg.slogdet(system.covariance)[1])
    else:
        volume = float(np.sum(np.log(system.covariance)))
    volume -= float(np.sum(np.log(_variance(sigma, weights)[~good])))
    count = int(np.count_nonzero(good))
    log_likelihood = -0.5 * (chi2 + volume + math.log(2.0 * math.pi) * count)
    if noise.outliers:
        log_likelihood += count * math.log1p(-noise.outliers)
        log_likelihood += float(
            np.sum(outliers(residuals[~good], np.maximum(sigma[~good], SOFT * noise.outlier_bias[0]), noise))
        )
    return log_likelihood


SOFT = 0.1
"""of the least bias: how sharply its density ends, where the range itself is exact"""


def poses(fitted: Fit, apart: tuple[float, float]) -> tuple[Array, Array]:
    """Of both robots at the last tick, relative to M1 along the axes of <W>: x, y, heading of a, then of b.

    The mean (6,) and the covariance (6, 6), in m and rad.
    """
    mean, turn = np.empty(6), np.zeros((6, 6))
    ends = []
    for robot, path in enumerate(fitted.paths):
        mx, my, theta = fitted.guess[3 * robot : 3 * robot + 3]
        c, s = math.cos(theta), math.sin(theta)
        x, y = float(path.x[-1]) - mx, float(path.y[-1]) - my
        wx, wy = c * x - s * y, s * x + c * y
        i = 3 * robot
        mean[i : i + 3] = wx + robot * apart[0], wy + robot * apart[1], theta + float(path.heading[-1])
        turn[i : i + 3, i : i + 3] = ((-c, s, -wy), (-s, -c, wx), (0.0, 0.0, 1.0))
        last = np.full(3, len(path.v), np.intp)
        end = Projection.positions(path, last, np.array(((c, s, 0.0), (-s, c, 0.0))))
        end.lever[2] = path.period
        ends.append(end)
    system = fitted.system
    if not fitted.drifts:
        return mean, turn @ system.of_guess @ turn.T
    prior, cross = np.zeros((6, 6)), np.zeros((6, len(system.innovation)))
    for robot, (path, drift, u, end) in enumerate(
        zip(fitted.paths, fitted.drifts, fitted.directions, ends, strict=True)
    ):
        rows = slice(3 * robot, 3 * robot + 3)
        both = spread(drift, end.then(Projection.positions(path, fitted.ticks, u)))
        prior[rows, rows], cross[rows] = both[:3, :3], both[:3, 3:]
    gain = np.linalg.solve(system.covariance, cross.T).T
    left = turn - gain @ system.jacobian
    return mean, prior - gain @ cross.T + left @ system.of_guess @ left.T
