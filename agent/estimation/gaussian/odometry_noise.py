"""The path from a robot's odometry, and the covariance that odometry noise causes along it.

Noise at one tick moves every later position, so errors are correlated along the path. The covariance between
any two ticks follows from sums up to the earlier one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.noise import Noise, VelocityNoise

Array = NDArray[np.float64]
Places = NDArray[np.intp]


class Track(NamedTuple):
    """A robot's odometry over [0, k], in the frame of tick 0."""

    v: Array
    """The forward velocity (m/s) over each tick; shape (k,)."""
    omega: Array
    """The angular velocity (rad/s) over each tick; shape (k,)."""
    period: float
    """The sampling period T_s (s)."""
    x: Array
    """The position (m) at each tick; shape (k + 1,)."""
    y: Array
    heading: Array
    """The heading (rad, not wrapped) at each tick; shape (k + 1,)."""
    shift: Array
    """The displacement per unit of v (s) over each tick; shape (2, k)."""


def track(v: Array, omega: Array, period: float) -> Track:
    """Return the path from dead reckoning with eq. (1a), from the origin."""
    turn = period * omega
    heading = _summed(turn)
    half = 0.5 * turn
    course = heading[:-1] + half
    unit = period * _sinc(half)
    shift = np.empty((2, len(v)))
    np.multiply(unit, np.cos(course), out=shift[0])
    np.multiply(unit, np.sin(course), out=shift[1])
    x, y = _summed(v * shift)
    return Track(v, omega, period, x, y, heading, shift)


def _sinc(half: Array) -> Array:
    """Return sin(x) / x."""
    safe = np.where(half == 0.0, 1.0, half)
    return np.where(half == 0.0, 1.0, np.sin(safe) / safe)


def _summed(values: Array) -> Array:
    """Return the sums of all values before each tick, along the last axis; (..., k) -> (..., k + 1)."""
    sums = np.zeros((*values.shape[:-1], values.shape[-1] + 1))
    np.cumsum(values, axis=-1, out=sums[..., 1:])
    return sums


class OdometryNoiseModel(NamedTuple):
    """Prefix sums from which the covariance of a path follows, for noise in its v and omega.

    Noise e in omega at tick j moves the position at a later tick t, along u, by (lever - u . b_j) e, where
    lever = T_s u . perp(p_t). Noise e in v moves it by u . shift_j e.
    """

    variances: Array
    """The variances of v and omega, (m/s)^2 and (rad/s)^2, at each tick; shape (2, k)."""
    b: Array
    """The vector b_j (m s) at each tick; shape (2, k)."""
    shift: Array
    """The displacement per unit of v (s) at each tick; shape (2, k)."""
    sums: Array
    """The prefix sums of six terms up to each tick; shape (6, k + 1).

    The terms are q_omega; the x and y of q_omega b; the xx, xy and yy of q_omega b b' + q_v shift shift'.
    """
    patterns: Array
    """The effect of each constant error, of one sigma, on v and omega at each tick; shape (m, 2, k)."""
    moves: Array
    """The prefix sums of these effects on heading, x and y; shape (m, 3, k + 1)."""

    def since(self, tick: int) -> OdometryNoiseModel:
        """Return the model of a robot whose odometry was exact before `tick`."""
        variances, sums = self.variances.copy(), self.sums - self.sums[:, tick : tick + 1]
        patterns, moves = self.patterns.copy(), self.moves - self.moves[:, :, tick : tick + 1]
        variances[:, :tick] = sums[:, :tick] = patterns[:, :, :tick] = moves[:, :, :tick] = 0.0
        return self._replace(variances=variances, sums=sums, patterns=patterns, moves=moves)


def constant_errors(measured: Track, noise: Noise) -> Array:
    """Return the `patterns` of a robot: the scale errors of v and omega, and the bias of omega."""
    k, priors = len(measured.v), noise.priors
    at_rest = noise.standstill_bound
    moving = (np.abs(measured.v) > at_rest[0]) | (np.abs(measured.omega) > at_rest[1])
    patterns = np.zeros((3 * priors.of_odometry, 2, k))
    if priors.of_odometry:
        np.multiply(measured.v, priors.wheel_scale, out=patterns[0, 0])
        np.multiply(measured.omega, priors.wheel_scale, out=patterns[1, 1])
        np.multiply(moving, priors.gyro_bias, out=patterns[2, 1])
    return patterns


