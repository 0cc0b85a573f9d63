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
from numpy.typing import NDArray

from agent.estimation.gaussian.descent import LEAP, rows_of, stepped
from agent.estimation.gaussian.fitted import Fit, NormalEquations
from agent.estimation.gaussian.linear_model import LinearModel, Point, Problem, Start, product
from agent.estimation.gaussian.noise_level import (
    INLIER,
    misfit_log_likelihood,
    noise_level,
    residual_correlation,
)
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    Track,
)
from agent.estimation.gaussian.range_covariance import RangeCovariance, inverse_of, range_covariance
from agent.estimation.gaussian.range_model import Ranges, inlier_probability, outliers
from protocol.noise import Noise

STEPS = 8
"""The maximum number of Gauss-Newton steps."""

STILL = 3e-3
"""The expected length in sigmas of the next step from which on a step is the last.

Steps of Gauss-Newton decrease by a constant factor, about 0.1 with ranges of a tenth of their length. The
linear model is not computed again after the last step.
"""

COARSE_STILL = 0.05
"""The value of STILL for fits on which only the robot's way depends.

No claim does: each search fits all ranges again. With STILL, such a fit takes twice as long.
"""

WARM_DECREASE = 0.1
"""The expected decrease of the first step of a fit that begins near its end.

It begins at the last fit, which has one range less, or at a guess that is refined on all ranges.
"""

SETTLED = 3.0
"""The change of a weight below which the weights have converged, in units of the shortest step."""

NEAR_END = 1.0
"""The length in sigmas of the next step below which a fit tells where it will end."""

ALIKE = 0.3
"""The largest difference of the weights of two fits that come to the same end.

With other outliers, two fits from one guess may come to different ends.
"""

RIDGE = 1e-12
"""The fraction of the information that is added to its diagonal, and an absolute part of the same size.

With it, the variance of an unknown that the ranges leave undetermined is large but finite.
"""

FAR = 100.0
"""The standard deviation (m) of a range with the weight 0."""

BLIND = 1e-9
"""The least precision of a range's prediction, as a fraction of that with a known guess."""


def fit(
    guess: Array,
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = STEPS,
    begun: Sequence[Errors] = (),
) -> Fit:
    """Return the one fit that begins at `guess`, with the odometry errors `begun`; see `fits`."""
    return fits([Start(guess, tuple(begun))], measured, ranges, noise, apart, steps)[0]


def own_fit(joint: Fit, robot: int, measured: Sequence[Track], ranges: Ranges, noise: Noise) -> Fit:
    """Return the fit of one robot (0 or 1) to its own anchor alone, which begins at that of both robots.

    Its evidence and its chi-square are enough for tests, which do not depend on the last digits.
    """
    start = Start(np.array([*joint.guess[3 * robot : 3 * robot + 2], 0.0]), joint.errors[robot : robot + 1])
    own = ranges.only(robot)
    (one,) = fits([start], [measured[robot]], own, noise, shortest=COARSE_STILL, decrease=WARM_DECREASE)
    return one


