"""The path from a robot's odometry, and the covariance that odometry noise causes along it.

An error in a tick moves all later poses together, like a rigid body.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.compiled import address, library
from agent.estimation.elementary import product, sin, tan
from agent.estimation.smoother import SLIGHT
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
    place: Array
    """The x and y (m) at each tick; shape (2, k + 1)."""
    heading: Array
    """The heading (rad, not wrapped) at each tick; shape (k + 1,)."""
    shift: Array
    """The displacement per unit of v (s) over each tick; shape (2, k)."""
    slip: Array | None = None
    """The angle (rad) from the chord of eq. (1a) to the displacement of each tick; shape (k,).

    None: 0.
    """
    extra: Array | None = None
    """The variances of v and omega at each tick beyond those of the noise model; shape (2, k). None: 0."""

    @property
    def x(self) -> Array:
        """The x (m) at each tick; shape (k + 1,)."""
        return np.asarray(self.place[0], np.float64)

    @property
    def y(self) -> Array:
        """The y (m) at each tick; shape (k + 1,)."""
        return np.asarray(self.place[1], np.float64)

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


NO_TURN = 1e-20
"""An angle (rad) in place of 0, whose sine is itself."""


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


def rigid_effects(path: Track) -> Array:
    """Return by how much v and omega of each tick move all later poses, like one rigid body; (3, 2, k).

    They are the x and y (m) of its point at the origin, and the angle (rad), per m/s and rad/s.
    """
    # omega changes the length of the chord, and rotates it by half the angle by which it rotates the robot
    longer = path.v * _shortening((0.5 * path.period) * path.omega, path.period)
    middle = 0.5 * (path.place[:, :-1] + path.place[:, 1:])
    found = np.zeros((3, 2, len(path.v)))
    found[:2, 0], found[2, 1] = path.shift, path.period
    found[0, 1] = longer * path.shift[0] + path.period * middle[1]
    found[1, 1] = longer * path.shift[1] - path.period * middle[0]
    return found


def pose_effects(path: Track, since: int, tick: int) -> Array:
    """Return by how much v and omega of each tick from `since` on move the pose at `tick`; (3, 2, k)."""
    found = rigid_effects(path)
    found[..., :since] = found[..., tick:] = 0.0
    found[0] -= path.y[tick] * found[2]
    found[1] += path.x[tick] * found[2]
    return found


def constant_effects(effects: Array, patterns: Array) -> Array:
    """Return the effects of one sigma of each constant error, (m, 3), by those of v and omega in a tick."""
    count = effects[0].size
    return product(patterns.reshape(len(patterns), count), effects.reshape(3, count).T)


def effect_covariance(effects: Array, white: Array, patterns: Array) -> Array:
    """Return the covariance of what has these `effects`, (3, 3).

    The errors of v and omega are white, with variances (2, k), and constant ones with `patterns`, (m, 2, k).
    """
    by_tick, constant = effects.reshape(3, white.size), constant_effects(effects, patterns)
    return product(by_tick * white.ravel(), by_tick.T) + product(constant.T, constant)


def position_variances(path: Track, white: Array, patterns: Array) -> Array:
    """Return the sum of the variances (m^2) of x and y at each tick, (k + 1,), by errors since tick 0.

    The errors are as in `effect_covariance`.
    """
    found: Array = np.empty(len(path.x))
    of_path = (path.v, path.omega, path.place, path.shift, np.ascontiguousarray(white))
    library().position_variances(
        *(len(path.v), path.period, *map(address, of_path), len(patterns), *map(address, (patterns, found)))
    )
    return found


def _shortening(half: Array, period: float) -> Array:
    """Return the relative change of a chord with omega, d(ln A) / d omega, in s; `half` is omega T_s / 2."""
    slight = np.abs(half) < SLIGHT
    safe = np.where(slight, 1.0, half)
    by_half = np.where(slight, half / -3.0, 1.0 / tan(safe) - 1.0 / safe)
    shortening: Array = (0.5 * period) * by_half
    return shortening


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