def is_noisy(noise: Noise) -> bool:
    """Return whether odometry may differ from the executed motion."""
    return noise.priors.of_odometry or noise.odometry != VelocityNoise()


def wander(
    path: Track, noise: VelocityNoise, measured: Track, patterns: Array | None = None
) -> OdometryNoiseModel:
    """Return the prefix sums for the corrected `path`; the size of the noise follows from `measured`.

    `patterns` are the effects of constant errors; None if there are none.
    """
    k, period = len(path.v), path.period
    variances = np.empty((2, k))
    variances[0] = np.square(noise.v * measured.v) + noise.v_floor**2
    variances[1] = np.square(noise.omega * measured.omega) + noise.omega_floor**2
    sx, sy = path.shift
    # omega changes the length of the chord, and rotates it by half the angle by which it rotates the robot
    slope = path.v * _shortening(0.5 * period * path.omega, period)
    across = 0.5 * period * path.v
    b = np.empty((2, k))
    b[0] = -period * path.y[1:] - (slope * sx - across * sy)
    b[1] = period * path.x[1:] - (slope * sy + across * sx)
    moves = np.zeros((0, 3, k + 1))
    if patterns is None:
        patterns = np.zeros((0, 2, k))
    elif len(patterns):
        effects = np.empty((len(patterns), 3, k))
        effects[:, 0] = patterns[:, 1]
        np.multiply(patterns[:, :1], path.shift, out=effects[:, 1:])
        effects[:, 1:] -= patterns[:, 1:] * b
        moves = _summed(effects)
    if noise == VelocityNoise():
        return OdometryNoiseModel(variances, b, path.shift, np.zeros((6, k + 1)), patterns, moves)
    q_v, q_omega = variances
    terms = np.empty((6, k))
    terms[0] = q_omega
    np.multiply(q_omega, b, out=terms[1:3])
    np.multiply(terms[1], b, out=terms[3:5])
    np.multiply(terms[2], b[1], out=terms[5])
    along = q_v * path.shift
    terms[3] += along[0] * sx
    terms[4] += along[0] * sy
    terms[5] += along[1] * sy
    return OdometryNoiseModel(variances, b, path.shift, _summed(terms), patterns, moves)


def _shortening(half: Array, period: float) -> Array:
    """Return the relative change of a chord with omega, d(ln A) / d omega, in s; `half` is omega T_s / 2."""
    safe = np.where(np.abs(half) < SLIGHT, 1.0, half)
    by_half = np.where(np.abs(half) < SLIGHT, -half / 3.0, 1.0 / np.tan(safe) - 1.0 / safe)
    shortening: Array = 0.5 * period * by_half
    return shortening


SLIGHT = 1e-4
"""The half turn in rad below which the series of the derivative is used."""


class Projection(NamedTuple):
    """Linear functionals of a robot's trajectory, one for each of N rows: a tick, a direction and a lever."""

    tick: Places
    u: Array
    """The direction in the frame of the odometry, or 0 if the row is of another robot; shape (2, N)."""
    lever: Array
    """The lever on noise in omega (m s); T_s if the row is a heading."""

    @staticmethod
    def positions(path: Track, tick: Places, u: Array) -> Projection:
        """Return the rows for the robot's position at `tick` along `u`.

        Rows with u = 0 do not involve this robot, and their tick may be beyond its path.
        """
        tick = np.minimum(tick, len(path.v))
        return Projection(tick, u, path.period * (u[1] * path.x[tick] - u[0] * path.y[tick]))

    def then(self, more: Projection) -> Projection:
        """Return these rows followed by `more` of the same robot."""
        return Projection(
            np.concatenate((self.tick, more.tick)),
            np.concatenate((self.u, more.u), axis=1),
            np.concatenate((self.lever, more.lever)),
        )


