"""Least squares over all ranges of one robot or of both, with odometry noise along the path.

The unknowns are, for each robot, the position of its anchor in the frame of its odometry and the rotation of
that frame in <W>, and also the odometry errors at every tick. Because there are so many of the latter, the
fit is done in the space of the ranges, where odometry noise becomes a covariance between each two ranges.
Gauss-Newton, with the path corrected at each step, converges to the maximum a posteriori of the whole factor
graph. All fits to the same measurements are computed at once: the first axis of each array is the fit.

With exact odometry there is no such covariance, and the fit has only two or six unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.fit import FIT_STEPS, LAST_STEP, RIDGE, SETTLED_WEIGHT, SOFT
from agent.estimation.gaussian.descent import full_step, rows_of, stepped
from agent.estimation.gaussian.fitted import Fit, NormalEquations
from agent.estimation.gaussian.linear_model import LinearModel, Point, Problem, Start, product
from agent.estimation.gaussian.noise_level import (
    INLIER,
    misfit_log_likelihood,
    noise_level,
    residual_correlation,
)
from agent.estimation.gaussian.odometry_noise import Array, Errors, Track
from agent.estimation.gaussian.range_covariance import RangeCovariance, inverse_of, range_covariance
from agent.estimation.gaussian.range_model import Ranges, outliers
from agent.estimation.gaussian.range_weights import inlier_probabilities, weighted_variance, weights_by_errors
from protocol.noise import Noise

COARSE_STILL = 0.05
"""The value of LAST_STEP for fits on which only the robot's way depends.

No claim does: each search fits all ranges again. With LAST_STEP, such a fit takes twice as long.
"""

WARM_DECREASE = 0.1
"""The expected decrease of the first step of a fit that begins at the last one, which has one range less."""


def fit(
    guess: Array,
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = FIT_STEPS,
    begun: Sequence[Errors] = (),
) -> Fit:
    """Return the one fit that begins at `guess`, with the odometry errors `begun`; see `fits`."""
    return fits([Start(guess, tuple(begun))], measured, ranges, noise, apart, steps)[0]


def own_fit(joint: Fit, robot: int, measured: Sequence[Track], ranges: Ranges, noise: Noise) -> Fit:
    """Return the fit of one robot (0 or 1) to its own anchor alone, which begins at that of both robots."""
    guess = np.array([*joint.guess[3 * robot : 3 * robot + 2], 0.0])
    begun = joint.errors[robot : robot + 1]
    return fit(guess, [measured[robot]], ranges.only(robot), noise, begun=begun)


def fits(
    starts: Sequence[Start],
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = FIT_STEPS,
    *,
    shortest: float = LAST_STEP,
    decrease: float = 1.0,
) -> list[Fit]:
    """Return the Gauss-Newton fits that begin at `starts`, in this order.

    A step is the last if the next one is expected to be shorter than `shortest`. The second step is expected
    to be shorter than the first by the factor `decrease`, which is less than 1 for starts that are fits. The
    weights of outliers decrease during the iteration. `apart` is M2 - M1 (m) in <W>.
    """
    if not starts:
        return []
    problem = Problem.of(measured, ranges, noise, apart)
    point = problem.begin(starts)
    weights = np.ones(point.residuals.shape)
    ended: dict[int, Fit] = {}  # by the index of the start
    left = list(range(len(starts)))  # the index of the start of each row
    before = np.zeros(len(starts))
    for step in range(steps + 1):
        linear = problem.linearised(point)
        if problem.robust and step == 0:
            weights = _first_weights(problem, starts, point, linear)
        variance = weighted_variance(ranges.sigma, weights)
        covariance = range_covariance(variance, linear.columns, linear.dense)
        system = _solved(point.predicted.jacobian[..., problem.free], linear.innovation, covariance)
        updated = _inliers(system, variance, ranges.sigma, noise) if problem.robust else weights
        quality = _quality(system, weights, noise)
        if step == 0:
            before = quality.last_step / decrease
        expected = np.square(quality.last_step) / np.maximum(np.maximum(quality.last_step, before), LAST_STEP)
        settled = np.maximum.reduce(np.abs(updated - weights), -1) < SETTLED_WEIGHT
        still = settled & (expected < shortest)
        still &= step > 0 or decrease < 1.0 or not problem.noisy  # the path is corrected at least once
        if step == steps:
            off = _off_model(point, variance, quality)
            at_end = quality._replace(last_step=np.where(off > 1.0, off, quality.last_step))
            for row, i in enumerate(left):
                ended[i] = _fit(problem, row, point, point, weights, system, at_end)
            break
        begun, point = point, stepped(problem, point, linear, system, variance)
        still &= _off_model(point, variance, quality) <= 1.0
        at_end = quality._replace(last_step=expected)
        for row in np.flatnonzero(still).tolist():
            ended[left[row]] = _fit(problem, row, point, begun, weights, system, at_end)
        onward = ~still
        if not onward.any():
            break
        left = [i for i, one in zip(left, onward.tolist(), strict=True) if one]
        weights, before = updated, quality.last_step
        if len(left) < len(onward):
            point, weights, before = rows_of((point, weights, before), onward)
    return [ended[i] for i in range(len(starts))]


def _inliers(system: NormalEquations, variance: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier."""
    weighted = system.weighted[..., :-1]
    explained = np.add.reduce((weighted @ system.of_guess) * weighted, -1)
    alone = system.covariance.precisions
    return inlier_probabilities(system.multipliers, alone, explained, variance, sigma, noise)


