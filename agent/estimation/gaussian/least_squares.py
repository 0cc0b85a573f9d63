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
    no_errors,
    shifted,
    spread,
    wander,
)
from agent.estimation.gaussian.range_covariance import RangeCovariance, inverse_of, range_covariance
from agent.estimation.gaussian.range_model import Predicted, Ranges, mixture, outliers, predict
from protocol.noise import Noise, VelocityNoise

STEPS = 8
"""The maximum number of Gauss-Newton steps."""

STILL = 1e-4
"""The length of a step in sigmas below which the iteration stops."""

SETTLED = 1e-2
"""The change of a weight below which the weights have converged."""

LEAP = 1.0
"""The largest change of an unknown, in m and rad, in one step."""

SHORTER_STEPS = (0.5, 0.25, 0.0625)
"""The fractions of a step that are tried in turn while it does not descend; the last is taken in any case.

Gauss-Newton with full steps may alternate between two guesses for ever. Where even a sixteenth of a step does
not descend, the rest is rounding.
"""

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
    begun: Sequence[Errors] = (),
) -> Fit:
    """Return the Gauss-Newton fit that begins at `guess` (see `predict`).

    It begins on the paths with the odometry errors `begun`, by default on the measured paths. A step that
    does not descend is halved, because Gauss-Newton with full steps may alternate between two guesses. The
    weights of outliers decrease during the iteration. `apart` is M2 - M1 (m) in <W>.
    """
    free = slice(0, 2) if len(measured) == 1 else slice(0, 6)
    problem = _problem(measured, ranges, noise, apart)
    noisy_odometry, robust = is_noisy(noise), bool(noise.outliers or noise.strays)
    errors: tuple[Errors, ...] = ()
    if noisy_odometry:
        errors = tuple([error.over(len(was.v)) for error, was in zip(begun, measured, strict=False)])
    point = problem.point(guess.copy(), errors)
    weights = np.ones_like(ranges.rho)
    for step in range(steps + 1):
        drifts, seen, dense, columns, innovation = problem.linearised(point)
        if robust and step == 0:
            loose = np.square(ranges.sigma) + np.sum(np.square(columns), 1)
            if dense is not None:
                loose += np.diagonal(dense)
            weights = _weights(point.residuals, np.sqrt(loose), noise)
        variance = _variance(ranges.sigma, weights)
        covariance = range_covariance(variance, columns, dense)
        system = _solved(point.predicted.jacobian[:, free], innovation, covariance)
        updated = _inlier_probabilities(system, weights, ranges.sigma, noise) if robust else weights
        change = system.change
        chi2 = max(float(system.innovation @ system.multipliers), 0.0)
        inliers = int(np.count_nonzero(weights > INLIER))
        level = noise_level(chi2, inliers - len(change), noise)
        last_step = math.sqrt(abs(float(change @ system.information @ change)) / level)
        still = last_step < STILL and float(np.max(np.abs(updated - weights))) < SETTLED
        if step == steps or (still and (step or not noisy_odometry)):  # the path is corrected at least once
            break
        weights = updated
        change = change * min(1.0, LEAP / max(float(np.max(np.abs(change))), LEAP))
        if noisy_odometry:
            left = system.weighted[:, -1] - system.weighted[:, :-1] @ change
            errors = tuple([attributed(model, rows, left) for model, rows in zip(drifts, seen, strict=True)])
        full_step = np.zeros_like(point.guess)
        full_step[free] = change
        of_ranges = range_covariance(variance, problem.common, problem.slow)
        point = _descended(problem, point, full_step, errors, drifts, of_ranges)
    return Fit(
        point.guess,
        point.paths,
        point.errors,
        _log_likelihood(system, chi2, point.residuals, weights, ranges.sigma, level, noise),
        point.residuals,
        weights,
        level * system.of_guess,
        system.information / level,
        chi2,
        inliers,
        last_step,
        ranges.tick,
        point.predicted.directions,
        drifts,
        system,
        level,
    )


class _Point(NamedTuple):
    """A guess and odometry errors, with the ranges that they predict."""

    guess: Array
    errors: tuple[Errors, ...]
    """The odometry errors of each path; empty if they are 0."""
    paths: tuple[Track, ...]
    predicted: Predicted
    residuals: Array


class _Linear(NamedTuple):
    """The ranges as linear functions of the odometry errors, at a point."""

    drifts: tuple[OdometryNoiseModel, ...]
    seen: list[Projection]
    dense: Array | None
    """The covariance (m^2) from white odometry noise and slow errors, shape (N, N); None without them."""
    columns: Array
    """The effects (m) of all constant errors; shape (N, m)."""
    innovation: Array


