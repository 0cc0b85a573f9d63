"""One least-squares fit to the facts about n robots: their start poses, and all errors that have a prior.

The model is that of two robots (`least_squares`), and so are the noise level, the weights of outliers and the
evidence of a fit. Its unknowns are the pose of each robot at tick 0 and the constant errors of ranges and
odometry; white errors are eliminated in the space of the ranges (`joint_covariance`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.descent import DESCENT, LARGEST_STEP, SHORTER_STEPS
from agent.estimation.gaussian.joint_covariance import JointCovariance
from agent.estimation.gaussian.joint_problem import (
    JointErrorSizes,
    JointLinearModel,
    JointPoint,
    JointProblem,
)
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.least_squares import FIT_STEPS, LAST_STEP, RIDGE, SETTLED_WEIGHT, SOFT
from agent.estimation.gaussian.noise_level import (
    INLIER,
    misfit_log_likelihood,
    noise_level,
    residual_correlation,
)
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    OdometryNoiseModel,
    Places,
    Projection,
    constant_effects,
    spread,
    symmetric,
)
from agent.estimation.gaussian.range_covariance import inverse_of
from agent.estimation.gaussian.range_model import outliers
from agent.estimation.gaussian.range_weights import BLIND, weighted_variance, weights_by_errors
from protocol.motion import Pose, placed
from protocol.noise import Noise


class JointStart(NamedTuple):
    """The poses and the errors from which a joint fit begins."""

    poses: Array
    """The pose of each robot at tick 0, relative to the origin; shape (n, 3)."""
    errors: tuple[Errors, ...] = ()
    """The odometry errors of each robot; by default none."""


class JointFit(NamedTuple):
    """The most probable start poses in the neighbourhood of the initial ones, with their uncertainty."""

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
    """The squared innovations, weighted by their inverse covariance, as told."""
    last_step: float
    """The expected length of the next Gauss-Newton step, in sigmas."""
    level: float
    """The estimate of the noise level tau^2."""
    constants: Array
    """The constant errors of ranges, then of each robot's odometry, in their sigmas; shape (r + m n,)."""
    constant_sigmas: Array
    """Their standard deviations in the same unit."""
    problem: JointProblem

    @property
    def ticks(self) -> Places:
        """The tick of each range; shape (N,)."""
        return self.problem.ranges.tick

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
        x, y, heading = self.start.poses[robot]
        path = self.problem.point(self.start.poses, self.sizes).path
        return np.stack(placed(Pose(x, y, heading), path.x[robot, ticks], path.y[robot, ticks]))

    @property
    def sizes(self) -> JointErrorSizes:
        """The errors of the odometry, for paths; those of ranges are left out."""
        return self.problem.begin(self.start.poses, self.start.errors).sizes


class _System(NamedTuple):
    """One Gauss-Newton step."""

    covariance: JointCovariance
    weighted: Array
    """The columns and the innovation, multiplied by the inverse covariance; shape (N, unknowns + 1)."""
    information: Array
    """That of all unknowns, with the priors of the constant errors."""
    inverse: Array
    gradient: Array
    solution: Array
    """The change of the start poses, and the constant errors."""
    of_poses: Array
    """The information of the start poses, with the constant errors integrated out."""
    multipliers: Array
    """The innovation that remains, multiplied by the inverse covariance; shape (N,)."""
    chi2: float


def joint_fit(measured: JointMeasurements, start: JointStart, steps: int = FIT_STEPS) -> JointFit:
    """Return the fit to all ranges in `measured` that begins at `start`, after at most `steps` steps."""
    problem = JointProblem.of(measured)
    noise, sigma = problem.noise, problem.ranges.sigma
    point = problem.begin(start.poses, start.errors)
    weights, before = np.ones(len(sigma)), 0.0
    for step in range(steps + 1):
        linear = problem.linearised(point)
        if problem.robust and step == 0:
            weights = weights_by_errors(point.residuals, np.sqrt(problem.loosened(linear)), noise)
        variance = weighted_variance(sigma, weights)
        system = _solved(problem, point, linear, problem.covariance(linear, variance))
        updated = _inlier_probabilities(system, weights, sigma, noise) if problem.robust else weights
        length = _length(problem, system, weights)
        before = length if step == 0 else before
        expected = length**2 / max(length, before, LAST_STEP)
        still = (
            float(np.max(np.abs(updated - weights), initial=0.0)) < SETTLED_WEIGHT and expected < LAST_STEP
        )
        if step == steps:
            return _fit(problem, point, point, linear, system, weights, length)
        begun, point = point, _stepped(problem, point, linear, system, variance)
        if still and step > 0:
            return _fit(problem, point, begun, linear, system, weights, expected)
        weights, before = updated, length
    raise AssertionError("the last step returns")


