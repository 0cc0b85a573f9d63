"""The path from a robot's odometry, and the covariance that odometry noise causes along it.

Noise at one tick moves every later position, so errors are correlated along the path. The covariance between
any two ticks follows from sums up to the earlier one.

All arrays may have further axes in front, of paths that are computed at once: "..." in their shapes.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.estimation.compiled import address, library
from agent.estimation.elementary import sin, tan
from agent.estimation.smoother import SLIGHT
from protocol.noise import Noise, VelocityNoise

Array = NDArray[np.float64]
Places = NDArray[np.intp]


class Track(NamedTuple):
    """A robot's odometry over [0, k], in the frame of tick 0."""

    v: Array
    """The forward velocity (m/s) over each tick; shape (..., k)."""
    omega: Array
    """The angular velocity (rad/s) over each tick; shape (..., k)."""
    period: float
    """The sampling period T_s (s)."""
    place: Array
    """The x and y (m) at each tick; shape (..., 2, k + 1)."""
    heading: Array
    """The heading (rad, not wrapped) at each tick; shape (..., k + 1)."""
    shift: Array
    """The displacement per unit of v (s) over each tick; shape (..., 2, k)."""
    slip: Array | None = None
    """The angle (rad) from the chord of eq. (1a) to the displacement of each tick; shape (..., k).

    None: 0.
    """
    extra: Array | None = None
    """The variances of v and omega at each tick beyond those of the noise model; shape (2, k). None: 0."""

    @property
    def x(self) -> Array:
        """The x (m) at each tick; shape (..., k + 1)."""
        return np.asarray(self.place[..., 0, :], np.float64)

    @property
    def y(self) -> Array:
        """The y (m) at each tick; shape (..., k + 1)."""
        return np.asarray(self.place[..., 1, :], np.float64)

    @property
    def content(self) -> tuple[object, ...]:
        """Return the measurements as values that can be compared."""
        parts = (self.v, self.omega, self.slip, self.extra)
        return (*[None if part is None else part.tobytes() for part in parts], self.period)

    def speeds(self, tick: Places) -> Array:
        """Return the speed (m/s) of one robot over the tick before each `tick`; 0 before tick 0."""
        found: Array = np.append(0.0, np.abs(self.v))[np.minimum(tick, len(self.v))]
        return found

    def until(self, tick: int) -> Track:
        """Return the path of one robot up to `tick`."""
        return Track(
            self.v[:tick],
            self.omega[:tick],
            self.period,
            self.place[:, : tick + 1],
            self.heading[: tick + 1],
            self.shift[:, :tick],
            None if self.slip is None else self.slip[:tick],
            None if self.extra is None else self.extra[:, :tick],
        )


def track(v: Array, omega: Array, period: float, slip: Array | None = None) -> Track:
    """Return the path from dead reckoning with eq. (1a), and with lateral `slip`, from the origin."""
    leading, ticks = v.shape[:-1], v.shape[-1]
    place, heading = np.empty((*leading, 2, ticks + 1)), np.empty((*leading, ticks + 1))
    shift = np.empty((*leading, 2, ticks))
    measured = [one if one is None else np.ascontiguousarray(one, np.float64) for one in (v, omega, slip)]
    given = [one if one is None else address(one) for one in (*measured, place, heading, shift)]
    library().tracked(math.prod(leading), ticks, period, *given)
    return Track(v, omega, period, place, heading, shift, slip)


def ratio_of_chord(half: Array) -> Array:
    """Return the length of a chord, as a fraction of its arc, by half of the angle (rad) that it turns by."""
    half = np.where(half == 0.0, NO_TURN, half)
    ratio: Array = sin(half) / half
    return ratio


def corrected(measured: Array, correction: Array, period: float, slip: Array | None = None) -> Track:
    """Return the path with the v and omega that were measured, and a correction; shape (..., 2, k) each."""
    velocities = measured + correction
    v, omega = velocities[..., 0, :], velocities[..., 1, :]
    return track(v, omega, period, None if slip is None else slip + np.zeros_like(v))


NO_TURN = 1e-20
"""An angle (rad) in place of 0, whose sine is itself."""


