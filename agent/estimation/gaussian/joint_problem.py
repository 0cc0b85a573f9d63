"""The ranges of n robots as functions of their start poses and of all errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.joint_covariance import JointCovariance, joint_covariance
from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges, PosePrior
from agent.estimation.gaussian.linear_model import LEAST_VARIANCE
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    OdometryNoiseModel,
    Places,
    Projection,
    Ticks,
    Track,
    attributed,
    constant_effects,
    constant_errors,
    corrected,
    spread,
    symmetric,
    variances,
    wander,
)
from agent.estimation.gaussian.range_covariance import GRAIN
from agent.estimation.gaussian.range_model import SMALLEST_DISTANCE
from protocol.noise import Noise


class JointErrorSizes(NamedTuple):
    """The estimated errors of the ranges and of the odometry of n robots."""

    common: Array
    """The constant errors of ranges in their sigmas; shape (r,)."""
    constant: Array
    """The constant errors of each robot's odometry in their sigmas; shape (n, m)."""
    white: Array
    """The white errors of v and omega; shape (n, 2, k)."""
    slow: Array
    """The slow errors of ranges, multiplied by their inverse covariance; shape (N,)."""


class JointPoint(NamedTuple):
    """Start poses and errors, with the ranges that they predict."""

    poses: Array
    """The x and y (m, relative to the origin) and heading (rad) of each robot at tick 0; shape (n, 3)."""
    sizes: JointErrorSizes
    correction: Array
    """The correction of the measured v and omega; shape (n, 2, k)."""
    path: Track
    """The corrected paths, in the frames of the start poses; the axis in front is the robot."""
    jacobian: Array
    """The derivatives of the ranges with respect to the start poses; shape (N, 3 n)."""
    directions: Array
    """The derivatives with respect to the positions, in the frames of the start poses; shape (n, 2, N)."""
    residuals: Array
    """The measured minus the predicted ranges (m), with the errors of ranges in them; shape (N,)."""
    own: Array
    """The residuals without the constant and slow errors of ranges; shape (N,)."""
    prior_cost: float
    """Twice the negative log-density of all errors that have a prior, up to a constant."""

    def cost(self, variance: Array) -> float:
        """Return twice the negative log-density of all errors; `variance` is that of each range (m^2)."""
        return float(np.sum(np.square(self.own) / variance)) + self.prior_cost


class JointLinearModel(NamedTuple):
    """The ranges as linear functions of all errors, at a point."""

    model: OdometryNoiseModel
    rows: Projection
    columns: Array
    """The effects of the unknowns on the ranges: start poses, constant errors of ranges, and those of each
    robot's odometry; shape (N, 3 n + r + m n)."""
    innovation: Array
    """The difference (m) of the ranges from their prediction without any error; shape (N,)."""
    left: Array
    right: Array
    """The factors of the covariance from white odometry noise, see `spread`; shape (n, 3, N) each."""


