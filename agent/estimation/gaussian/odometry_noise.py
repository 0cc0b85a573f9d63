"""The path that a robot's odometry tells of, and what the odometry's noise makes of it.

Noise at one tick moves every later position, so errors are correlated along the path; their covariance
between any two ticks follows from sums up to the earlier one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.noise import VelocityNoise

Array = NDArray[np.float64]
Places = NDArray[np.intp]


class Track(NamedTuple):
    """A robot's odometry over [0, k], in the frame of tick 0."""

    v: Array
    """m/s, over each tick; (k,)"""
    omega: Array
    """rad/s"""
    period: float
    """s"""
    x: Array
    """m, at each tick; (k + 1,)"""
    y: Array
    heading: Array
    """rad, not wrapped"""
    shift: Array
    """s: what each m/s of v moves the robot by, over each tick; (2, k)"""


def track(v: Array, omega: Array, period: float) -> Track:
    """Dead reckoning, eq. (1a), from the origin."""
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
    """sin(x) / x"""
    safe = np.where(half == 0.0, 1.0, half)
    return np.where(half == 0.0, 1.0, np.sin(safe) / safe)


def _summed(values: Array) -> Array:
    """Of all before each tick, along the last axis; (..., k) -> (..., k + 1)."""
    sums = np.zeros((*values.shape[:-1], values.shape[-1] + 1))
    np.cumsum(values, axis=-1, out=sums[..., 1:])
    return sums


class OdometryNoiseModel(NamedTuple):
    """What noise in a track's v and omega does to it: sums along it, up to each tick.

    Noise e in omega at tick j moves the position at a later tick t, along u, by (lever - u . b_j) e, where
    lever = T_s u . perp(p_t); noise e in v moves it by u . shift_j e.
    """

    variances: Array
    """(m/s)^2 and (rad/s)^2, of v and omega at each tick; (2, k)"""
    b: Array
    """m s; (2, k)"""
    shift: Array
    """s; (2, k)"""
    sums: Array
    """of q_omega; q_omega b, its x and y; q_omega b b' + q_v shift shift', its xx, xy, yy; (6, k + 1)"""


def wander(path: Track, drift: VelocityNoise, measured: Track) -> OdometryNoiseModel:
    """Of `path`, whose odometry measured what `measured` says, with noise of `drift`."""
    k, period = len(path.v), path.period
    variances = np.empty((2, k))
    variances[0] = np.square(drift.v * measured.v) + drift.v_floor**2
    variances[1] = np.square(drift.omega * measured.omega) + drift.omega_floor**2
    sx, sy = path.shift
    # along the chord, omega changes its length; across it, its direction, by half of what it turns the robot
    slope = path.v * _shortening(0.5 * period * path.omega, period)
    across = 0.5 * period * path.v
    b = np.empty((2, k))
    b[0] = -period * path.y[1:] - (slope * sx - across * sy)
    b[1] = period * path.x[1:] - (slope * sy + across * sx)
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
    return OdometryNoiseModel(variances, b, path.shift, _summed(terms))


def _shortening(half: Array, period: float) -> Array:
    """s: by what part a chord changes with omega, d(ln A) / d omega; `half` is omega T_s / 2."""
    safe = np.where(np.abs(half) < SLIGHT, 1.0, half)
    by_half = np.where(np.abs(half) < SLIGHT, -half / 3.0, 1.0 / np.tan(safe) - 1.0 / safe)
    shortening: Array = 0.5 * period * by_half
    return shortening


SLIGHT = 1e-4
"""rad: less than this, a turn shortens a chord as its series says"""


class Projection(NamedTuple):
    """Along what each of N rows looks at a robot: its tick, a direction, and its lever on noise in omega."""

    tick: Places
    u: Array
    """(2, N), in the frame of the odometry; 0 where the row does not look at this robot"""
    lever: Array
    """m s; T_s where the row is a heading"""

    @staticmethod
    def positions(path: Track, tick: Places, u: Array) -> Projection:
        """Rows that look at its position; those that do not, as their u is 0, may be of later ticks."""
        tick = np.minimum(tick, len(path.v))
        return Projection(tick, u, path.period * (u[1] * path.x[tick] - u[0] * path.y[tick]))

    def then(self, more: Projection) -> Projection:
        """These rows and `more` of the same robot."""
        return Projection(
            np.concatenate((self.tick, more.tick)),
            np.concatenate((self.u, more.u), axis=1),
            np.concatenate((self.lever, more.lever)),
        )


def spread(drift: OdometryNoiseModel, rows: Projection) -> Array:
    """m^2: the covariance, between N rows, that noise in the odometry makes; (N, N)."""
    at = np.minimum(rows.tick[:, None], rows.tick)
    c0, bx, by, xx, xy, yy = drift.sums[:, at]
    (ux, uy), lever = rows.u, rows.lever
    column, left, above = lever[:, None], ux[:, None], uy[:, None]
    cross = column * (bx * ux + by * uy)
    covariance: Array = column * lever * c0 - cross - cross.T
    covariance += left * (xx * ux + xy * uy) + above * (xy * ux + yy * uy)
    return covariance


class Errors(NamedTuple):
    """What a fit holds the odometry's errors to be; shapes (k,)."""

    v: Array
    omega: Array

    def corrected(self, measured: Track) -> Track:
        """The path that was driven."""
        return track(measured.v + self.v, measured.omega + self.omega, measured.period)


def shifted(drift: OdometryNoiseModel, rows: Projection, errors: Errors) -> Array:
    """m: by how much `errors` move what the rows look at, to first order; shape (N,)."""
    moves = np.empty((3, len(errors.v)))
    moves[0] = errors.omega
    moves[1:] = errors.v * drift.shift - errors.omega * drift.b
    turned, x, y = _summed(moves)[:, rows.tick]
    move: Array = rows.lever * turned + rows.u[0] * x + rows.u[1] * y
    return move


def attributed(drift: OdometryNoiseModel, rows: Projection, residuals: Array) -> Errors:
    """The odometry's errors that go with `residuals`, weighted by their inverse covariance; shape (N,)."""
    k = drift.b.shape[1]
    after = np.zeros((3, k + 1))
    for sums, weight in zip(after, (rows.lever, *rows.u), strict=True):
        np.add.at(sums, rows.tick, residuals * weight)
    lever, x, y = np.cumsum(after[:, :0:-1], axis=1)[:, ::-1]
    q_v, q_omega = drift.variances
    return Errors(
        q_v * (x * drift.shift[0] + y * drift.shift[1]), q_omega * (lever - x * drift.b[0] - y * drift.b[1])
    )