class _Problem(NamedTuple):
    """The measurements and the priors of a fit, which do not change during the iteration."""

    measured: Sequence[Track]
    ranges: Ranges
    noise: Noise
    apart: tuple[float, float]
    patterns: Sequence[Array]
    """The effects of the constant errors of each path; see `constant_errors`."""
    common: Array
    """The effects (m) of the constant errors of the ranges; shape (N, m)."""
    slow: Array | None
    """The covariance (m^2) of the slow errors of the ranges; None without them."""

    def linearised(self, point: _Point) -> _Linear:
        """Return the linear model of the ranges at `point`."""
        if not is_noisy(self.noise):
            return _Linear((), [], self.slow, self.common, point.residuals)
        white, dense, innovation = self.noise.odometry, self.slow, point.residuals
        seen = point.predicted.seen(point.paths, self.ranges)
        models = zip(point.paths, self.measured, self.patterns, strict=True)
        drifts = tuple([wander(path, white, was, pattern) for path, was, pattern in models])
        if white != VelocityNoise():
            dense = _odometry_covariance(drifts, seen)
            dense += 0.0 if self.slow is None else self.slow
        columns = np.concatenate((self.common, *map(constant_effects, drifts, seen)), 1)
        for model, rows, error in zip(drifts, seen, point.errors, strict=False):
            innovation = innovation + shifted(model, rows, error)
        return _Linear(drifts, seen, dense, columns, innovation)

    def point(self, guess: Array, errors: tuple[Errors, ...]) -> _Point:
        """Return the point with `guess` and `errors`; the paths are the measured ones if they are empty."""
        paths = tuple(self.measured)
        if errors:
            paths = tuple(
                [
                    error.corrected(was, pattern)
                    for error, was, pattern in zip(errors, self.measured, self.patterns, strict=True)
                ]
            )
        predicted = predict(guess, paths, self.ranges, self.apart)
        return _Point(guess, errors, paths, predicted, self.ranges.rho - predicted.distance)


LEAST_VARIANCE = 1e-300
"""The variance of odometry noise that counts as 0; the odometry error is then 0, too."""


def _descended(
    problem: _Problem,
    point: _Point,
    change: Array,
    errors: tuple[Errors, ...],
    drifts: Sequence[OdometryNoiseModel],
    of_ranges: RangeCovariance,
) -> _Point:
    """Return the point after a step by `change` and to `errors`, or by that fraction of it that descends."""
    most = _cost(point, drifts, of_ranges)
    following = problem.point(point.guess + change, errors)
    for fraction in SHORTER_STEPS:
        if _cost(following, drifts, of_ranges) <= most:
            break
        begins = point.errors or [no_errors(pattern) for pattern in problem.patterns]
        nearer = [a.towards(b, fraction) for a, b in zip(begins, errors, strict=False)]
        following = problem.point(point.guess + fraction * change, tuple(nearer))
    return following


def _cost(point: _Point, drifts: Sequence[OdometryNoiseModel], of_ranges: RangeCovariance) -> float:
    """Return twice the negative log-density of the residuals and of the odometry errors, up to a constant.

    `of_ranges` is the covariance of the ranges for a known path.
    """
    cost = float(point.residuals @ of_ranges.solve(point.residuals[:, None])[:, 0])
    for error, model in zip(point.errors, drifts, strict=False):
        cost += float(error.constant @ error.constant)
        for one, q in zip((error.v, error.omega), model.variances, strict=True):
            cost += float(one @ (one / np.maximum(q, LEAST_VARIANCE)))
    return cost


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

A noise level that is too low makes claims too confident, one that is too high costs ranges. With 1, few
ranges that agree by chance raised the mean NEES of 40 missions at a sigma of 0.05 m from 2.6 to 3.5.
"""


def _problem(measured: Sequence[Track], ranges: Ranges, noise: Noise, apart: tuple[float, float]) -> _Problem:
    patterns = [constant_errors(path, noise) for path in measured]
    common = ranges.common_errors(noise.priors)
    slow = ranges.slow_errors(noise.priors, measured[0].period)
    return _Problem(measured, ranges, noise, apart, patterns, common, slow)


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
        log_likelihood += float(np.sum(outliers(residuals[~good], np.maximum(sigma[~good], soft), noise)))
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
