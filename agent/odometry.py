"""The path that a robot's odometry tells of, and what the odometry's noise makes of it.

Noise at one tick moves every later position, so errors are correlated along the path; their covariance between
any two ticks follows from sums up to the earlier one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.noise import Drift

Array = NDArray[np.float64]
Places = NDArray[np.intp]


class Track(NamedTuple):
    """A robot's odometry over [0, k], in the frame of tick 0."""

    v: Array
    """m/s, over each tick; shape (k,)"""
    omega: Array
    period: float
    x: Array
    """m, at each tick; shape (k + 1,)"""
    y: Array
    heading: Array


def track(v: Array, omega: Array, period: float) -> Track:
    """Dead reckoning, eq. (1a), from the origin."""
    half = 0.5 * period * omega
    length = v * period * np.sinc(half / math.pi)
    heading = np.concatenate(([0.0], np.cumsum(period * omega)))
    course = heading[:-1] + half
    x = np.concatenate(([0.0], np.cumsum(length * np.cos(course))))
    y = np.concatenate(([0.0], np.cumsum(length * np.sin(course))))
    return Track(v, omega, period, x, y, heading)


class Wander(NamedTuple):
    """What noise in a track's v and omega does to it: sums along it, up to each tick.

    Noise e in omega at tick j moves the position at a later tick t, along u, by (lever - u . b_j) e, where
    lever = T_s u . perp(p_t); noise in v by u . s_j e.
    """

    q_v: Array
    """(m/s)^2: the variances at each tick"""
    q_omega: Array
    b: Array
    """(2, k)"""
    s: Array
    """(2, k)"""
    c0: Array
    """sum of q_omega; shape (k + 1,)"""
    c1: Array
    """of q_omega b; (2, k + 1)"""
    c2: Array
    """of q_omega b b' + q_v s s', its xx, xy, yy; (3, k + 1)"""


def wander(path: Track, drift: Drift, measured: Track) -> Wander:
    """Of `path`, whose odometry measured what `measured` says, with noise of `drift`."""
    q_v = np.square(drift.v * measured.v) + drift.v_floor**2
    q_omega = np.square(drift.omega * measured.omega) + drift.omega_floor**2
    period = path.period
    half = 0.5 * period * path.omega
    unit = period * np.sinc(half / math.pi)
    course = path.heading[:-1] + half
    c, s = np.cos(course), np.sin(course)
    length = path.v * unit
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(
            np.abs(half) < 1e-4, -half / 3.0, (np.cos(half) - np.sinc(half / math.pi)) / half
        ) * (0.5 * period * period * path.v)
    along, across = slope, 0.5 * period * length
    b = np.stack(
        (
            -period * path.y[1:] - (along * c - across * s),
            period * path.x[1:] - (along * s + across * c),
        )
    )
    shift = np.stack((unit * c, unit * s))
    products = np.stack(
        (
            q_omega * b[0] * b[0] + q_v * shift[0] * shift[0],
            q_omega * b[0] * b[1] + q_v * shift[0] * shift[1],
            q_omega * b[1] * b[1] + q_v * shift[1] * shift[1],
        )
    )
    return Wander(q_v, q_omega, b, shift, _summed(q_omega[None])[0], _summed(q_omega * b), _summed(products))


def _summed(values: Array) -> Array:
    """Of all before each tick; shape (n, k) -> (n, k + 1)."""
    sums = np.zeros((values.shape[0], values.shape[1] + 1))
    np.cumsum(values, axis=1, out=sums[:, 1:])
    return sums


class Seen(NamedTuple):
    """Along what each of N rows looks at a robot: its tick, a direction, and its lever on noise in omega."""

    tick: Places
    u: Array
    """(2, N), in the frame of the odometry; 0 where the row does not look at this robot"""
    lever: Array
    """m s; T_s where the row is a heading"""

    @staticmethod
    def positions(path: Track, tick: Places, u: Array) -> Seen:
        """Rows that look at its position."""
        return Seen(tick, u, path.period * (u[1] * path.x[tick] - u[0] * path.y[tick]))

    def then(self, more: Seen) -> Seen:
        """These rows and `more` of the same robot."""
        return Seen(
            np.concatenate((self.tick, more.tick)),
            np.concatenate((self.u, more.u), axis=1),
            np.concatenate((self.lever, more.lever)),
        )


def spread(drift: Wander, rows: Seen) -> Array:
    """m^2: the covariance, between N rows, that noise in the odometry makes; shape (N, N)."""
    at = np.minimum(rows.tick[:, None], rows.tick[None, :])
    (ux, uy), lever = rows.u, rows.lever
    c1x, c1y = drift.c1[0][at], drift.c1[1][at]
    cross = lever[:, None] * (c1x * ux + c1y * uy)
    xx, xy, yy = drift.c2[0][at], drift.c2[1][at], drift.c2[2][at]
    quadratic = ux[:, None] * (xx * ux + xy * uy) + uy[:, None] * (xy * ux + yy * uy)
    covariance: Array = lever[:, None] * lever * drift.c0[at] - cross - cross.T + quadratic
    return covariance


class Errors(NamedTuple):
    """What a fit holds the odometry's errors to be; shapes (k,)."""

    v: Array
    omega: Array

    @staticmethod
    def none(path: Track) -> Errors:
        """Before there is a fit."""
        return Errors(np.zeros_like(path.v), np.zeros_like(path.omega))

    def corrected(self, measured: Track) -> Track:
        """The path that was driven."""
        return track(measured.v + self.v, measured.omega + self.omega, measured.period)


def moved(drift: Wander, rows: Seen, errors: Errors) -> Array:
    """m: by how much `errors` move what the rows look at, to first order; shape (N,)."""
    turned = _summed(errors.omega[None])[0][rows.tick]
    shifted = _summed(errors.v * drift.s - errors.omega * drift.b)[:, rows.tick]
    move: Array = rows.lever * turned + rows.u[0] * shifted[0] + rows.u[1] * shifted[1]
    return move


def attributed(drift: Wander, rows: Seen, residuals: Array) -> Errors:
    """The odometry's errors that go with `residuals`, weighted by their inverse covariance; shape (N,)."""
    k = len(drift.q_v)
    after = [
        np.cumsum(np.bincount(rows.tick, residuals * weight, k + 1)[::-1])[::-1][1:]
        for weight in (rows.lever, rows.u[0], rows.u[1])
    ]
    lever, x, y = after
    return Errors(
        drift.q_v * (x * drift.s[0] + y * drift.s[1]),
        drift.q_omega * (lever - x * drift.b[0] - y * drift.b[1]),
    )
