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
    NO_ERRORS,
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
"""The fractions of a step that are tried in turn if it does not descend.

Gauss-Newton with full steps may alternate between two guesses for ever.
"""

DESCENT = 1e-6
"""The increase of the cost, in units of chi-square, that is due to rounding."""

RIDGE = 1e-12
"""The fraction of the information that is added to its diagonal, and an absolute part of the same size.

With it, the variance of an unknown that the ranges leave undetermined is large but finite.
"""

FAR = 100.0
"""The standard deviation (m) of a range with the weight 0."""

GRAIN = 1e-12
"""The least variance of a range, as a fraction of the largest variance from odometry noise.

With less, the covariance would be singular in floating point.
"""

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
    """The log-likelihood of the ranges, with the odometry errors integrated out."""
    residuals: Array
    """The measured minus the predicted ranges (m); shape (N,)."""
    weights: Array
    """The probability that each range is an inlier; shape (N,)."""
    covariance: Array
    """The covariance of the guess: (2, 2) for one robot, whose rotation is not observable, or (6, 6)."""
    information: Array
    """The inverse of the covariance."""
    chi2: float
    """The squared innovations, weighted by their inverse covariance."""
    last_step: float
    """The length of the next Gauss-Newton step, in sigmas."""
    ticks: Places
    """The tick of each range; shape (N,)."""
    directions: tuple[Array, ...]
    """The derivatives of the ranges with respect to the positions; see `Predicted`."""
    drifts: tuple[OdometryNoiseModel, ...]
    """The noise model along each path; empty if odometry is exact."""
    system: NormalEquations


class NormalEquations(NamedTuple):
    """One Gauss-Newton step in the space of the ranges."""

    jacobian: Array
    """The derivatives of the ranges with respect to the unknowns; shape (N, unknowns)."""
    innovation: Array
    """The difference (m) of the ranges from their prediction with uncorrected odometry; shape (N,)."""
    covariance: Array
    """The covariance (m^2) of the ranges; shape (N, N), or (N,) for its diagonal if odometry is exact."""
    weighted: Array
    """The Jacobian and the innovation, multiplied by the inverse covariance; shape (N, unknowns + 1)."""
    inverse: Array | None
    """The inverse covariance, if it is needed for outliers and odometry is noisy."""
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
    noisy_odometry = noise.odometry != VelocityNoise()
    drifts: tuple[OdometryNoiseModel, ...] = ()
    errors: tuple[Errors, ...] = ()
    if noisy_odometry:
        errors = tuple([error.over(len(was.v)) for error, was in zip(begun, measured, strict=False)])
    point = _point(guess.copy(), errors, measured, ranges, apart)
    weights = np.ones_like(ranges.rho)
    for step in range(steps + 1):
        odometry, innovation = None, point.residuals
        if noisy_odometry:
            seen = point.predicted.seen(point.paths, ranges)
            drifts = tuple(
                [wander(path, noise.odometry, was) for path, was in zip(point.paths, measured, strict=True)]
            )
            odometry = _odometry_covariance(drifts, seen)
            for model, rows, error in zip(drifts, seen, point.errors, strict=False):
                innovation = innovation + shifted(model, rows, error)
        if noise.outliers and step == 0:
            loose = np.zeros_like(innovation) if odometry is None else np.diagonal(odometry)
            weights = mixture(point.residuals, np.sqrt(np.square(ranges.sigma) + loose), noise)[1]
        variance = _variance(ranges.sigma, weights)
        jacobian = point.predicted.jacobian[:, free]
        system = _solved(jacobian, innovation, variance, odometry, bool(noise.outliers))
        updated = _inlier_probabilities(system, weights, ranges.sigma, noise) if noise.outliers else weights
        change = system.change
        last_step = math.sqrt(abs(float(change @ system.information @ change)))
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
        point = _descended(point, full_step, errors, drifts, variance, measured, ranges, apart)
    chi2 = float(system.innovation @ system.multipliers)
    return Fit(
        point.guess,
        point.paths,
        point.errors,
        _log_likelihood(system, chi2, point.residuals, weights, ranges.sigma, noise),
        point.residuals,
        weights,
        system.of_guess,
        system.information,
        chi2,
        last_step,
        ranges.tick,
        point.predicted.directions,
        drifts,
        system,
    )