def _solved(
    problem: JointProblem, point: JointPoint, linear: JointLinearModel, covariance: JointCovariance
) -> _System:
    poses = 3 * len(problem.lengths)
    weighted = covariance.solve(np.column_stack((linear.columns, linear.innovation)))
    products = linear.columns.T @ weighted
    information, gradient = products[:, :-1], products[:, -1]
    if (prior := problem.prior) is not None:
        off = (prior.mean - point.poses).ravel()
        information[:poses, :poses] += prior.information
        gradient[:poses] += prior.information @ off
    diagonal = np.einsum("ii->i", information)
    diagonal[:poses] += RIDGE + RIDGE * diagonal[:poses]
    diagonal[poses:] += 1.0
    inverse = inverse_of(information)
    solution = inverse @ gradient
    multipliers = weighted[:, -1] - weighted[:, :-1] @ solution
    of_poses = inverse_of(inverse[:poses, :poses])
    chi2 = max(float(linear.innovation @ multipliers), 0.0)
    if prior is not None:
        chi2 = max(chi2 + float(off @ prior.information @ (off - solution[:poses])), 0.0)
    return _System(
        covariance, weighted, information, inverse, gradient, solution, of_poses, multipliers, chi2
    )


def _inlier_probabilities(system: _System, weights: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier, given the prediction from all other ranges."""
    alone, weighted = system.covariance.precisions, system.weighted[:, :-1]
    explained = np.add.reduce((weighted @ system.inverse) * weighted, 1)
    precision = np.maximum(alone - explained, BLIND * alone)
    error = system.multipliers / precision
    variance = np.maximum(1.0 / precision - weighted_variance(sigma, weights), 0.0) + np.square(sigma)
    return weights_by_errors(error, np.sqrt(variance), noise)


def _length(problem: JointProblem, system: _System, weights: Array) -> float:
    """Return the length of a step of the start poses, in sigmas."""
    poses = 3 * len(problem.lengths)
    change = system.solution[:poses]
    level = noise_level(system.chi2, int(np.count_nonzero(weights > INLIER)) - problem.free, problem.noise)
    return math.sqrt(abs(float(change @ system.of_poses @ change)) / level)


def _stepped(
    problem: JointProblem, point: JointPoint, linear: JointLinearModel, system: _System, variance: Array
) -> JointPoint:
    """Return the point after a step, or after that fraction of it that descends; else `point`."""
    poses, size = point.poses, point.poses.size
    change = system.solution[:size]
    largest = float(np.max(np.abs(change), initial=0.0))
    constants, multipliers = system.solution[size:], system.multipliers
    if largest > LARGEST_STEP:
        change = np.asarray(change * (LARGEST_STEP / largest), np.float64)
        left = system.gradient[size:] - system.information[size:, :size] @ change
        constants = np.asarray(np.linalg.solve(system.information[size:, size:], left), np.float64)
        multipliers = system.weighted[:, -1] - system.weighted[:, :-1] @ np.concatenate((change, constants))
    common = len(point.sizes.common)
    sizes = JointErrorSizes(
        constants[:common],
        constants[common:].reshape(point.sizes.constant.shape),
        problem.white(linear, multipliers),
        multipliers,
    )
    most, ends = point.cost(variance) + DESCENT, poses + change.reshape(poses.shape)
    following = problem.point(ends, sizes)
    for fraction in SHORTER_STEPS:
        if following.cost(variance) <= most:
            return following
        between = [one + fraction * (other - one) for one, other in zip(point.sizes, sizes, strict=True)]
        following = problem.point(poses + fraction * (ends - poses), JointErrorSizes(*between))
    return following if following.cost(variance) <= most else point


# --- the result -------------------------------------------------------------------------------------------


def _fit(
    problem: JointProblem,
    point: JointPoint,
    begun: JointPoint,
    linear: JointLinearModel,
    system: _System,
    weights: Array,
    last_step: float,
) -> JointFit:
    """Return the fit that has ended at `point`, with the linear model of the point `begun`."""
    robots, size = len(problem.lengths), 3 * len(problem.lengths)
    freedom = int(np.count_nonzero(weights > INLIER)) - problem.free
    level = noise_level(system.chi2, freedom, problem.noise)
    if problem.noise.sigma_degrees:
        ranges = problem.ranges
        correlation = residual_correlation(point.own, weights, ranges.sigma, ranges.ends, level)
        level = noise_level(system.chi2, freedom, problem.noise, correlation)
    errors = [
        Errors(v[:ticks], omega[:ticks], constant)
        for (v, omega), constant, ticks in zip(
            point.sizes.white, point.sizes.constant, problem.lengths, strict=True
        )
    ]
    ends = np.array([_end(point, robot, ticks) for robot, ticks in enumerate(problem.lengths)])
    return JointFit(
        JointStart(point.poses, tuple(errors)),
        ends.reshape(robots, 3),
        level * _end_covariance(problem, begun, linear, system),
        _evidence(problem, point, system, weights),
        point.residuals,
        weights,
        system.chi2,
        last_step,
        level,
        system.solution[size:],
        np.sqrt(np.maximum(np.diagonal(system.inverse)[size:], 0.0)),
        problem,
    )


def _end(point: JointPoint, robot: int, tick: int) -> tuple[float, float, float]:
    """Return the pose of a robot at `tick`."""
    x, y, heading = point.poses[robot].tolist()
    px, py = float(point.path.x[robot, tick]), float(point.path.y[robot, tick])
    return *placed(Pose(x, y, heading), px, py), heading + float(point.path.heading[robot, tick])


def _end_covariance(
    problem: JointProblem, point: JointPoint, linear: JointLinearModel, system: _System
) -> Array:
    """Return the covariance of all poses at the ends of the paths, with the sigmas as told; (3 n, 3 n).

    The surveying errors of anchors are considered (Schmidt-Kalman): they are not estimated.
    """
    robots, size = len(problem.lengths), 3 * len(problem.lengths)
    n, constants = len(problem.ranges.rho), len(problem.common.T)
    prior, cross = np.zeros((size, size)), np.zeros((size, n))
    turn = np.zeros((size, linear.columns.shape[1]))
    m = point.sizes.constant.shape[1]
    for robot, ticks in enumerate(problem.lengths):
        own, path = slice(3 * robot, 3 * robot + 3), point.path.one((robot,), problem.ticks.k)
        heading = float(point.poses[robot, 2])
        end = Projection.pose(path, ticks, heading)
        model = _of_robot(linear, robot)
        every = end.then(Projection(problem.ticks, linear.rows.weights[robot]))
        both = symmetric(*spread(model, end), end.ticks)
        left, right = spread(model, every)
        later = left[:, :3].T @ right[:, 3:], right[:, :3].T @ left[:, 3:]
        prior[own, own] = both
        cross[own] = np.where(ticks >= problem.ticks.tick, *later)
        x, y, _ = _end(point, robot, ticks)
        turn[own, own] = np.eye(3)
        turn[3 * robot, 3 * robot + 2] = -(y - point.poses[robot, 1])
        turn[3 * robot + 1, 3 * robot + 2] = x - point.poses[robot, 0]
        begin = size + constants + m * robot
        turn[own, begin : begin + m] = constant_effects(model, end)[:-1].T
    gain = system.covariance.solve(cross.T).T
    left_over = turn - gain @ linear.columns
    covariance = prior - gain @ cross.T + left_over @ system.inverse @ left_over.T
    if survey := problem.noise.priors.survey_error:
        by_range = gain + left_over @ system.inverse @ system.weighted[:, :-1].T
        ranges = problem.ranges
        for place in sorted({tuple(one) for one in ranges.place[: ranges.of_anchors].tolist()}):
            rows = np.flatnonzero((ranges.second < 0) & np.all(ranges.place == place, 1))
            outward = point.jacobian.reshape(n, robots, 3)[rows, ranges.first[rows], :2]
            by_error = by_range[:, rows] @ outward
            covariance += survey**2 * by_error @ by_error.T
    return np.asarray(covariance, np.float64)


def _of_robot(linear: JointLinearModel, robot: int) -> OdometryNoiseModel:
    """Return the noise model of one robot."""
    b, shift, moves, variances, sums = linear.model
    assert variances is not None
    assert sums is not None
    return OdometryNoiseModel(b[robot], shift[robot], moves[robot], variances[robot], sums[robot])


def _evidence(problem: JointProblem, point: JointPoint, system: _System, weights: Array) -> float:
    """Return the log-likelihood of the ranges, with all unknowns integrated out, up to a constant.

    Outliers count by their bias, as in fits of two robots.
    """
    noise, sigma, good = problem.noise, problem.ranges.sigma, weights > INLIER
    count = int(np.count_nonzero(good))
    volume = system.covariance.log_determinant + float(np.linalg.slogdet(system.information)[1])
    volume -= float(np.sum(np.log(weighted_variance(sigma, weights)[~good])))
    weight = -0.5 * (volume + math.log(2.0 * math.pi) * count)
    weight += misfit_log_likelihood(system.chi2, count - problem.free, noise)
    if noise.outliers or noise.strays:
        weight += count * math.log1p(-noise.outliers - noise.strays)
        soft = SOFT * noise.outlier_bias[0] if noise.outliers else 0.0
        residuals = point.residuals[~good]
        weight += float(np.sum(outliers(residuals, np.maximum(sigma[~good], soft), noise)))
    return weight
