"""Least squares over all ranges of one robot or of both, with odometry noise along the path.

The unknowns are, for each robot, the position of its anchor in the frame of its odometry and the rotation of
that frame in <W>, and also the odometry errors at every tick. Because there are so many of the latter, the
fit is done in the space of the ranges, where odometry noise becomes a covariance between each two ranges.
Gauss-Newton, with the path corrected at each step, converges to the maximum a posteriori of the whole factor
graph.

With exact odometry there is no such covariance, and the fit has only two or six unknowns.
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
    constant_effects,
    constant_errors,
    is_noisy,
    shifted,
    spread,
    wander,
)
from agent.estimation.gaussian.range_covariance import RangeCovariance, inverse_of, range_covariance
from agent.estimation.gaussian.range_model import Ranges, mixture, outliers, predict
from protocol.noise import Noise, VelocityNoise

STEPS = 8
"""The maximum number of Gauss-Newton steps."""

STILL = 1e-4
"""The length of a step in sigmas below which the iteration stops."""

SETTLED = 1e-2
"""The change of a weight below which the weights have converged."""

LEAP = 1.0
"""The largest change of an unknown, in m and rad, in one step."""

RIDGE = 1e-12
"""The fraction of the information that is added to its diagonal, and an absolute part of the same size.

With it, the variance of an unknown that the ranges leave undetermined is large but finite.
"""

FAR = 100.0
"""The standard deviation (m) of a range with the weight 0."""

BLIND = 1e-9
"""The least precision of a range's prediction, as a fraction of that with a known guess."""


class Fit(NamedTuple):
    """The most probable guess in the neighbourhood of the initial one, with its uncertainty."""

    guess: Array
    paths: tuple[Track, ...]
    """The paths with the odometry errors corrected."""
    errors: tuple[Errors, ...]
    """The estimated odometry errors of each path; empty if odometry is exact."""
    log_likelihood: float
    """The log-likelihood of the ranges, with all errors of the odometry and the noise level integrated out.

    With half the log-determinant of `covariance`, it is the evidence for the guess and its neighbourhood.
    """
    residuals: Array
    """The measured minus the predicted ranges (m); shape (N,)."""
    weights: Array
    """The probability that each range is an inlier; shape (N,)."""
    covariance: Array
    """The covariance of the guess: (2, 2) for one robot, whose rotation is not observable, or (6, 6)."""
    information: Array
    """The inverse of the covariance."""
    chi2: float
    """The squared innovations, weighted by their inverse covariance; as told, without `level`."""
    inliers: int
    """The number of ranges that are more probably inliers than outliers."""
    last_step: float
    """The length of the next Gauss-Newton step, in sigmas."""
    ticks: Places
    """The tick of each range; shape (N,)."""
    directions: tuple[Array, ...]
    """The derivatives of the ranges with respect to the positions; see `Predicted`."""
    drifts: tuple[OdometryNoiseModel, ...]
    """The noise model along each path; empty if odometry is exact."""
    system: NormalEquations
    level: float
    """The estimate of the noise level tau^2: the factor by which all variances differ from the told ones."""


class NormalEquations(NamedTuple):
    """One Gauss-Newton step in the space of the ranges."""

    jacobian: Array
    """The derivatives of the ranges with respect to the unknowns; shape (N, unknowns)."""
    innovation: Array
    """The difference (m) of the ranges from their prediction with uncorrected odometry; shape (N,)."""
    covariance: RangeCovariance
    weighted: Array
    """The Jacobian and the innovation, multiplied by the inverse covariance; shape (N, unknowns + 1)."""
    information: Array
    of_guess: Array
    """The covariance of the guess, the inverse of the information."""
    change: Array
    """The change of the guess in this step."""
    multipliers: Array
    """The innovation that remains after the change, multiplied by the inverse covariance; shape (N,)."""


