"""A fit to the facts about n robots: their poses at tick 0, and all errors that have a prior.

Each step of Gauss-Newton is a pass over the ticks (`smoother`). The weight of a range is the probability that
it is an inlier, given the prediction from all others. Without a prior, nothing is known of the start poses;
the noise level, a factor of all variances, is integrated out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.noise_level import (
    INLIER,
    misfit_log_likelihood,
    noise_level,
    residual_correlation,
)
from agent.estimation.gaussian.odometry_noise import Array, Errors, Places
from agent.estimation.gaussian.range_model import outliers
from agent.estimation.gaussian.range_weights import (
    inlier_probabilities,
    weighted_variance,
    weights_by_errors,
)
from agent.estimation.kernel import Kernel
from agent.estimation.problem import JointProblem
from agent.estimation.smoother import FitStep, Singular, Walk

FIT_STEPS = 8
"""The maximum number of Gauss-Newton steps."""

LAST_STEP = 3e-3
"""The expected length in sigmas of the next step from which on a step is the last.

Steps of Gauss-Newton decrease by a constant factor, about 0.1 with ranges of a tenth of their length. The
linear model is not computed again after the last step.
"""

LARGEST_STEP = 1.0
"""The largest change of an unknown, in m and rad, in one step."""

SHORTER_STEPS = (0.5, 0.25, 0.0625)
"""The fractions of a step that are tried in turn if it does not descend.

Gauss-Newton with full steps may alternate between two guesses for ever.
"""

DESCENT = 1e-6
"""The increase of the cost, in units of chi-square, that is due to rounding."""

SETTLED_WEIGHT = 1e-2
"""The change of a weight below which the weights have converged."""

RIDGE = 1e-12
"""The fraction of the information that is added to its diagonal, and an absolute part of the same size.

With it, the variance of an unknown that the ranges leave undetermined is large but finite.
"""

SOFT = 0.1
"""The least smoothing of the ends of the outlier density, as a fraction of the least bias."""

LEAST_VARIANCE = 1e-300
"""The variance of a white error that is 0."""


class JointStart(NamedTuple):
    """The poses and the errors from which a fit begins."""

    poses: Array
    """The pose of each robot at tick 0, relative to the origin; shape (n, 3)."""
    errors: tuple[Errors, ...] = ()
    """The odometry errors of each robot; by default none."""


class JointFit(NamedTuple):
    """The most probable start poses in the neighbourhood of the initial ones, with their uncertainty.

    Ranges are in the order of the measurements.
    """

    start: JointStart
    """The poses at tick 0 and the odometry errors."""
    poses: Array
    """The pose of each robot at the end of its path, relative to the origin, in m and rad; shape (n, 3)."""
    covariance: Array
    """The covariance of `poses`; shape (3 n, 3 n)."""
    weight: float
    """The logarithm of the evidence: the likelihood with all unknowns integrated out, up to a constant."""
    residuals: Array
    """The measured minus the predicted ranges (m); shape (N,)."""
    weights: Array
    """The probability that each range is an inlier; shape (N,)."""
    chi2: float
    """The least sum of squares of all errors in their sigmas, as told."""
    last_step: float
    """The expected length of the next Gauss-Newton step, in sigmas."""
    level: float
    """The estimate of the noise level tau^2."""
    constants: Array
    """The constant errors of ranges, then of each robot's odometry, in their sigmas; shape (c + m n,)."""
    constant_sigmas: Array
    """Their standard deviations in the same unit."""
    paths: Array
    """The x, y (m, relative to the origin) and heading (rad) of each robot at each tick; (n, K + 1, 3)."""
    problem: JointProblem

    @property
    def ticks(self) -> Places:
        """The tick of each range; shape (N,)."""
        return self.problem.ticks

    @property
    def inliers(self) -> int:
        """The number of ranges that are more probably inliers than outliers."""
        return int(np.count_nonzero(self.weights > INLIER))

    @property
    def freedom(self) -> int:
        """The degrees of freedom of `chi2`, at least 1."""
        return max(self.inliers - self.problem.free, 1)

    def places(self, robot: int, ticks: Places) -> Array:
        """Return the position (m, relative to the origin) of a robot at `ticks`; shape (2, N)."""
        return np.asarray(self.paths[robot, ticks, :2].T, np.float64)