def _summed(values: Array) -> Array:
    """Return the sums of all values before each tick, along the last axis; (..., k) -> (..., k + 1)."""
    sums = np.zeros((*values.shape[:-1], values.shape[-1] + 1))
    np.add.accumulate(values, -1, out=sums[..., 1:])
    return sums


class OdometryNoiseModel(NamedTuple):
    """Prefix sums from which the covariance of a path follows, for noise in its v and omega.

    Noise e in omega at tick j moves the position at a later tick t, along u, by (lever - u . b_j) e, where
    lever = T_s u . perp(p_t). Noise e in v moves it by u . shift_j e.
    """

    b: Array
    """The vector b_j (m s) at each tick; shape (..., 2, k)."""
    shift: Array
    """The displacement per unit of v (s) at each tick; shape (..., 2, k)."""
    moves: Array
    """The prefix sums of the effects on heading, x and y of each constant error, of one sigma, and then of
    the correction of the measured path; shape (..., m + 1, 3, k + 1)."""
    variances: Array | None
    """The variances of v and omega, (m/s)^2 and (rad/s)^2, at each tick; shape (..., 2, k). None without
    white noise."""
    sums: Array | None
    """The prefix sums of six terms up to each tick; shape (..., 6, k + 1).

    The terms are q_omega; the x and y of -q_omega b; the xx, xy and yy of q_omega b b' + q_v shift shift'.
    """

    def since(self, tick: int) -> OdometryNoiseModel:
        """Return the model of a robot whose odometry was exact before `tick`."""
        moves = self.moves - self.moves[:, :, tick : tick + 1]
        moves[:, :, :tick] = 0.0
        if self.variances is None or self.sums is None:
            return self._replace(moves=moves)
        variances, sums = self.variances.copy(), self.sums - self.sums[:, tick : tick + 1]
        variances[:, :tick] = sums[:, :tick] = 0.0
        return self._replace(moves=moves, variances=variances, sums=sums)


def constant_errors(v: Array, omega: Array, noise: Noise) -> Array:
    """Return the `patterns` of a robot that measured v and omega: two scale errors, and the bias of omega."""
    priors = noise.priors
    patterns = np.zeros((*v.shape[:-1], 3 * priors.of_odometry, 2, v.shape[-1]))
    if priors.of_odometry:
        np.multiply(v, priors.wheel_scale, out=patterns[..., 0, 0, :])
        np.multiply(omega, priors.wheel_scale, out=patterns[..., 1, 1, :])
        np.multiply(_moving(v, omega, noise), priors.gyro_bias, out=patterns[..., 2, 1, :])
    return patterns


def _moving(v: Array, omega: Array, noise: Noise) -> NDArray[np.bool]:
    at_rest = noise.standstill_bound
    return np.asarray((np.abs(v) > at_rest[0]) | (np.abs(omega) > at_rest[1]), np.bool)


STRAY_TURN = 0.1
"""The standard deviation (rad) of the heading error of a tick whose odometry is a stray.

Increments of real wheels are off by 0.1 to 0.2 rad.
"""

STRAY_DISTANCE = 0.2
"""The standard deviation of the error of its distance, as a fraction of the measured distance."""


def stray_variances(v: Array, omega: Array, noise: Noise, period: float) -> Array:
    """Return the variances that a stray adds to those of v and omega, 0 at rest; (..., k) -> (..., 2, k)."""
    moving = _moving(v, omega, noise)
    return np.stack((moving * np.square(STRAY_DISTANCE * v), moving * (STRAY_TURN / period) ** 2), -2)


def variances(v: Array, omega: Array, noise: VelocityNoise) -> Array:
    """Return the variances of the measured v and omega; (..., k) each -> (..., 2, k)."""
    found = np.empty((*v.shape[:-1], 2, v.shape[-1]))
    np.add(np.square(noise.v * v), noise.v_floor**2, out=found[..., 0, :])
    np.add(np.square(noise.omega * omega), noise.omega_floor**2, out=found[..., 1, :])
    return found