def constant_effects(model: OdometryNoiseModel, rows: Projection) -> Array:
    """Return the effect (m) of one sigma of each constant error on N rows; shape (N, m)."""
    turned, x, y = np.moveaxis(model.moves[:, :, rows.tick], 1, 0)
    effects: Array = (rows.lever * turned + rows.u[0] * x + rows.u[1] * y).T
    return effects


def spread(model: OdometryNoiseModel, rows: Projection) -> Array:
    """Return the covariance (m^2) of N rows that is caused by white odometry noise; shape (N, N)."""
    at = np.minimum(rows.tick[:, None], rows.tick)
    c0, bx, by, xx, xy, yy = np.take(model.sums, at, axis=1, mode="clip")
    (ux, uy), lever = rows.u, rows.lever
    column, left, above = lever[:, None], ux[:, None], uy[:, None]
    cross = column * (bx * ux + by * uy)
    covariance: Array = column * lever * c0 - cross - cross.T
    covariance += left * (xx * ux + xy * uy) + above * (xy * ux + yy * uy)
    return covariance


class Errors(NamedTuple):
    """The odometry errors that a fit estimates."""

    v: Array
    """The white errors (m/s) of v at each tick; shape (k,)."""
    omega: Array
    """The white errors (rad/s) of omega at each tick; shape (k,)."""
    constant: Array
    """The constant errors in their sigmas; shape (m,)."""

    def corrected(self, measured: Track, patterns: Array) -> Track:
        """Return the path with these errors added to the `measured` velocities."""
        v, omega = measured.v + self.v, measured.omega + self.omega
        if len(patterns):
            constant_v, constant_omega = np.tensordot(self.constant, patterns, 1)
            v, omega = v + constant_v, omega + constant_omega
        return track(v, omega, measured.period)

    def over(self, ticks: int) -> Errors:
        """Return these errors for so many ticks: white ones are 0 in those that have come since."""
        v, omega = np.zeros(ticks), np.zeros(ticks)
        known = min(ticks, len(self.v))
        v[:known], omega[:known] = self.v[:known], self.omega[:known]
        return Errors(v, omega, self.constant)

    def towards(self, other: Errors, fraction: float) -> Errors:
        """Return the errors that lie this fraction of the way from these to `other`."""
        return Errors(
            self.v + fraction * (other.v - self.v),
            self.omega + fraction * (other.omega - self.omega),
            self.constant + fraction * (other.constant - self.constant),
        )


def no_errors(patterns: Array) -> Errors:
    """Return the odometry errors of a fit before its first step; their constant part has `patterns`."""
    return Errors(np.zeros(patterns.shape[2]), np.zeros(patterns.shape[2]), np.zeros(len(patterns)))


def shifted(model: OdometryNoiseModel, rows: Projection, errors: Errors) -> Array:
    """Return by how much (m) `errors` change the value of each row, to first order; shape (N,)."""
    moves = np.empty((3, len(errors.v)))
    moves[0] = errors.omega
    moves[1:] = errors.v * model.shift - errors.omega * model.b
    turned, x, y = _summed(moves)[:, rows.tick]
    move: Array = rows.lever * turned + rows.u[0] * x + rows.u[1] * y
    return move + constant_effects(model, rows) @ errors.constant if len(model.patterns) else move


def attributed(model: OdometryNoiseModel, rows: Projection, residuals: Array) -> Errors:
    """Return the odometry errors that explain `residuals` best.

    The residuals are weighted by their inverse covariance; shape (N,).
    """
    k = model.b.shape[1]
    after = np.zeros((3, k + 1))
    for sums, weight in zip(after, (rows.lever, *rows.u), strict=True):
        np.add.at(sums, rows.tick, residuals * weight)
    lever, x, y = np.cumsum(after[:, :0:-1], axis=1)[:, ::-1]
    q_v, q_omega = model.variances
    return Errors(
        q_v * (x * model.shift[0] + y * model.shift[1]),
        q_omega * (lever - x * model.b[0] - y * model.b[1]),
        constant_effects(model, rows).T @ residuals,
    )