def fit(
    guess: Array,
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = STEPS,
) -> Fit:
    """Return the Gauss-Newton fit that begins at `guess` (see `predict`).

    The weights of outliers decrease during the iteration. `apart` is M2 - M1 (m) in <W>.
    """
    free = slice(0, 2) if len(measured) == 1 else slice(0, 6)
    paths: tuple[Track, ...] = tuple(measured)
    drifts: tuple[OdometryNoiseModel, ...] = ()
    errors: tuple[Errors, ...] = ()
    guess, weights, level = guess.copy(), np.ones_like(ranges.rho), 1.0
    common = ranges.common_errors(noise.priors)
    slow = ranges.slow_errors(noise.priors, measured[0].period)
    noisy_odometry, robust = is_noisy(noise), bool(noise.outliers or noise.strays)
    patterns = [constant_errors(path, noise) for path in measured] if noisy_odometry else []
    for step in range(steps + 1):
        predicted = predict(guess, paths, ranges, apart)
        residuals = ranges.rho - predicted.distance
        dense, columns, innovation = slow, common, residuals
        if noisy_odometry:
            seen = predicted.seen(paths, ranges)
            drifts = tuple(
                [
                    wander(path, noise.odometry, was, pattern)
                    for path, was, pattern in zip(paths, measured, patterns, strict=True)
                ]
            )
            if noise.odometry != VelocityNoise():
                dense = _odometry_covariance(drifts, seen)
                if slow is not None:
                    dense += slow
            columns = np.concatenate((common, *map(constant_effects, drifts, seen)), 1)
            for model, rows, error in zip(drifts, seen, errors, strict=False):
                innovation = innovation + shifted(model, rows, error)
        if robust and step == 0:
            loose = np.square(ranges.sigma) + np.sum(np.square(columns), 1)
            if dense is not None:
                loose += np.diagonal(dense)
            weights = _weights(residuals, np.sqrt(loose), noise)
        covariance = range_covariance(_variance(ranges.sigma, weights), columns, dense)
        system = _solved(predicted.jacobian[:, free], innovation, covariance)
        updated = _inlier_probabilities(system, weights, ranges.sigma, noise) if robust else weights
        change = system.change
        chi2 = max(float(system.innovation @ system.multipliers), 0.0)
        inliers = int(np.count_nonzero(weights > INLIER))
        level = noise_level(chi2, inliers - len(change), noise)
        last_step = math.sqrt(abs(float(change @ system.information @ change)) / level)
        still = last_step < STILL and float(np.max(np.abs(updated - weights))) < SETTLED
        if step == steps or (still and (errors or not noisy_odometry)):  # the path is corrected at least once
            break
        weights = updated
        change = change * min(1.0, LEAP / max(float(np.max(np.abs(change))), LEAP))
        guess[free] += change
        if noisy_odometry:
            left = system.weighted[:, -1] - system.weighted[:, :-1] @ change
            errors = tuple([attributed(model, rows, left) for model, rows in zip(drifts, seen, strict=True)])
            paths = tuple([error.corrected(was) for error, was in zip(errors, measured, strict=True)])
    return Fit(
        guess,
        paths,
        errors,
        _log_likelihood(system, chi2, residuals, weights, ranges.sigma, level, noise),
        residuals,
        weights,
        level * system.of_guess,
        system.information / level,
        chi2,
        inliers,
        last_step,
        ranges.tick,
        predicted.directions,
        drifts,
        system,
        level,
    )


INLIER = 0.5
"""The weight from which on a range counts as an inlier."""


def noise_level(chi2: float, degrees: int, noise: Noise) -> float:
    """Return the posterior mean of the factor tau^2 of all variances (scaled inverse chi-square)."""
    nu, n = noise.sigma_degrees, max(degrees, 0)
    if not nu:
        return 1.0
    return (nu + chi2) / (nu + n) if chi2 >= n else (CAUTION * nu + chi2) / (CAUTION * nu + n)


CAUTION = 4.0
"""The factor of `sigma_degrees` for residuals that are smaller than told.

A noise level that is too low ends phase 1 too early, and the robots miss each other. With 1, few ranges that
agree by chance make missions at a sigma of 0.05 m last 15 % longer.
"""


def _odometry_covariance(drifts: Sequence[OdometryNoiseModel], seen: Sequence[Projection]) -> Array:
    """Return the covariance (m^2) of the ranges from the odometry noise of all robots; shape (N, N)."""
    first, *others = [spread(model, rows) for model, rows in zip(drifts, seen, strict=True)]
    for other in others:
        first += other
    return first


def _variance(sigma: Array, weights: Array) -> Array:
    """Return the variance (m^2) of each range, which is large for a small weight."""
    variance: Array = np.square(sigma) / np.maximum(weights, np.square(sigma / FAR))
    return variance