class _Errors(NamedTuple):
    """The errors of the ranges and of the odometry at a point, in the order of the fit."""

    common: Array
    """Constant errors of ranges in their sigmas; shape (c,)."""
    constant: Array
    """Constant errors of each robot's odometry in their sigmas; shape (n, m)."""
    white: Array
    """White errors of v and omega; shape (n, 2, K)."""
    slow: Array
    """Slow errors of ranges in m; shape (N,)."""
    of_slow: Array
    """The slow errors, multiplied by their inverse covariance; shape (N,)."""


class _Point(NamedTuple):
    """Start poses and errors, with the ranges that they predict."""

    poses: Array
    """Start poses; shape (3 n,)."""
    errors: _Errors
    walk: Walk
    own: Array
    """The residuals without the constant and slow errors of ranges, in m; shape (N,)."""
    prior_cost: float
    """Twice the negative log-density of all errors that have a prior, up to a constant."""

    @staticmethod
    def of(problem: JointProblem, kernel: Kernel, poses: Array, errors: _Errors) -> _Point:
        """Return the point with these start poses and errors."""
        of, walk = problem.measured, kernel.walked(poses, errors.constant, errors.white)
        off = of.mean - poses
        of_white = np.square(errors.white) / np.maximum(of.white, LEAST_VARIANCE)
        squares = np.sum(np.square(errors.common)) + np.sum(np.square(errors.constant)) + np.sum(of_white)
        cost = float(squares + off @ of.information @ off + errors.slow @ errors.of_slow)
        own = walk.residual - of.common @ errors.common - errors.slow
        if of.scaled >= 0:  # the scale error multiplies the predicted ranges
            by_scale = of.common[:, of.scaled] - of.scale * (of.rho - walk.residual)
            own += by_scale * errors.common[of.scaled]
        return _Point(poses, errors, walk, own, cost)

    def cost(self, variance: Array) -> float:
        """Return twice the negative log-density of all errors; `variance` is that of each range (m^2)."""
        return float(np.sum(np.square(self.own) / variance)) + self.prior_cost


def joint_fits(
    measured: JointMeasurements, starts: Iterable[JointStart], steps: int = FIT_STEPS
) -> list[JointFit]:
    """Return the fits to all ranges in `measured` that begin at `starts`, after at most `steps` steps.

    A start from which there is none, because a number is too large for a float, is left out.
    """
    problem = JointProblem.of(measured)
    kernel, found = Kernel(problem.measured), []
    for start in starts:
        try:
            found.append(_fitted(problem, kernel, start, steps))
        except Singular:
            continue
    return found


def _fitted(problem: JointProblem, kernel: Kernel, start: JointStart, steps: int) -> JointFit:
    noise, sigma = problem.noise, problem.sigma
    point = _begin(problem, kernel, start)
    weights, before = np.ones(len(sigma)), 0.0
    for number in range(steps + 1):
        if problem.robust and number == 0:
            loose = kernel.loosened(point.walk, point.poses, np.square(sigma))
            weights = weights_by_errors(point.walk.residual, np.sqrt(loose), noise)
        variance = weighted_variance(sigma, weights)
        step = kernel.step(point.walk, point.poses, variance, RIDGE, LARGEST_STEP)
        if not math.isfinite(step.chi2):
            raise Singular("an error is too large for a float")
        updated = weights
        if problem.robust:
            told = (step.multipliers, step.alone, step.explained)
            updated = inlier_probabilities(*told, variance, sigma, noise)
        freedom = int(np.count_nonzero(weights > INLIER)) - problem.free
        level = noise_level(step.chi2, freedom, noise)
        length = step.length / math.sqrt(level)
        before = length if number == 0 else before
        expected = length**2 / max(length, before, LAST_STEP)
        still = float(np.max(np.abs(updated - weights), initial=0.0)) < SETTLED_WEIGHT
        if number == steps:
            off = _off_model(point, step, variance, level)
            return _fit(problem, point, step, weights, off if off > 1.0 else length)
        point = _stepped(problem, kernel, point, step, variance)
        still = still and expected < LAST_STEP and number > 0  # the path is corrected at least once
        if still and _off_model(point, step, variance, level) <= 1.0:
            return _fit(problem, point, step, weights, expected)
        weights, before = updated, length
    raise AssertionError("the last step returns")