class JointProblem(NamedTuple):
    """The measurements and the priors of a joint fit, which do not change during the iteration."""

    measured: Array
    """The measured v and omega; shape (n, 2, k). A shorter path is continued at rest, without noise."""
    lengths: tuple[int, ...]
    """The number of ticks of each path."""
    slip: Array | None
    period: float
    ranges: JointRanges
    noise: Noise
    patterns: Array
    """The effects of the constant errors of each path; shape (n, m, 2, k). See `constant_errors`."""
    variances: Array
    """The variances of v and omega at each tick; shape (n, 2, k)."""
    ticks: Ticks
    common: Array
    """The effects (m) of the constant errors of the ranges; shape (N, r)."""
    slow: Array | None
    """The covariance (m^2) of the slow errors of the ranges; None without them."""
    blocks: tuple[tuple[slice, Places], ...]
    """The rows of each robot: those of its ranges to anchors, and the others among those between robots."""
    prior: PosePrior | None = None
    """The prior of the start poses; None: they are unknown."""

    @staticmethod
    def of(measured: JointMeasurements) -> JointProblem:
        """Return the problem of all robots in `measured`."""
        noise, paths, ranges = measured.noise, measured.paths, measured.ranges
        lengths = tuple([len(path.v) for path in paths])
        velocities = np.zeros((len(paths), 2, max(lengths, default=0)))
        slip = np.zeros((len(paths), velocities.shape[-1]))
        for i, path in enumerate(paths):
            velocities[i, 0, : lengths[i]], velocities[i, 1, : lengths[i]] = path.v, path.omega
            if path.slip is not None:
                slip[i, : lengths[i]] = path.slip
        v, omega = velocities[:, 0], velocities[:, 1]
        white = variances(v, omega, noise.odometry)
        for i, path in enumerate(paths):
            white[i, :, lengths[i] :] = 0.0
            if path.extra is not None:
                white[i, :, : lengths[i]] += path.extra
        count, blocks = ranges.of_anchors, []
        for robot in range(len(paths)):
            own = np.searchsorted(ranges.first[:count], (robot, robot + 1))
            blocks.append((slice(int(own[0]), int(own[1])), np.flatnonzero(ranges.of(robot)[count:])))
        return JointProblem(
            velocities,
            lengths,
            slip if slip.any() else None,
            measured.period,
            ranges,
            noise,
            constant_errors(v, omega, noise),
            white,
            Ticks.of(ranges.tick, velocities.shape[-1]),
            ranges.single.common_errors(noise.priors),
            ranges.single.slow_errors(noise.priors, measured.period),
            tuple(blocks),
            measured.prior,
        )

    @property
    def free(self) -> int:
        """The number of unknowns of the start poses that only the ranges determine."""
        return 3 * len(self.lengths) - (self.prior.rank if self.prior is not None else 0)

    @property
    def robust(self) -> bool:
        """True if a range may be an outlier."""
        return bool(self.noise.outliers or self.noise.strays)

    def begin(self, poses: Array, errors: Sequence[Errors]) -> JointPoint:
        """Return the point at start `poses`, with the odometry `errors` of each robot, if there are any."""
        robots, m, _, k = self.patterns.shape
        constant, white = np.zeros((robots, m)), np.zeros((robots, 2, k))
        for i, one in enumerate(errors):
            known = min(len(one.v), self.lengths[i])
            white[i, 0, :known], white[i, 1, :known] = one.v[:known], one.omega[:known]
            if len(one.constant):
                constant[i] = one.constant
        nothing = np.zeros(self.common.shape[1]), np.zeros(len(self.ranges.rho))
        return self.point(poses, JointErrorSizes(nothing[0], constant, white, nothing[1]))

    def point(self, poses: Array, sizes: JointErrorSizes) -> JointPoint:
        """Return the point with these start poses and errors."""
        robots, m, _, k = self.patterns.shape
        flat = self.patterns.reshape(robots, m, 2 * k)
        correction = (sizes.constant[:, None, :] @ flat).reshape(robots, 2, k) + sizes.white
        of_white = np.square(sizes.white) / np.maximum(self.variances, LEAST_VARIANCE)
        cost = float(np.sum(np.square(sizes.common)) + np.sum(np.square(sizes.constant)) + np.sum(of_white))
        if self.prior is not None:
            off = (self.prior.mean - poses).ravel()
            cost += float(off @ self.prior.information @ off)
        path = corrected(self.measured, correction, self.period, self.slip)
        ranges, every = self.ranges, np.arange(len(self.ranges.rho))
        two = ranges.second >= 0
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])

        def turned(which: Places) -> tuple[Array, Array]:
            x, y = path.x[which, self.ticks.tick], path.y[which, self.ticks.tick]
            return c[which] * x - s[which] * y, s[which] * x + c[which] * y

        wx, wy = turned(ranges.first)
        ox, oy = turned(ranges.second)
        dx = wx + poses[ranges.first, 0] - np.where(two, ox + poses[ranges.second, 0], ranges.place[:, 0])
        dy = wy + poses[ranges.first, 1] - np.where(two, oy + poses[ranges.second, 1], ranges.place[:, 1])
        distance = np.maximum(np.hypot(dx, dy), SMALLEST_DISTANCE)
        nx, ny = dx / distance, dy / distance
        jacobian, directions = np.zeros((len(every), robots, 3)), np.zeros((robots, 2, len(every)))
        for rows, which, mx, my, x, y in (
            (every[two], ranges.second[two], -nx[two], -ny[two], ox[two], oy[two]),
            (every, ranges.first, nx, ny, wx, wy),
        ):
            jacobian[rows, which] = np.stack((mx, my, my * x - mx * y), 1)
            directions[which, 0, rows] = c[which] * mx + s[which] * my
            directions[which, 1, rows] = c[which] * my - s[which] * mx
        residuals = ranges.rho - distance
        own = residuals - self.common @ sizes.common
        if self.slow is not None:
            slow = self.slow @ sizes.slow
            own, cost = own - slow, cost + float(slow @ sizes.slow)
        return JointPoint(
            poses, sizes, correction, path, jacobian.reshape(len(every), -1), directions, residuals, own, cost
        )

    def linearised(self, point: JointPoint) -> JointLinearModel:
        """Return the linear model of the ranges at `point`."""
        model = wander(point.path, point.correction, self.patterns, self.variances)
        rows = Projection.positions(point.path, self.ticks, point.directions)
        effects = constant_effects(model, rows)
        n = len(self.ranges.rho)
        of_odometry = effects[:, :-1].reshape(-1, n).T
        columns = np.concatenate((point.jacobian, self.common, of_odometry), 1)
        innovation = point.residuals + np.add.reduce(effects[:, -1], 0)
        return JointLinearModel(model, rows, columns, innovation, *spread(model, rows))

    def covariance(self, linear: JointLinearModel, variance: Array) -> JointCovariance:
        """Return that of all ranges from white and slow errors; `variance` is the own one of each (m^2)."""
        count, own = self.ranges.of_anchors, []
        mutual = np.diag(variance[count:])
        if self.slow is not None:
            mutual += self.slow[count:, count:]
        for robot, (of_anchors, places) in enumerate(self.blocks):
            rows = np.concatenate((np.arange(of_anchors.start, of_anchors.stop), count + places))
            ticks = Ticks.of(self.ranges.tick[rows], self.ticks.k)
            white = symmetric(linear.left[robot][:, rows], linear.right[robot][:, rows], ticks)
            diagonal = np.einsum("ii->i", white)
            diagonal += GRAIN * diagonal.max(initial=0.0)
            anchors = of_anchors.stop - of_anchors.start
            diagonal[:anchors] += variance[of_anchors]
            if self.slow is not None:
                white[:anchors, :anchors] += self.slow[of_anchors, of_anchors]
            own.append(white)
        return joint_covariance(own, self.blocks, mutual)

    def loosened(self, linear: JointLinearModel) -> Array:
        """Return the variance (m^2) of each range, with that of the errors that ranges have in common."""
        constants = linear.columns[:, 3 * len(self.lengths) :]
        loose: Array = np.square(self.ranges.sigma) + np.add.reduce(np.square(constants), 1)
        loose += np.add.reduce(linear.left * linear.right, (0, 1))
        return loose if self.slow is None else loose + np.diagonal(self.slow)

    def white(self, linear: JointLinearModel, multipliers: Array) -> Array:
        """Return the white errors of odometry that explain weighted residuals best; shape (n, 2, k)."""
        return attributed(linear.model, linear.rows, multipliers)
