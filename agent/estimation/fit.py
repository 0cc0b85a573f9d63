"""A fit to the facts about n robots: their poses at tick 0, and all errors that have a prior.

Each step of Gauss-Newton is a pass over the ticks (`smoother`). The weight of a range is the probability that
it is an inlier, given the prediction from all others. Without a prior, nothing is known of the start poses;
the noise level, a factor of all variances, is integrated out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
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
from agent.estimation.problem import Problem
from agent.estimation.smoother import FitStep, Singular, Walk

FIT_STEPS = 8
"""The maximum number of Gauss-Newton steps."""

LAST_STEP = 3e-3
"""The expected length in sigmas of the next step from which on a step is the last.

Steps of Gauss-Newton decrease by a constant factor, about 0.1 with ranges of a tenth of their length. The
linear model is not computed again after the last step.
"""

LARGEST_STEP = 0.3
"""The largest change of a start position in one step, in units of the longest range."""

SHORTER_STEPS = (1.0, 0.5, 0.25, 0.0625)
"""The fractions of a step that are tried in turn until one descends.

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

GRAIN = 1e-12
"""The least variance of a range, as a fraction of the largest one that the noise of the odometry leaves.

With less, RIDGE would be more than what inaccurate ranges tell beside exact ones: steps would be too short,
and variances too small.
"""

SOFT = 0.1
"""The least smoothing of the ends of the outlier density, as a fraction of the least bias."""

LEAST_VARIANCE = 1e-300
"""The variance of a white error that is 0."""


def deviation(variance: float) -> float:
    """Return the standard deviation; infinite if rounding made the variance negative."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


class Start(NamedTuple):
    """The poses and the errors from which a fit begins."""

    poses: Array
    """The pose of each robot at tick 0, relative to the origin; shape (n, 3)."""
    errors: tuple[Errors, ...] = ()
    """The odometry errors of each robot; by default none."""
    weights: Array | None = None
    """The probability that each range is an inlier, shape (N,); by default it follows from the residuals."""


class Fit(NamedTuple):
    """The most probable start poses in the neighbourhood of the initial ones, with their uncertainty.

    Ranges are in the order of the measurements.
    """

    start: Start
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
    problem: Problem
    linear: Linear
    """The last linear model. Covariances are those of the point where it was computed."""

    def __hash__(self) -> int:
        """Return the hash of this object."""
        return id(self)

    def __eq__(self, other: object) -> bool:
        """Return whether `other` is this fit itself: what follows from one fit is computed once."""
        return self is other

    @property
    def guess(self) -> Array:
        """The pivots in the robots' frames (m) and the headings (rad) at tick 0 (see `smoother`); (3 n,)."""
        return self.problem.guess(self.start.poses.ravel())

    @property
    def of_start(self) -> Array:
        """The covariance of `guess`; shape (3 n, 3 n)."""
        n3 = self.start.poses.size
        return np.asarray(self.level * self.linear.step.inverse[:n3, :n3], np.float64)

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

    def continued(self, measured: JointMeasurements) -> Fit:
        """Return this fit with longer paths in `measured`, and no further range."""
        problem = Problem.of(measured)
        point = _begin(problem, Kernel(problem.measured), self.start)
        start, paths = _start_of(problem, point), point.walk.place
        return self._replace(start=start, poses=paths[:, -1], paths=paths, problem=problem)

    def places(self, robot: int, ticks: Places) -> Array:
        """Return the position (m, relative to the origin) of a robot at `ticks`; shape (2, N)."""
        return np.asarray(self.paths[robot, ticks, :2].T, np.float64)


class Linear(NamedTuple):
    """The linear model of a step."""

    kernel: Kernel
    walk: Walk
    """The paths at the point of the model."""
    poses: Array
    """The start poses there; shape (3 n,)."""
    variance: Array
    """The own variance of each range in m^2; shape (N,)."""
    step: FitStep

    def score(self, effect: Array) -> tuple[float, float]:
        """Return how the log-likelihood changes with an unknown that changes the ranges by `effect`, (N,).

        They are its first derivative and the information on it, with all other unknowns estimated beside it.
        """
        moves = self.walk.moves.copy()
        moves[..., 6:] = 0.0  # the errors of the odometry at the point
        still = self.walk._replace(moves=moves, residual=effect)
        back = self.kernel.step(still, self.poses, self.variance, RIDGE, math.inf)
        return float(effect @ self.step.multipliers), float(effect @ back.multipliers)


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
    def of(problem: Problem, kernel: Kernel, poses: Array, errors: _Errors) -> _Point:
        """Return the point with these start poses and errors."""
        of, walk = problem.measured, kernel.walked(poses, errors.constant, errors.white)
        off = of.mean - poses
        of_white = np.square(errors.white) / np.maximum(of.white, LEAST_VARIANCE)
        squares = np.sum(np.square(errors.common)) + np.sum(np.square(errors.constant)) + np.sum(of_white)
        cost = float(squares + off @ of.information @ off + errors.slow @ errors.of_slow)
        own = walk.residual - of.effects(walk) @ errors.common - errors.slow
        if of.scaled >= 0:  # the scale error multiplies the predicted ranges
            told = of.common[:, of.scaled]
            by_scale = np.where(told == 0.0, 0.0, of.scale * (of.rho - walk.residual))
            own += (told - by_scale) * errors.common[of.scaled]
        return _Point(poses, errors, walk, own, cost)

    def cost(self, variance: Array) -> float:
        """Return twice the negative log-density of all errors; `variance` is that of each range (m^2)."""
        return float(np.sum(np.square(self.own) / variance)) + self.prior_cost