class _Point(NamedTuple):
    """A guess and odometry errors, with the ranges that they predict."""

    guess: Array
    errors: tuple[Errors, ...]
    """The odometry errors of each path; empty if they are 0."""
    paths: tuple[Track, ...]
    predicted: Predicted
    residuals: Array


def _point(
    guess: Array,
    errors: tuple[Errors, ...],
    measured: Sequence[Track],
    ranges: Ranges,
    apart: tuple[float, float],
) -> _Point:
    paths = tuple(measured)
    if errors:
        paths = tuple([error.corrected(was) for error, was in zip(errors, measured, strict=True)])
    predicted = predict(guess, paths, ranges, apart)
    return _Point(guess, errors, paths, predicted, ranges.rho - predicted.distance)


LEAST_VARIANCE = 1e-300
"""The variance of odometry noise that counts as 0; the odometry error is then 0, too."""


def _descended(
    point: _Point,
    change: Array,
    errors: tuple[Errors, ...],
    drifts: Sequence[OdometryNoiseModel],
    variance: Array,
    measured: Sequence[Track],
    ranges: Ranges,
    apart: tuple[float, float],
) -> _Point:
    """Return the point after a step by `change` and to `errors`, or by that fraction of it that descends.

    If none does, the point stays.
    """
    most = _cost(point, drifts, variance) + DESCENT
    following = _point(point.guess + change, errors, measured, ranges, apart)
    if _cost(following, drifts, variance) <= most:
        return following
    for fraction in SHORTER_STEPS:
        begins = point.errors or [NO_ERRORS.over(len(was.v)) for was in measured]
        nearer = [a.towards(b, fraction) for a, b in zip(begins, errors, strict=False)]
        following = _point(point.guess + fraction * change, tuple(nearer), measured, ranges, apart)
        if _cost(following, drifts, variance) <= most:
            return following
    return point


def _cost(point: _Point, drifts: Sequence[OdometryNoiseModel], variance: Array) -> float:
    """Return twice the negative log-density of the residuals and of the odometry errors, up to a constant."""
    cost = float(point.residuals @ (point.residuals / variance))
    for error, model in zip(point.errors, drifts, strict=False):
        for one, q in zip(error, model.variances, strict=True):
            cost += float(one @ (one / np.maximum(q, LEAST_VARIANCE)))
    return cost


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


def _solved(
    jacobian: Array, innovation: Array, variance: Array, odometry: Array | None, invert: bool
) -> NormalEquations:
    columns = np.column_stack((jacobian, innovation))
    covariance, inverse = variance, None
    weighted: Array
    if odometry is None:
        weighted = columns / variance[:, None]
    else:
        covariance = odometry + np.diag(variance + GRAIN * float(np.max(np.diagonal(odometry))))
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
    """Return the standard deviation; infinite if rounding made the variance negative."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def inverse_of(matrix: Array) -> Array:
    """Return the inverse of a matrix, or of each matrix in a stack."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _inlier_probabilities(system: NormalEquations, weights: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier, given the prediction from all other ranges."""
    alone = 1.0 / system.covariance if system.inverse is None else np.diagonal(system.inverse)
    explained = np.sum((system.weighted[:, :-1] @ system.of_guess) * system.weighted[:, :-1], 1)
    precision = np.maximum(alone - explained, BLIND * alone)
    error = system.multipliers / precision
    variance = np.maximum(1.0 / precision - _variance(sigma, weights), 0.0) + np.square(sigma)
    return mixture(error, np.sqrt(variance), noise)[1]


def _log_likelihood(
    system: NormalEquations, chi2: float, residuals: Array, weights: Array, sigma: Array, noise: Noise
) -> float:
    """Return the log-likelihood of the inliers by their covariance, and of the outliers by their bias."""
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
        return mean, turn @ system.of_guess @ turn.T
    prior, cross = np.zeros((6, 6)), np.zeros((6, len(system.innovation)))
    for robot, (path, model, u, end) in enumerate(
        zip(fitted.paths, fitted.drifts, fitted.directions, ends, strict=True)
    ):
        rows = slice(3 * robot, 3 * robot + 3)
        both = spread(model, end.then(Projection.positions(path, fitted.ticks, u)))
        prior[rows, rows], cross[rows] = both[:3, :3], both[:3, 3:]
    gain = np.linalg.solve(system.covariance, cross.T).T
    left = turn - gain @ system.jacobian
    return mean, prior - gain @ cross.T + left @ system.of_guess @ left.T