def _solved(jacobian: Array, innovation: Array, covariance: RangeCovariance) -> NormalEquations:
    weighted = covariance.solve(np.column_stack((jacobian, innovation)))
    information = jacobian.T @ weighted[:, :-1]
    information.flat[:: len(information) + 1] += RIDGE + RIDGE * np.diagonal(information)
    of_guess = inverse_of(information)
    change = of_guess @ (jacobian.T @ weighted[:, -1])
    multipliers = weighted[:, -1] - weighted[:, :-1] @ change
    return NormalEquations(
        jacobian, innovation, covariance, weighted, information, of_guess, change, multipliers
    )


def deviation(variance: float) -> float:
    """Return the standard deviation; infinite if rounding made the variance negative."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def _inlier_probabilities(system: NormalEquations, weights: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier, given the prediction from all other ranges."""
    alone = system.covariance.precisions
    explained = np.sum((system.weighted[:, :-1] @ system.of_guess) * system.weighted[:, :-1], 1)
    precision = np.maximum(alone - explained, BLIND * alone)
    error = system.multipliers / precision
    variance = np.maximum(1.0 / precision - _variance(sigma, weights), 0.0) + np.square(sigma)
    return _weights(error, np.sqrt(variance), noise)


def _weights(errors: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier, if `errors` (m) have the scale of their median.

    Far from the minimum, all errors are large, and no range is an outlier because of that. At least about
    half of the ranges are therefore inliers.
    """
    if noise.sigma_degrees:
        ratios = np.abs(errors / sigma)
        middle = len(ratios) // 2
        sigma = sigma * max(1.0, float(np.partition(ratios, middle)[middle]) / MEDIAN)
    return mixture(errors, sigma, noise)[1]


MEDIAN = 0.6745
"""The median of the absolute value of a standard normal variable."""


def _log_likelihood(
    system: NormalEquations,
    chi2: float,
    residuals: Array,
    weights: Array,
    sigma: Array,
    level: float,
    noise: Noise,
) -> float:
    """Return the log-likelihood of the inliers by their covariance, and of the outliers by their bias."""
    good = weights > INLIER
    volume = system.covariance.log_determinant - float(np.sum(np.log(_variance(sigma, weights)[~good])))
    count = int(np.count_nonzero(good))
    log_likelihood = -0.5 * (volume + math.log(2.0 * math.pi) * count)
    log_likelihood += _misfit_log_likelihood(chi2, count - len(system.change), noise)
    log_likelihood -= 0.5 * len(system.change) * math.log(level)  # of the covariance of the guess
    if noise.outliers or noise.strays:
        log_likelihood += count * math.log1p(-noise.outliers - noise.strays)
        soft = SOFT * noise.outlier_bias[0] if noise.outliers else 0.0
        log_likelihood += float(
            np.sum(outliers(residuals[~good], np.maximum(sigma[~good], soft), noise))
        )
    return log_likelihood


def _misfit_log_likelihood(chi2: float, degrees: int, noise: Noise) -> float:
    """Return the log-likelihood of a chi-square, with the noise level integrated out (Student's t)."""
    nu, n = noise.sigma_degrees, max(degrees, 0)
    if not nu:
        return -0.5 * chi2
    scale = math.lgamma(0.5 * (nu + n)) - math.lgamma(0.5 * nu) - 0.5 * n * math.log(0.5 * nu)
    return scale - 0.5 * (nu + n) * math.log1p(chi2 / nu)


SOFT = 0.1
"""The least smoothing of the ends of the outlier density, as a fraction of the least bias."""


def poses(fitted: Fit, apart: tuple[float, float]) -> tuple[Array, Array]:
    """Return both poses at the last tick, relative to M1 along the axes of <W>, in m and rad.

    The result is the mean of x, y, heading of a, then of b, shape (6,), and the covariance, shape (6, 6).
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
        return mean, turn @ fitted.covariance @ turn.T
    prior, cross = np.zeros((6, 6)), np.zeros((6, len(system.innovation)))
    for robot, (path, model, u, end) in enumerate(
        zip(fitted.paths, fitted.drifts, fitted.directions, ends, strict=True)
    ):
        rows = slice(3 * robot, 3 * robot + 3)
        to_end, to_ranges = constant_effects(model, end), Projection.positions(path, fitted.ticks, u)
        both = spread(model, end.then(to_ranges))
        prior[rows, rows], cross[rows] = both[:3, :3], both[:3, 3:]
        prior[rows, rows] += to_end @ to_end.T
        cross[rows] += to_end @ constant_effects(model, to_ranges).T
    gain = system.covariance.solve(cross.T).T
    left = turn - gain @ system.jacobian
    return mean, fitted.level * (prior - gain @ cross.T + left @ system.of_guess @ left.T)