class Convergence(NamedTuple):
    """When fits have converged."""

    steps: int = FIT_STEPS
    """The maximum number of steps."""
    shortest: float = LAST_STEP
    """A step is the last if the next one is expected to be shorter, in sigmas."""
    decrease: float = 1.0
    """The factor by which the second step is expected to be shorter than the first: below 1 if starts are
    fits to almost the same ranges."""


TO_THE_END = Convergence()
"""The convergence of fits from which a claim may follow."""


def fits(measured: JointMeasurements, starts: Iterable[Start], until: Convergence = TO_THE_END) -> list[Fit]:
    """Return the fits to all ranges in `measured` that begin at `starts`.

    A start from which there is none, because a number is too large for a float, is left out.
    """
    problem = Problem.of(measured)
    kernel, found = Kernel(problem.measured), []
    for start in starts:
        try:
            found.append(_fitted(problem, kernel, start, until))
        except Singular:
            continue
    return found


class HeldFit(NamedTuple):
    """The result of a fit in which a coordinate is held."""

    log_likelihood: float
    """The log-likelihood of the ranges, without the volume of the start poses."""
    poses: Array
    """The pose of each robot at the end of its path, relative to the origin, in m and rad; shape (n, 3)."""


def held_fit(measured: JointMeasurements, begun: Fit, steps: int) -> HeldFit:
    """Return the fit to `measured` after `steps` steps from the fit `begun`.

    The last of the ranges is not one of those of that fit. It holds a coordinate. Raises Singular.
    """
    problem = Problem.of(measured)
    kernel, noise, sigma = Kernel(problem.measured), problem.noise, problem.sigma
    start = begun.start._replace(weights=np.append(begun.weights, 1.0))
    point = _begin(problem, kernel, start)
    weights = _first_weights(problem, start, point, np.square(sigma))
    for number in range(steps + 1):
        variance = weighted_variance(sigma, weights, problem.longest)
        step = kernel.step(point.walk, point.poses, variance, RIDGE, LARGEST_STEP * problem.longest)
        if not math.isfinite(step.chi2):
            raise Singular("an error is too large for a float")
        if number == steps:
            break
        point = _after(problem, kernel, point, step, 1.0)
        if problem.robust and number == 0:
            loose = np.square(sigma) + np.sum(np.square(problem.measured.effects(point.walk)), 1)
            weights = weights_by_errors(point.walk.residual, np.sqrt(loose), noise)
            weights[problem.holding] = 1.0
        elif problem.robust:
            weights = _inliers(problem, step, variance)
    n3 = len(point.poses)
    volume = float(np.linalg.slogdet(step.inverse[:n3, :n3])[1])
    return HeldFit(_evidence(problem, point, step, weights) - 0.5 * volume, point.walk.place[:, -1])


def without_outliers(measured: JointMeasurements, starts: Sequence[Start]) -> list[Start]:
    """Return the `starts` under which some range is an outlier, with weights that leave these ranges out.

    The weights follow from the residuals and the sigmas of the ranges alone, as if the start were exact.
    Without them, a fit first allows for the uncertainty of the odometry too, which can explain an outlier
    and draw the fit away from the start.
    """
    problem = Problem.of(measured)
    if not problem.robust:
        return []
    kernel, ranges, found = Kernel(problem.measured), measured.ranges, []
    sigma = np.sqrt(np.square(ranges.sigma) + ranges.single.loosened(measured.noise.priors, measured.speeds))
    for start in starts:
        residuals = _begin(problem, kernel, start).walk.residual[problem.back]
        weights = weights_by_errors(residuals, sigma, measured.noise)
        if weights.min() < INLIER:
            found.append(start._replace(weights=weights))
    return found