def _first_weights(problem: Problem, starts: Sequence[Start], point: Point, linear: LinearModel) -> Array:
    """Return the weights with which fits begin: those of their starts, or by their residuals."""
    weights = weights_by_errors(point.residuals, np.sqrt(problem.loosened(linear)), problem.noise)
    for i, start in enumerate(starts):
        if start.weights is not None:
            weights[i] = start.weights
    return weights


def without_outliers(
    starts: Sequence[Start],
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
) -> list[Start]:
    """Return the `starts` under which some range is an outlier, with weights that leave these ranges out.

    The weights follow from the residuals and the sigmas of the ranges alone, as if the start were exact.
    Without them, a fit first allows for the uncertainty of the odometry too, which can explain an outlier
    and draw the fit away from the start.
    """
    problem = Problem.of(measured, ranges, noise, apart)
    if not (starts and problem.robust):
        return []
    sigma = np.sqrt(np.square(ranges.sigma) + ranges.loosened(noise.priors))
    weights = weights_by_errors(problem.begin(starts).residuals, sigma, noise)
    return [
        start._replace(weights=own) for start, own in zip(starts, weights, strict=True) if own.min() < INLIER
    ]


def _fit(
    problem: Problem,
    row: int,
    points: Point,
    linear_points: Point,
    all_weights: Array,
    systems: NormalEquations,
    qualities: _Quality,
) -> Fit:
    """Return the fit in `row`, which has ended at `points`, with the linear model of `linear_points`."""
    residuals, weights, system = points.residuals[row], all_weights[row], systems.one(row)
    chi2, level = float(qualities.chi2[row]), float(qualities.level[row])
    inliers = int(qualities.inliers[row])
    if problem.noise.sigma_degrees:
        sigma, (first, second, _) = problem.ranges.sigma, problem.ranges.counts
        ends = {first, first + second}
        correlation = residual_correlation(points.own[row], weights, sigma, ends, level)
        level = noise_level(chi2, inliers - len(system.change), problem.noise, correlation)
    return Fit(
        points.guess[row],
        problem.paths(points, row),
        problem.errors(points.sizes.constant[row], points.sizes.white[row]),
        _log_likelihood(system, chi2, residuals, weights, problem.ranges.sigma, level, problem.noise),
        residuals,
        weights,
        level * system.of_guess,
        system.information / level,
        chi2,
        inliers,
        float(qualities.last_step[row]),
        problem.ranges.tick,
        problem,
        system,
        linear_points,
        row,
        level,
    )


class _Quality(NamedTuple):
    """The agreement of the ranges with a linear model."""

    chi2: Array
    inliers: Array
    level: Array
    last_step: Array


def _quality(system: NormalEquations, weights: Array, noise: Noise) -> _Quality:
    """Return how well the ranges agree with a linear model."""
    change = system.change
    chi2 = np.maximum(np.add.reduce(system.innovation * system.multipliers, -1), 0.0)
    inliers = np.add.reduce(weights > INLIER, -1)
    told = zip(chi2.tolist(), inliers.tolist(), strict=True)
    level = np.array([noise_level(one, count - change.shape[-1], noise) for one, count in told])
    length = np.abs(np.add.reduce(change * product(system.information, change), -1))
    return _Quality(chi2, inliers, level, np.sqrt(length / level))