def _begin(problem: JointProblem, kernel: Kernel, start: JointStart) -> _Point:
    """Return the point at `start`."""
    of = problem.measured
    constant, white = np.zeros(of.patterns.shape[:2]), np.zeros(of.white.shape)
    for i, one in enumerate(start.errors):
        known = min(len(one.v), problem.lengths[i])
        white[i, 0, :known], white[i, 1, :known] = one.v[:known], one.omega[:known]
        if len(one.constant):
            constant[i] = one.constant
    nothing = np.zeros(len(of.rho))
    errors = _Errors(np.zeros(of.common.shape[1]), constant, white, nothing, nothing)
    return _Point.of(problem, kernel, np.array(start.poses, np.float64).ravel(), errors)


def _off_model(point: _Point, step: FitStep, variance: Array, level: float) -> float:
    """Return the sigmas by which the errors at `point` exceed those of the linear model.

    The length of a step tells how far the start poses are from their optimum, but not how far the path is:
    where ranges are exact, the second order of a step of the path can leave residuals of thousands of their
    sigmas. More than one sigma is a step that the path still has to take.
    """
    return math.sqrt(max(point.cost(variance) - step.chi2, 0.0) / level)


def _stepped(problem: JointProblem, kernel: Kernel, point: _Point, step: FitStep, variance: Array) -> _Point:
    """Return the point after a step, or after that fraction of it that descends; else `point`."""
    of, n3 = problem.measured, len(point.poses)
    constants = step.limited[n3:]
    c = of.common.shape[1]
    constant = constants[c:].reshape(point.errors.constant.shape)
    errors = _Errors(constants[:c], constant, step.white, step.slow, step.own)
    most = point.cost(variance) + DESCENT
    following = _Point.of(problem, kernel, point.poses + step.limited[:n3], errors)
    for fraction in SHORTER_STEPS:
        if following.cost(variance) <= most:
            return following
        between = [one + fraction * (other - one) for one, other in zip(point.errors, errors, strict=True)]
        poses = point.poses + fraction * step.limited[:n3]
        following = _Point.of(problem, kernel, poses, _Errors(*between))
    return following if following.cost(variance) <= most else point


def _fit(problem: JointProblem, point: _Point, step: FitStep, weights: Array, last_step: float) -> JointFit:
    """Return the fit that has ended at `point`, with the linear model of the last step."""
    n3, back = len(point.poses), problem.back
    freedom = int(np.count_nonzero(weights > INLIER)) - problem.free
    level = noise_level(step.chi2, freedom, problem.noise)
    if problem.noise.sigma_degrees:
        rows = problem.by_radio
        own, sigma = point.own[rows], problem.sigma[rows]
        correlation = residual_correlation(own, weights[rows], sigma, problem.ends, level)
        level = noise_level(step.chi2, freedom, problem.noise, correlation)
    errors = [
        Errors(v[:ticks], omega[:ticks], constant)
        for (v, omega), constant, ticks in zip(
            point.errors.white, point.errors.constant, problem.lengths, strict=True
        )
    ]
    return JointFit(
        JointStart(point.poses.reshape(-1, 3), tuple(errors)),
        point.walk.place[:, -1],
        level * step.ends,
        _evidence(problem, point, step, weights),
        point.walk.residual[back],
        weights[back],
        step.chi2,
        last_step,
        level,
        step.change[n3:],
        np.sqrt(np.maximum(np.diagonal(step.inverse)[n3:], 0.0)),
        point.walk.place,
        problem,
    )


def _evidence(problem: JointProblem, point: _Point, step: FitStep, weights: Array) -> float:
    """Return the log-likelihood of the ranges, with all unknowns integrated out, up to a constant.

    Outliers count by their bias.
    """
    noise, sigma, good = problem.noise, problem.sigma, weights > INLIER
    count = int(np.count_nonzero(good))
    volume = step.volume - float(np.sum(np.log(weighted_variance(sigma, weights)[~good])))
    weight = -0.5 * (volume + math.log(2.0 * math.pi) * count)
    weight += misfit_log_likelihood(step.chi2, count - problem.free, noise)
    if noise.outliers or noise.strays:
        weight += count * math.log1p(-noise.outliers - noise.strays)
        soft = SOFT * noise.outlier_bias[0] if noise.outliers else 0.0
        residuals = point.walk.residual[~good]
        weight += float(np.sum(outliers(residuals, np.maximum(sigma[~good], soft), noise)))
    return weight