def expected_variances(v: Array, omega: Array, noise: Noise, period: float) -> Array:
    """Return the variances of v and omega with those of strays, by their share; shapes as in `variances`."""
    white = variances(v, omega, noise.odometry)
    if noise.odometry_strays:
        white += noise.odometry_strays * stray_variances(v, omega, noise, period)
    return white


def is_noisy(noise: Noise) -> bool:
    """Return whether odometry may differ from the executed motion."""
    return noise.priors.of_odometry or noise.wanders


def wander(
    path: Track, correction: Array, patterns: Array, variances: Array | None = None
) -> OdometryNoiseModel:
    """Return the prefix sums along `path`, for constant errors and white noise of that size.

    `correction` is the difference of the path's v and omega from the measured ones; shape (..., 2, k).
    """
    period, shift = path.period, path.shift
    # omega changes the length of the chord, and rotates it by half the angle by which it rotates the robot
    slope = path.v * _shortening((0.5 * period) * path.omega, period)
    across = (0.5 * period * SIGNS) * path.v[..., None, :]
    b = across * shift[..., ::-1, :] - slope[..., None, :] * shift
    b -= (period * SIGNS) * path.place[..., ::-1, 1:]
    velocities = np.empty((*correction.shape[:-2], patterns.shape[-3] + 1, *correction.shape[-2:]))
    velocities[..., :-1, :, :], velocities[..., -1, :, :] = patterns, correction
    turned, moves = velocities[..., 1:, :], np.zeros((*velocities.shape[:-2], 3, shift.shape[-1] + 1))
    rates = moves[..., 1:]
    rates[..., :1, :] = turned
    np.multiply(velocities[..., :1, :], shift[..., None, :, :], out=rates[..., 1:, :])
    rates[..., 1:, :] -= turned * b[..., None, :, :]
    np.add.accumulate(rates, -1, out=rates)
    if variances is None:
        return OdometryNoiseModel(b, shift, moves, None, None)
    q_v, q_omega = variances[..., :1, :], variances[..., 1:, :]
    terms = np.empty((*shift.shape[:-2], 6, shift.shape[-1]))
    terms[..., :1, :] = q_omega
    np.multiply(-q_omega, b, out=terms[..., 1:3, :])
    along = q_v * shift
    np.subtract(along * shift[..., :1, :], terms[..., 1:3, :] * b[..., :1, :], out=terms[..., 3:5, :])
    last = along[..., 1, :] * shift[..., 1, :]
    np.subtract(last, terms[..., 2, :] * b[..., 1, :], out=terms[..., 5, :])
    return OdometryNoiseModel(b, shift, moves, variances, _summed(terms))


SIGNS = np.array(((1.0,), (-1.0,)))
"""The signs of two components that are exchanged, or of the two robots."""


def _shortening(half: Array, period: float) -> Array:
    """Return the relative change of a chord with omega, d(ln A) / d omega, in s; `half` is omega T_s / 2."""
    slight = np.abs(half) < SLIGHT
    safe = np.where(slight, 1.0, half)
    by_half = np.where(slight, half / -3.0, 1.0 / tan(safe) - 1.0 / safe)
    shortening: Array = (0.5 * period) * by_half
    return shortening


class Ticks(msgspec.Struct, frozen=True, eq=False, dict=True):
    """The ticks of N rows along a path."""

    tick: Places
    k: int
    """The number of ticks of the path."""

    @staticmethod
    def of(tick: Places, k: int) -> Ticks:
        """Return the ticks of rows along a path of `k` ticks. Those beyond it are taken as its last one."""
        return Ticks(np.minimum(tick, k), k)

    @cached_property
    def _order(self) -> tuple[Places, Places]:
        """The rows, the latest first, shape (N,), and the number of them after each tick, shape (k,)."""
        order = np.argsort(-self.tick, kind="stable")
        return order, np.searchsorted(-self.tick[order], -np.arange(self.k))

    def sum_after(self, values: Array) -> Array:
        """Return the sums over the rows after each tick; (..., N) -> (..., k)."""
        latest_first, later = self._order
        return np.asarray(_summed(values[..., latest_first])[..., later], np.float64)