def fits(
    starts: Sequence[Start],
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = STEPS,
    *,
    shortest: float = STILL,
    decrease: float = 1.0,
    same: float = 0.0,
) -> list[Fit]:
    """Return the Gauss-Newton fits that begin at `starts`, in this order.

    A step is the last if the next one is expected to be shorter than `shortest`. The second step is expected
    to be shorter than the first by the factor `decrease`, which is less than 1 for starts that are fits. Of
    fits that come within `same` sigmas of each other, one goes on, and the others are left out. The weights
    of outliers decrease during the iteration. `apart` is M2 - M1 (m) in <W>.
    """
    if not starts:
        return []
    problem = Problem.of(measured, ranges, noise, apart)
    point = problem.begin(starts)
    weights = np.ones(point.residuals.shape)
    ended: dict[int, Fit] = {}  # by the index of the start
    left, before = list(range(len(starts))), np.zeros(len(starts))  # the index of the start of each row
    for step in range(steps + 1):
        linear = problem.linearised(point)
        if problem.robust and step == 0:
            weights = _first_weights(problem, starts, point, linear)
        variance = _variance(ranges.sigma, weights)
        covariance = range_covariance(variance, linear.columns, linear.dense)
        system = _solved(point.predicted.jacobian[..., problem.free], linear.innovation, covariance)
        updated = _inlier_probabilities(system, weights, ranges.sigma, noise) if problem.robust else weights
        quality = _quality(system, weights, noise)
        if step == 0:
            before = quality.last_step / decrease
        expected = np.square(quality.last_step) / np.maximum(np.maximum(quality.last_step, before), STILL)
        settled = np.maximum.reduce(np.abs(updated - weights), -1) < SETTLED * shortest
        still = settled & (expected < shortest)
        still &= step > 0 or decrease < 1.0 or not problem.noisy  # the path is corrected at least once
        if step == steps:
            for row, i in enumerate(left):
                ended[i] = _fit(problem, row, point, point, weights, system, quality)
            break
        begun, point = point, stepped(problem, point, linear, system, variance)
        at_end = quality._replace(last_step=expected)
        for row in np.flatnonzero(still).tolist():
            ended[left[row]] = _fit(problem, row, point, begun, weights, system, at_end)
        copies = _copies(point.guess[:, problem.free], system, quality, weights, same)
        onward = ~(still | copies)
        if not onward.any():
            break
        left = [i for i, one in zip(left, onward.tolist(), strict=True) if one]
        weights, before = updated, quality.last_step
        if len(left) < len(onward):
            point, weights, before = rows_of((point, weights, before), onward)
    return [ended[i] for i in sorted(ended)]


def _copies(
    guess: Array, system: NormalEquations, quality: _Quality, weights: Array, same: float
) -> NDArray[np.bool]:
    """Return which fits come to the same guess and weights as one that is nearer to its end."""
    if not same or len(guess) == 1:
        return np.zeros(len(guess), np.bool)
    apart = guess[:, None] - guess
    apart[..., 2::3] = np.remainder(apart[..., 2::3] + math.pi, math.tau) - math.pi
    distance = np.add.reduce((apart @ system.information) * apart, -1) / quality.level
    near = (distance < same**2) & (np.abs(weights[:, None] - weights).max(-1) < ALIKE)
    length = quality.last_step
    near &= np.maximum(length[:, None], length) < NEAR_END
    sooner = length < length[:, None]
    sooner |= (length == length[:, None]) & np.tri(len(length), k=-1, dtype=bool)
    return np.asarray(np.any(near & sooner, 1), np.bool)


def _first_weights(problem: Problem, starts: Sequence[Start], point: Point, linear: LinearModel) -> Array:
    """Return the weights with which fits begin: those of their starts, or by their residuals."""
    weights = _weights(point.residuals, np.sqrt(problem.loosened(linear)), problem.noise)
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
    weights = _weights(problem.begin(starts).residuals, sigma, noise)
    return [
        start._replace(weights=own) for start, own in zip(starts, weights, strict=True) if own.min() < INLIER
    ]


