"""Odometry without gross increments and without gaps, and ranges and odometry as if antennas were in a plane.

A whole turn, by which a difference of wrapped headings is off, is removed first. A gross increment is
replaced by the speeds of the last sound one, and a gap is filled with them. The covariance of both says that
the robot may have moved like at any other time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from compose.recording.ranging.range_recording import SAME_TIME_S, Numbers, Places, RobotOdometry, locked
from compose.recording.ranging.range_steps import GROSS_FACTOR, gross, speed_bound
from protocol.noise import VelocityNoise

UNSTATED_NOISE, FLOOR_S = VelocityNoise(v=0.05, omega=0.05, omega_floor=0.01), 5.0
"""The noise of odometry whose recording states none, over one second, and the time in s in which its floor of
v is the sigma of a range: 0.01 m/s with 0.05 m.

It is that of wheels without calibration and of a cheap gyro, and white: a scale or a bias has a prior of its
own. With less, real slip contradicts the ranges; with more, a claim takes more of them.
"""

GAP_MOTION_S = 1.0
"""The time in s for which a robot is taken to move on in a gap; then it is taken to stand."""

LOST_S = 100.0
"""The longest time in s of unknown motion by which the covariance grows.

After it, nothing is known of a robot's heading, and hardly anything of its position. With larger variances,
fits lose all digits.
"""

FREE, FREE_TURN = 20.0, 1.0
"""The speed (sigmas of a range in a second) and turn rate (rad/s) of a robot whose odometry never moves."""


class SoundOdometry(NamedTuple):
    """The odometry that an estimator uses, and what was replaced in it."""

    odometry: RobotOdometry
    """The odometry without gaps; each increment has a covariance."""
    gross: Places
    """The indices of the recorded increments that were replaced."""
    whole_turns: Places
    """The indices of the recorded increments whose turn was off by a whole turn, which was removed."""


def sound(odometry: RobotOdometry, told: VelocityNoise | None = None, sigma: float = 0.0) -> SoundOdometry:
    """Return `odometry` with gross increments replaced and gaps filled.

    `told` is its noise over one second; None for the stated covariances. `sigma` (m) is that of ranges.
    """
    odometry, whole_turns = _without_whole_turns(odometry)
    bound, gaps = speed_bound(odometry), odometry.gaps
    flagged = gross(odometry, bound)
    usual = np.where(np.isfinite(bound), np.divide(bound, GROSS_FACTOR), (FREE * sigma, FREE_TURN))
    t0, t1 = np.concatenate((odometry.t0, gaps[:, 0])), np.concatenate((odometry.t1, gaps[:, 1]))
    order, lasts = np.lexsort((t1, t0)), t1 - t0
    t0, t1, lasts = t0[order], t1[order], lasts[order]
    unknown = np.append(flagged, np.ones(len(gaps), bool))[order]
    increments = np.concatenate((odometry.increments, np.zeros((len(gaps), 3))))[order]
    rates = increments / np.maximum(lasts, SAME_TIME_S)[:, None]
    last = np.maximum.accumulate(np.where(unknown | (lasts <= SAME_TIME_S), -1, np.arange(len(lasts))))
    rates = np.where(last[:, None] >= 0, rates[np.maximum(last, 0)], 0.0)
    moving = np.where(order < len(flagged), lasts, np.minimum(lasts, GAP_MOTION_S))
    increments[unknown] = moving[unknown, None] * rates[unknown]
    covariance = np.concatenate((_covariance(odometry, told, sigma), np.zeros((len(gaps), 3, 3))))[order]
    lost = np.minimum(lasts[unknown], LOST_S)
    variances = np.square(lost[:, None] * (usual[0], usual[0], usual[1]))
    covariance[unknown] = variances[:, :, None] * np.eye(3)
    whole = RobotOdometry(locked(t0), locked(t1), locked(increments), locked(covariance))
    return SoundOdometry(whole, np.flatnonzero(flagged), whole_turns)


def _without_whole_turns(odometry: RobotOdometry) -> tuple[RobotOdometry, Places]:
    """Return `odometry` without whole turns, and the increments that had one.

    Of a turn beyond half a turn, whole turns are removed if what remains is nearer to the turn rate of the
    last increment (at the beginning, of the next one) that turns by less. A robot that turns so far within
    an increment keeps its turns.
    """
    turn = odometry.increments[:, 2]
    beyond = np.abs(turn) > math.pi
    if not np.any(beyond) or np.all(beyond):
        return odometry, np.empty(0, np.intp)
    lasts = np.maximum(odometry.t1 - odometry.t0, SAME_TIME_S)
    last = np.maximum.accumulate(np.where(beyond, -1, np.arange(len(turn))))
    expected = lasts * (turn / lasts)[np.where(last < 0, np.argmin(beyond), last)]
    remaining = turn - math.tau * np.round(turn / math.tau)
    removed = beyond & (np.abs(remaining - expected) < np.abs(turn - expected))
    increments = odometry.increments.copy()
    increments[removed, 2] = remaining[removed]
    return odometry._replace(increments=locked(increments)), np.flatnonzero(removed)


def _covariance(odometry: RobotOdometry, told: VelocityNoise | None, sigma: float) -> Numbers:
    """Return the covariance of each increment: `told`, else stated, else UNSTATED_NOISE; shape (N, 3, 3)."""
    noise, lasts = told or replace(UNSTATED_NOISE, v_floor=sigma / FLOOR_S), odometry.t1 - odometry.t0
    silent = ~np.all(np.isfinite(odometry.covariance), axis=(1, 2)) | (told is not None)
    dx, dy, turn = odometry.increments.T
    rates = np.where(lasts > 0.0, 1.0 / np.maximum(lasts, SAME_TIME_S), 0.0)
    v = lasts * (np.square(noise.v * np.hypot(dx, dy) * rates) + noise.v_floor**2)
    omega = lasts * (np.square(noise.omega * turn * rates) + noise.omega_floor**2)
    variances = np.stack((v, v, omega), 1)[:, :, None] * np.eye(3)
    return np.where(silent[:, None, None], variances, odometry.covariance)


# --- antennas -----------------------------------------------------------------------------------------------


def at_antenna(odometry: RobotOdometry, forward: float, left: float) -> RobotOdometry:
    """Return the odometry of a point `forward` and `left` (m) of the robot's centre, such as its antenna.

    The error of the heading within an increment is not counted towards the position of the point: it is
    smaller than the offset times the sigma of the turn.
    """
    if not forward and not left:
        return odometry
    dx, dy, turn = odometry.increments.T
    moved = dx + 1j * dy + (np.exp(1j * turn) - 1.0) * (forward + 1j * left)
    return odometry._replace(increments=locked(np.stack((moved.real, moved.imag, turn), 1)))


def levelled(measured: Numbers, higher: Numbers) -> tuple[Numbers, Numbers]:
    """Return the ranges (m) in the plane of antennas that differ in height, and the factors of the sigmas."""
    level = np.sqrt(np.maximum(np.square(measured) - np.square(higher), 0.0))
    length = np.where(measured > 0.0, measured, 1.0)
    return level, np.where(higher == 0.0, 1.0, length / np.maximum(level, LEVEL * length))


LEVEL = 0.1
"""The least ratio of a range in the plane to the range itself: steeper ranges tell hardly anything."""