class Projection(NamedTuple):
    """Linear functionals of a robot's trajectory, one for each of N rows: a tick, a direction and a lever."""

    ticks: Ticks
    weights: Array
    """The lever on noise in omega (m s), T_s if the row is a heading, and the direction in the frame of the
    odometry, or 0 if the row is of another robot; shape (..., 3, N)."""

    @staticmethod
    def positions(path: Track, ticks: Ticks, u: Array) -> Projection:
        """Return the rows for the robot's position at `ticks` along `u`, shape (..., 2, N)."""
        weights = np.empty((*u.shape[:-2], 3, u.shape[-1]))
        place = path.place[..., ticks.tick]
        lever = u[..., 1, :] * place[..., 0, :] - u[..., 0, :] * place[..., 1, :]
        np.multiply(path.period, lever, out=weights[..., 0, :])
        weights[..., 1:, :] = u
        return Projection(ticks, weights)

    @staticmethod
    def pose(path: Track, tick: int, turn: float = 0.0) -> Projection:
        """Return the rows for the x, y and heading at `tick`, with x and y rotated by `turn` (rad)."""
        c, s = math.cos(turn), math.sin(turn)
        ticks = Ticks.of(np.full(3, tick, np.intp), len(path.v))
        rows = Projection.positions(path, ticks, np.array(((c, s, 0.0), (-s, c, 0.0))))
        rows.weights[0, 2] = path.period
        return rows


def constant_effects(model: OdometryNoiseModel, rows: Projection) -> Array:
    """Return the effect (m) of one sigma of each constant error, and that of the correction of the measured
    path, on N rows; shape (..., m + 1, N)."""
    moves = model.moves[..., rows.ticks.tick]
    return np.asarray(np.add.reduce(moves * rows.weights[..., None, :, :], -2), np.float64)


def spread(model: OdometryNoiseModel, rows: Projection) -> tuple[Array, Array]:
    """Return factors of the covariance (m^2) of N rows from white odometry noise; shape (..., 3, N) each.

    Element (i, j) of the covariance is the product of column i of the first and column j of the second, if
    row i is not earlier than row j.
    """
    if model.sums is None:
        return rows.weights, np.zeros(rows.weights.shape)
    sums = model.sums[..., rows.ticks.tick][..., MATRIX, :]
    return rows.weights, np.add.reduce(sums * rows.weights[..., None, :, :], -2)


MATRIX = np.array(((0, 1, 2), (1, 3, 4), (2, 4, 5)))
"""The places in `OdometryNoiseModel.sums` of the elements of the matrix of a tick."""


class Errors(NamedTuple):
    """The odometry errors of one robot that a fit estimates."""

    v: Array
    """The white errors (m/s) of v at each tick; shape (k,)."""
    omega: Array
    """The white errors (rad/s) of omega at each tick; shape (k,)."""
    constant: Array
    """The constant errors in their sigmas; shape (m,)."""


def rescaled(errors: Errors, told: Noise, other: Noise) -> Errors:
    """Return `errors`, whose constant part is in the sigmas of `told`, in those of `other`."""
    was, now = (
        np.array((one.wheel_scale, one.wheel_scale, one.gyro_bias)) for one in (told.priors, other.priors)
    )
    constant = np.zeros(3 * other.priors.of_odometry)
    if len(errors.constant) and len(constant):
        constant = errors.constant * was / np.where(now > 0.0, now, math.inf)
    return errors._replace(constant=constant)


def attributed(model: OdometryNoiseModel, rows: Projection, residuals: Array) -> Array:
    """Return the white errors of v and omega that explain `residuals` best; shape (..., 2, k).

    The residuals are weighted by their inverse covariance; shape (..., N).
    """
    if model.variances is None:
        return np.zeros(model.shift.shape)
    after = rows.ticks.sum_after(rows.weights * residuals[..., None, :])
    lever, u = after[..., 0, :], after[..., 1:, :]
    white = np.empty(model.shift.shape)
    np.add.reduce(u * model.shift, -2, out=white[..., 0, :])
    np.subtract(lever, np.add.reduce(u * model.b, -2), out=white[..., 1, :])
    white *= model.variances
    return white