def _off_model(point: Point, variance: Array, quality: _Quality) -> Array:
    """Return the sigmas by which the errors at `point` exceed those of the linear model; shape (fits,).

    The length of a step tells how far the guess is from its optimum, but not how far the path is: where
    ranges are exact, the second order of a step of the path can leave residuals of thousands of their sigmas.
    More than one sigma is a step that the path still has to take.
    """
    return np.sqrt(np.maximum(point.cost(variance) - quality.chi2, 0.0) / quality.level)


def _solved(jacobian: Array, innovation: Array, covariance: RangeCovariance) -> NormalEquations:
    weighted = covariance.solve(np.concatenate((jacobian, innovation[..., None]), -1))
    products = jacobian.mT @ weighted
    information = products[..., :-1]
    diagonal = np.einsum("...ii->...i", information)
    diagonal += RIDGE + RIDGE * diagonal
    of_guess = inverse_of(information)
    change = product(of_guess, products[..., -1])
    multipliers = weighted[..., -1] - product(weighted[..., :-1], change)
    return NormalEquations(
        jacobian, innovation, covariance, weighted, information, of_guess, change, multipliers
    )


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
    volume, count = float(system.covariance.log_determinant), int(np.count_nonzero(good))
    if count < len(good):
        volume -= float(np.sum(np.log(weighted_variance(sigma, weights)[~good])))
    log_likelihood = -0.5 * (volume + math.log(2.0 * math.pi) * count)
    log_likelihood += misfit_log_likelihood(chi2, count - len(system.change), noise)
    log_likelihood -= 0.5 * len(system.change) * math.log(level)  # of the covariance of the guess
    if count == len(good):
        return log_likelihood + count * math.log1p(-noise.outliers - noise.strays)
    if noise.outliers or noise.strays:
        log_likelihood += count * math.log1p(-noise.outliers - noise.strays)
        soft = SOFT * noise.outlier_bias[0] if noise.outliers else 0.0
        log_likelihood += float(np.sum(outliers(residuals[~good], np.maximum(sigma[~good], soft), noise)))
    return log_likelihood


class HeldFit(NamedTuple):
    """The result of a fit in which one coordinate is held."""

    log_likelihood: float
    """The log-likelihood of the ranges; see `Fit`."""
    guess: Array
    """The unknowns, as in `Fit`."""
    paths: tuple[Track, ...]
    """The paths with the odometry errors corrected."""


def held_fits(problem: Problem, begun: Fit, row: int, offsets: Array, steps: int) -> list[HeldFit]:
    """Return the fits to the ranges of `problem` after `steps` steps from the fit `begun`.

    The problem has the ranges of that fit and one more, at `row`, which holds a coordinate: it is no outlier.
    There is one fit for each of `offsets` (m), which is added to this range.
    """
    noise, sigma = problem.noise, problem.ranges.sigma
    start = Start(begun.guess, begun.errors)
    point = _longer(problem.begin([start] * len(offsets)), row, offsets)
    weights = np.repeat(np.insert(begun.weights, row, 1.0)[None], len(offsets), 0)
    for step in range(steps + 1):
        linear = problem.linearised(point)
        covariance = range_covariance(weighted_variance(sigma, weights), linear.columns, linear.dense)
        system = _solved(point.predicted.jacobian[..., problem.free], linear.innovation, covariance)
        if step == steps:
            break
        point = _longer(problem.point(*full_step(problem, point, linear, system)), row, offsets)
        if problem.robust and step == 0:
            loosened = np.square(sigma) + np.add.reduce(np.square(problem.common), 1)
            weights = weights_by_errors(point.residuals, np.sqrt(loosened), noise)
        elif problem.robust:
            weights = _inliers(system, weighted_variance(sigma, weights), sigma, noise)
        weights[:, row] = 1.0
    chi2, level = _quality(system, weights, noise).chi2.tolist(), begun.level
    return [
        HeldFit(
            _log_likelihood(system.one(i), chi2[i], point.residuals[i], weights[i], sigma, level, noise),
            point.guess[i],
            problem.paths(point, i),
        )
        for i in range(len(offsets))
    ]


def _longer(point: Point, row: int, offsets: Array) -> Point:
    """Return `point` with `offsets` (m) added to the range at `row`, one for each fit."""
    residuals, own = point.residuals.copy(), point.own.copy()
    residuals[:, row] += offsets
    own[:, row] += offsets
    return point._replace(residuals=residuals, own=own)