def _fit(
    problem: Problem,
    i: int,
    points: Point,
    linear_points: Point,
    all_weights: Array,
    systems: NormalEquations,
    qualities: _Quality,
) -> Fit:
    """Return the fit with index `i`, which has ended at its point, with the linear model of another."""
    residuals, weights, system = points.residuals[i], all_weights[i], systems.one(i)
    chi2, inliers, level = float(qualities.chi2[i]), int(qualities.inliers[i]), float(qualities.level[i])
    if problem.noise.sigma_degrees:
        correlation = residual_correlation(points.own[i], weights, problem.ranges)
        level = noise_level(chi2, inliers - len(system.change), problem.noise, correlation)
    return Fit(
        points.guess[i],
        problem.paths(points, i),
        problem.errors(points.sizes.constant[i], points.sizes.white[i]),
        _log_likelihood(system, chi2, residuals, weights, problem.ranges.sigma, level, problem.noise),
        residuals,
        weights,
        level * system.of_guess,
        system.information / level,
        chi2,
        inliers,
        float(qualities.last_step[i]),
        problem.ranges.tick,
        problem,
        system,
        linear_points,
        i,
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


def _variance(sigma: Array, weights: Array) -> Array:
    """Return the variance (m^2) of each range, which is large for a small weight."""
    variance: Array = np.square(sigma) / np.maximum(weights, np.square(sigma / FAR))
    return variance


def _solved(jacobian: Array, innovation: Array, covariance: RangeCovariance) -> NormalEquations:
    weighted = covariance.solve(np.concatenate((jacobian, innovation[..., None]), -1))
    products = np.swapaxes(jacobian, -1, -2) @ weighted
    information = products[..., :-1]
    diagonal = np.einsum("...ii->...i", information)
    diagonal += RIDGE + RIDGE * diagonal
    of_guess = inverse_of(information)
    change = product(of_guess, products[..., -1])
    multipliers = weighted[..., -1] - product(weighted[..., :-1], change)
    return NormalEquations(
        jacobian, innovation, covariance, weighted, information, of_guess, change, multipliers
    )


def _inlier_probabilities(system: NormalEquations, weights: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier, given the prediction from all other ranges."""
    alone = system.covariance.precisions
    weighted = system.weighted[..., :-1]
    explained = np.add.reduce((weighted @ system.of_guess) * weighted, -1)
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
        middle = ratios.shape[-1] // 2
        median = np.partition(ratios, middle, -1)[..., middle, None]
        sigma = sigma * np.maximum(1.0, median / MEDIAN)
    return inlier_probability(errors, sigma, noise)


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
    volume, count = float(system.covariance.log_determinant), int(np.count_nonzero(good))
    if count < len(good):
        volume -= float(np.sum(np.log(_variance(sigma, weights)[~good])))
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


SOFT = 0.1
"""The least smoothing of the ends of the outlier density, as a fraction of the least bias."""


def held_log_likelihoods(problem: Problem, begun: Fit, row: int, offs: Array, steps: int) -> list[float]:
    """Return the log-likelihoods of the ranges of `problem` after `steps` steps from the fit `begun`.

    The problem has the ranges of that fit and one more, at `row`, which holds a coordinate: it is no outlier.
    Each of `offs` (m) is added to this range in turn.
    """
    noise, sigma = problem.noise, problem.ranges.sigma
    start = Start(begun.guess, begun.errors)
    point = _longer(problem.begin([start] * len(offs)), row, offs)
    weights = np.repeat(np.insert(begun.weights, row, 1.0)[None], len(offs), 0)
    for step in range(steps + 1):
        linear = problem.linearised(point)
        covariance = range_covariance(_variance(sigma, weights), linear.columns, linear.dense)
        system = _solved(point.predicted.jacobian[..., problem.free], linear.innovation, covariance)
        if step == steps:
            break
        longest = np.abs(system.change).max(-1, keepdims=True)
        change = system.change * np.minimum(1.0, LEAP / np.maximum(longest, LEAP))
        left_over = system.weighted[..., -1] - product(system.weighted[..., :-1], change)
        sizes = problem.sizes(point, linear, left_over)
        point = _longer(problem.point(point.guess + change, sizes), row, offs)
        if problem.robust and step == 0:
            loosened = np.square(sigma) + np.add.reduce(np.square(problem.common), 1)
            weights = _weights(point.residuals, np.sqrt(loosened), noise)
        elif problem.robust:
            weights = _inlier_probabilities(system, weights, sigma, noise)
        weights[:, row] = 1.0
    chi2, level = _quality(system, weights, noise).chi2.tolist(), begun.level
    return [
        _log_likelihood(system.one(i), chi2[i], point.residuals[i], weights[i], sigma, level, noise)
        for i in range(len(offs))
    ]


def _longer(point: Point, row: int, offs: Array) -> Point:
    """Return `point` with `offs` (m) added to the range at `row`, one for each fit."""
    residuals, own = point.residuals.copy(), point.own.copy()
    residuals[:, row] += offs
    own[:, row] += offs
    return point._replace(residuals=residuals, own=own)