def _fitted(problem: Problem, kernel: Kernel, start: Start, until: Convergence) -> Fit:
    noise, sigma = problem.noise, problem.sigma
    point = _begin(problem, kernel, start)
    loose = kernel.loosened(point.walk, point.poses, np.square(sigma))
    least = GRAIN * float(np.max(loose, initial=0.0)) if problem.noisy else 0.0
    weights, before = _first_weights(problem, start, point, loose), 0.0
    for number in range(until.steps + 1):
        variance = weighted_variance(sigma, weights, problem.longest) + least
        step = kernel.step(point.walk, point.poses, variance, RIDGE, LARGEST_STEP * problem.longest)
        if not math.isfinite(step.chi2):
            raise Singular("an error is too large for a float")
        updated = weights
        if problem.robust:
            updated = _inliers(problem, step, variance)
        freedom = int(np.count_nonzero(weights > INLIER)) - problem.free
        level = noise_level(step.chi2, freedom, noise)
        length = step.length / math.sqrt(level)
        before = length / until.decrease if number == 0 else before
        expected = length**2 / max(length, before, LAST_STEP)
        still = float(np.max(np.abs(updated - weights), initial=0.0)) < SETTLED_WEIGHT
        linear = Linear(kernel, point.walk, point.poses, variance, step)
        if number == until.steps:
            off = _off_model(point, step, variance, level)
            return _fit(problem, point, linear, weights, off if off > 1.0 else length)
        point = _stepped(problem, kernel, point, step, variance)
        # the path is corrected at least once
        still = still and (number > 0 or until.decrease < 1.0 or not problem.noisy)
        if still and expected < until.shortest and _off_model(point, step, variance, level) <= 1.0:
            return _fit(problem, point, linear, weights, expected)
        weights, before = updated, length
    raise AssertionError("the last step returns")


def _first_weights(problem: Problem, start: Start, point: _Point, loose: Array) -> Array:
    """Return the weights with which a fit begins: those of its start, or by the residuals.

    `loose` are the variances (m^2) of the ranges before any fit.
    """
    if start.weights is not None:
        weights = np.empty(len(start.weights))
        weights[problem.back] = start.weights
        return weights
    weights = np.ones(len(loose))
    if problem.robust:
        weights = weights_by_errors(point.walk.residual, np.sqrt(loose), problem.noise)
        weights[problem.holding] = 1.0
    return weights


def _inliers(problem: Problem, step: FitStep, variance: Array) -> Array:
    """Return the probability that each range is an inlier, given the prediction from all others."""
    told = (step.multipliers, step.alone, step.explained)
    weights = inlier_probabilities(*told, variance, problem.sigma, problem.noise)
    weights[problem.holding] = 1.0
    return weights


def _begin(problem: Problem, kernel: Kernel, start: Start) -> _Point:
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


def _stepped(problem: Problem, kernel: Kernel, point: _Point, step: FitStep, variance: Array) -> _Point:
    """Return the point after a step, or after that fraction of it that descends; else `point`."""
    most = point.cost(variance) + DESCENT
    for fraction in SHORTER_STEPS:
        following = _after(problem, kernel, point, step, fraction)
        if following.cost(variance) <= most:
            return following
    return point


def _after(problem: Problem, kernel: Kernel, point: _Point, step: FitStep, fraction: float) -> _Point:
    """Return the point after a `fraction` of a step."""
    n3, c = len(point.poses), problem.measured.common.shape[1]
    common, constant = np.split(step.limited[n3:], [c])
    errors = _Errors(common, constant.reshape(point.errors.constant.shape), step.white, step.slow, step.own)
    if fraction < 1.0:
        between = [one + fraction * (other - one) for one, other in zip(point.errors, errors, strict=True)]
        errors = _Errors(*between)
    return _Point.of(problem, kernel, problem.moved(point.poses, fraction * step.limited[:n3]), errors)


def _fit(problem: Problem, point: _Point, linear: Linear, weights: Array, last_step: float) -> Fit:
    """Return the fit that has ended at `point`, with the linear model of the last step."""
    n3, back, step = len(point.poses), problem.back, linear.step
    freedom = int(np.count_nonzero(weights > INLIER)) - problem.free
    level = noise_level(step.chi2, freedom, problem.noise)
    if problem.noise.sigma_degrees:
        rows = problem.by_radio
        own, sigma = point.own[rows], problem.sigma[rows]
        correlation = residual_correlation(own, weights[rows], sigma, problem.ends, level)
        level = noise_level(step.chi2, freedom, problem.noise, correlation)
    return Fit(
        _start_of(problem, point),
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
        linear,
    )


def _start_of(problem: Problem, point: _Point) -> Start:
    """Return the poses at tick 0 and the errors at `point`."""
    parts = zip(point.errors.white, point.errors.constant, problem.lengths, strict=True)
    errors = [Errors(v[:ticks], omega[:ticks], constant) for (v, omega), constant, ticks in parts]
    return Start(point.poses.reshape(-1, 3), tuple(errors))


def _evidence(problem: Problem, point: _Point, step: FitStep, weights: Array) -> float:
    """Return the log-likelihood of the ranges, with all unknowns integrated out, up to a constant.

    Outliers count by their bias.
    """
    noise, sigma, good = problem.noise, problem.sigma, weights > INLIER
    count = int(np.count_nonzero(good))
    volume = step.volume - float(np.sum(np.log(weighted_variance(sigma, weights, problem.longest)[~good])))
    weight = -0.5 * (volume - problem.log_information + math.log(2.0 * math.pi) * count)
    weight += misfit_log_likelihood(step.chi2, count - problem.free, noise)
    if noise.outliers or noise.strays:
        weight += count * math.log1p(-noise.outliers - noise.strays)
        soft = SOFT * noise.outlier_bias[0] if noise.outliers else 0.0
        residuals = point.walk.residual[~good]
        weight += float(np.sum(outliers(residuals, np.maximum(sigma[~good], soft), noise)))
    return weight
