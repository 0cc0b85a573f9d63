"""The ranges as functions of a guess and of all errors, for many fits at once.

The first axis of all arrays is the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.fit import LEAST_VARIANCE
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    OdometryNoiseModel,
    Projection,
    Ticks,
    Track,
    attributed,
    constant_effects,
    constant_errors,
    corrected,
    is_noisy,
    spread,
    symmetric,
    variances,
    wander,
)
from agent.estimation.gaussian.range_model import Predicted, Ranges, predicted
from agent.estimation.problem import MOST_MEASURED_LENGTHS, SCALE_AFTER_BIAS
from protocol.noise import Noise, VelocityNoise


class Start(NamedTuple):
    """The guess and the errors from which a fit begins."""

    guess: Array
    """The guess, in the layout of `range_model.predicted`; shape (3,) or (6,)."""
    errors: tuple[Errors, ...] = ()
    """The odometry errors of each path; by default none."""
    weights: Array | None = None
    """The probability that each range is an inlier, shape (N,); by default it follows from the residuals."""


class ErrorSizes(NamedTuple):
    """The estimated errors of ranges and odometry."""

    constant: Array
    """The constant errors in their sigmas: those of ranges, then those of each path; shape (fits, m)."""
    slow: Array
    """The slow errors of ranges, multiplied by their inverse covariance; shape (fits, N)."""
    white: Array
    """The white errors of v and omega; shape (fits, robots, 2, k)."""


class Point(NamedTuple):
    """A guess and errors, with the ranges that they predict."""

    guess: Array
    sizes: ErrorSizes
    correction: Array
    """The correction of the measured v and omega; shape (fits, robots, 2, k)."""
    path: Track
    """The corrected paths, with the axes (fits, robots)."""
    predicted: Predicted
    residuals: Array
    """The measured minus the predicted ranges (m), with the errors of ranges in them; shape (fits, N)."""
    own: Array
    """The residuals without the constant and slow errors of ranges."""
    prior_cost: Array
    """Twice the negative log-density of all errors that have a prior, up to a constant; shape (fits,)."""

    def cost(self, variance: Array) -> Array:
        """Return twice the negative log-density of all errors, up to a constant; shape (fits,).

        `variance` is that of each range (m^2) for known constant and slow errors.
        """
        of_ranges: Array = np.add.reduce(np.square(self.own) / variance, -1)
        return self.prior_cost + of_ranges


class LinearModel(NamedTuple):
    """The ranges as linear functions of the odometry errors, at a point."""

    model: OdometryNoiseModel
    rows: Projection
    """The ranges as rows along the paths."""
    dense: Array | None
    """The covariance (m^2) from white odometry noise and slow errors, shape (fits, N, N), or None."""
    columns: Array
    """The effects (m) of the constant errors, in the order of `ErrorSizes`; shape (fits, N, m)."""
    innovation: Array


class Problem(NamedTuple):
    """The measurements and the priors of a fit, which do not change during the iteration."""

    measured: Array
    """The measured v and omega; shape (robots, 2, k). A shorter path is continued at rest, without noise."""
    lengths: tuple[int, ...]
    """The number of ticks of each path."""
    slip: Array | None
    """The lateral slip (rad) of each robot at each tick; shape (robots, k). None: 0."""
    period: float
    ranges: Ranges
    noise: Noise
    apart: tuple[float, float]
    patterns: Array
    """The effects of the constant errors of each path; shape (robots, m, 2, k). See `constant_errors`."""
    variances: Array | None
    """The variances of v and omega at each tick; shape (robots, 2, k). None without white odometry noise."""
    ticks: Ticks
    common: Array
    """The effects (m) of the constant errors of the ranges, by the measured ones; shape (N, m)."""
    scale: Array | None
    """The sigma of the scale error of each range, shape (N,), if it multiplies the predicted ranges.

    None: it multiplies the measured ones; see MOST_MEASURED_LENGTHS.
    """
    slow: Array | None
    """The covariance (m^2) of the slow errors of the ranges; None without them."""

    @staticmethod
    def of(paths: Sequence[Track], ranges: Ranges, noise: Noise, apart: tuple[float, float]) -> Problem:
        """Return the problem of robots that measured `paths`."""
        lengths, period = tuple([len(path.v) for path in paths]), paths[0].period
        measured = np.zeros((len(paths), 2, max(lengths)))
        for path, velocities, ticks in zip(paths, measured, lengths, strict=True):
            velocities[0, :ticks], velocities[1, :ticks] = path.v, path.omega
        v, omega, white = measured[:, 0], measured[:, 1], None
        if noise.odometry != VelocityNoise() or any(path.extra is not None for path in paths):
            white = variances(v, omega, noise.odometry)
            for q, path, ticks in zip(white, paths, lengths, strict=True):
                q[:, ticks:] = 0.0
                if path.extra is not None:
                    q[:, :ticks] += path.extra
        scale = np.full(len(ranges.rho), noise.priors.range_scale)
        slip = None
        if any(path.slip is not None for path in paths):
            slip = np.zeros(v.shape)
            for angles, path, ticks in zip(slip, paths, lengths, strict=True):
                angles[:ticks] = 0.0 if path.slip is None else path.slip
        return Problem(
            measured,
            lengths,
            slip,
            period,
            ranges,
            noise,
            apart,
            constant_errors(v, omega, noise),
            white,
            Ticks.of(ranges.tick, measured.shape[-1]),
            ranges.common_errors(noise.priors),
            scale if len(ranges.rho) > MOST_MEASURED_LENGTHS and noise.priors.range_scale else None,
            ranges.slow_errors(noise.priors, period),
        )

    def common_at(self, distance: Array) -> Array:
        """Return the effects (m) of the constant errors on ranges of that length (m); shape (..., N, m).

        `distance` are the predicted ranges, shape (..., N).
        """
        if self.scale is None:
            return self.common
        common = np.broadcast_to(self.common, (*distance.shape, self.common.shape[1])).copy()
        common[..., SCALE_AFTER_BIAS if self.noise.priors.range_bias else 0] = self.scale * distance
        return common

    @property
    def free(self) -> slice:
        """The unknowns of the guess that the ranges determine; one anchor does not tell the rotation."""
        return slice(0, 2) if len(self.lengths) == 1 else slice(0, 6)

    @property
    def noisy(self) -> bool:
        """True if odometry may differ from the executed motion."""
        return is_noisy(self.noise)

    @property
    def robust(self) -> bool:
        """True if a range may be an outlier."""
        return bool(self.noise.outliers or self.noise.strays)

    def drift(self, path: Track, robot: int) -> OdometryNoiseModel:
        """Return the noise model along the corrected path of one robot."""
        ticks = self.lengths[robot]
        correction = np.stack((path.v, path.omega)) - self.measured[robot, :, :ticks]
        white = None if self.variances is None else self.variances[robot, :, :ticks]
        return wander(path, correction, self.patterns[robot, :, :, :ticks], white)

    def begin(self, starts: Sequence[Start]) -> Point:
        """Return the points at `starts`. White errors are 0 in the ticks that have come since."""
        count, common = len(starts), self.common.shape[1]
        white = np.zeros((count, *self.measured.shape))
        constant = np.zeros((count, common + self.patterns.shape[0] * self.patterns.shape[1]))
        by_path = constant[:, common:].reshape(count, *self.patterns.shape[:2])
        for i, start in enumerate(starts):
            for robot, errors in enumerate(start.errors):
                known = min(len(errors.v), self.lengths[robot])
                white[i, robot, 0, :known] = errors.v[:known]
                white[i, robot, 1, :known] = errors.omega[:known]
                by_path[i, robot] = errors.constant
        constant[:, common:] = by_path.reshape(count, -1)
        sizes = ErrorSizes(constant, np.zeros((count, len(self.ranges.rho))), white)
        return self.point(np.stack([start.guess for start in starts]), sizes)

    def point(self, guess: Array, sizes: ErrorSizes) -> Point:
        """Return the points with these guesses and errors."""
        (constant, slow, white), common = sizes, self.common.shape[1]
        robots, m, _, k = self.patterns.shape
        by_path = constant[:, common:].reshape(len(guess), robots, 1, m)
        correction = (by_path @ self.patterns.reshape(robots, m, 2 * k)).reshape(len(guess), robots, 2, k)
        prior_cost: Array = np.add.reduce(np.square(constant), -1)
        if self.variances is not None:
            correction += white
            of_white = np.square(white) / np.maximum(self.variances, LEAST_VARIANCE)
            prior_cost += np.add.reduce(of_white, (-1, -2, -3))
        path = corrected(self.measured, correction, self.period, self.slip)
        ranges = predicted(guess, path.place[..., self.ticks.tick], self.ranges, self.apart)
        residuals = self.ranges.rho - ranges.distance
        if self.scale is None:
            own = residuals - constant[:, :common] @ self.common.T
        else:
            own = residuals - product(self.common_at(ranges.distance), constant[:, :common])
        if self.slow is not None:
            errors = slow @ self.slow
            own -= errors
            prior_cost += np.add.reduce(errors * slow, -1)
        return Point(guess, sizes, correction, path, ranges, residuals, own, prior_cost)

    def paths(self, points: Point, i: int) -> tuple[Track, ...]:
        """Return the paths of the robots at the point with index `i`."""
        return tuple([points.path.one((i, robot), ticks) for robot, ticks in enumerate(self.lengths)])

    def linearised(self, point: Point) -> LinearModel:
        """Return the linear model of the ranges at `point`."""
        model = wander(point.path, point.correction, self.patterns, self.variances)
        rows = Projection.positions(point.path, self.ticks, point.predicted.directions)
        fits, n = point.residuals.shape
        dense = None if self.slow is None else np.broadcast_to(self.slow, (fits, n, n))
        if self.variances is not None:
            left, right = [one.reshape(fits, -1, n) for one in spread(model, rows)]
            white = symmetric(left, right, self.ticks)
            dense = white if dense is None else white + dense
        effects = constant_effects(model, rows)
        innovation = point.residuals + np.add.reduce(effects[:, :, -1], 1)
        common = self.common.shape[1]
        columns = np.empty((fits, n, common + effects.shape[1] * (effects.shape[2] - 1)))
        columns[:, :, :common] = self.common_at(point.predicted.distance)
        columns[:, :, common:] = effects[:, :, :-1].reshape(fits, -1, n).mT
        return LinearModel(model, rows, dense, columns, innovation)

    def loosened(self, linear: LinearModel) -> Array:
        """Return the variance (m^2) of each range, with that of the errors that ranges have in common."""
        loose: Array = np.square(self.ranges.sigma) + np.add.reduce(np.square(linear.columns), -1)
        return loose if linear.dense is None else loose + np.diagonal(linear.dense, axis1=1, axis2=2)

    def sizes(self, point: Point, linear: LinearModel, left: Array) -> ErrorSizes:
        """Return the errors that explain best what is left of the innovation, shape (fits, N).

        It is multiplied by the inverse covariance of the ranges.
        """
        constant = product(linear.columns.mT, left)
        if self.variances is None:
            return ErrorSizes(constant, left, point.sizes.white)
        return ErrorSizes(constant, left, attributed(linear.model, linear.rows, left[:, None]))

    def errors(self, constant: Array, white: Array) -> tuple[Errors, ...]:
        """Return the odometry errors of each robot in one fit; empty if odometry is exact."""
        if not self.noisy:
            return ()
        by_path = constant[self.common.shape[1] :].reshape(self.patterns.shape[:2])
        parts = zip(white, by_path, self.lengths, strict=True)
        return tuple([Errors(v[:ticks], omega[:ticks], some) for (v, omega), some, ticks in parts])


def product(matrix: Array, vector: Array) -> Array:
    """Return the products of matrices, (..., n, m), and vectors, (..., m)."""
    product: Array = (matrix @ vector[..., None])[..., 0]
    return product
