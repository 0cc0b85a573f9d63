"""Odometry without gross increments and without gaps: their motion is unknown, within what the robot can do.

A whole turn, by which a difference of wrapped headings is off, is removed first. A gross increment is
replaced by the speeds of the last sound one, and a gap is filled with them. The covariance of both says that
the robot may have moved like at any other time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from compose.recording.ranging.range_recording import SAME_TIME_S, Numbers, Places, RobotOdometry, locked
from compose.recording.ranging.range_steps import (
    GROSS_FACTOR,
    Flags,
    gross,
    speed_bound,
)
from protocol.noise import VelocityNoise

UNSTATED_NOISE = VelocityNoise(v=0.05, omega=0.05, v_floor=0.01, omega_floor=0.01)
"""The noise of odometry whose recording states none, over one second.

It is that of wheels without calibration and of a cheap gyro, and white: a scale or a bias has a prior of its
own. With less, real slip contradicts the ranges; with more, a claim takes more of them.
"""


class SoundOdometry(NamedTuple):
    """The odometry that an estimator uses, and what was replaced in it."""

    odometry: RobotOdometry
    """The odometry without gaps; each increment has a covariance."""
    gross: Places
    """The indices of the recorded increments that were replaced."""
    gaps: Numbers
    """The start and end in s of each gap that was filled; shape (G, 2)."""
    whole_turns: Places
    """The indices of the recorded increments whose turn was off by a whole turn, which was removed."""


def sound(odometry: RobotOdometry, told: VelocityNoise | None = None) -> SoundOdometry:
    """Return `odometry` with gross increments replaced and gaps filled.

    `told` is its noise over one second; None for the stated covariances.
    """
    odometry, whole_turns = _without_whole_turns(odometry)
    bound = speed_bound(odometry)
    flagged = gross(odometry, bound)
    lasts = odometry.t1 - odometry.t0
    increments, covariance = odometry.increments.copy(), _covariance(odometry, told)
    usual = _finite(bound.v) / GROSS_FACTOR, _finite(bound.omega) / GROSS_FACTOR
    speeds = _last_sound(increments, lasts, flagged)
    increments[flagged] = lasts[flagged, None] * speeds[flagged]
    covariance[flagged] = _unknown(lasts[flagged], usual)
    t0, t1, gaps = odometry.t0, odometry.t1, odometry.gaps
    if len(gaps):
        before = np.searchsorted(t1, gaps[:, 0] - SAME_TIME_S)
        long = gaps[:, 1] - gaps[:, 0]
        kept = np.minimum(long, GAP_MOTION_S)[:, None]
        increments = np.concatenate((increments, kept * speeds[before]))
        covariance = np.concatenate((covariance, _unknown(long, usual)))
        t0, t1 = np.concatenate((t0, gaps[:, 0])), np.concatenate((t1, gaps[:, 1]))
        order = np.lexsort((t1, t0))
        t0, t1, increments, covariance = t0[order], t1[order], increments[order], covariance[order]
    whole = RobotOdometry(locked(t0), locked(t1), locked(increments), locked(covariance))
    return SoundOdometry(whole, np.flatnonzero(flagged), gaps, whole_turns)


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


GAP_MOTION_S = 1.0
"""The time in s for which a robot is taken to move on in a gap; then it is taken to stand."""

LOST_S = 100.0
"""The longest time in s of unknown motion by which the covariance grows.

After it, nothing is known of a robot's heading, and hardly anything of its position. With larger variances,
fits lose all digits.
"""

FREE = 1.0
"""The speed (m/s) and turn rate (rad/s) that a robot is assumed to have if its odometry never moves."""


def _finite(bound: float) -> float:
    return bound if np.isfinite(bound) else GROSS_FACTOR * FREE


def _covariance(odometry: RobotOdometry, told: VelocityNoise | None) -> Numbers:
    """Return the covariance of each increment: `told`, else stated, else UNSTATED_NOISE; shape (N, 3, 3)."""
    covariance = odometry.covariance.copy()
    silent = ~np.all(np.isfinite(covariance), axis=(1, 2))
    noise = told or UNSTATED_NOISE
    if told is not None:
        silent[:] = True
    if np.any(silent):
        lasts = odometry.t1[silent] - odometry.t0[silent]
        dx, dy, turn = odometry.increments[silent].T
        rates = np.where(lasts > 0.0, 1.0 / np.maximum(lasts, SAME_TIME_S), 0.0)
        v = np.square(noise.v * np.hypot(dx, dy) * rates) + noise.v_floor**2
        omega = np.square(noise.omega * turn * rates) + noise.omega_floor**2
        covariance[silent] = 0.0
        covariance[silent, 0, 0] = covariance[silent, 1, 1] = v * lasts
        covariance[silent, 2, 2] = omega * lasts
    return covariance


def _last_sound(increments: Numbers, lasts: Numbers, flagged: Flags) -> Numbers:
    """Return for each increment the speeds of the last one that is not flagged; shape (N, 3)."""
    rates = increments / np.maximum(lasts, SAME_TIME_S)[:, None]
    rates[lasts <= SAME_TIME_S] = 0.0
    place = np.where(flagged, -1, np.arange(len(lasts)))
    last = np.maximum.accumulate(place)
    return np.where(last[:, None] >= 0, rates[np.maximum(last, 0)], 0.0)


def _unknown(lasts: Numbers, usual: tuple[float, float]) -> Numbers:
    """Return the covariance of motion of so many seconds at unknown speeds; shape (N, 3, 3)."""
    covariance = np.zeros((len(lasts), 3, 3))
    lasts = np.minimum(lasts, LOST_S)
    covariance[:, 0, 0] = covariance[:, 1, 1] = np.square(usual[0] * lasts)
    covariance[:, 2, 2] = np.square(usual[1] * lasts)
    return covariance


def at_antenna(odometry: RobotOdometry, forward: float, left: float) -> RobotOdometry:
    """Return the odometry of a point `forward` and `left` (m) of the robot's centre, such as its antenna.

    The error of the heading within an increment is not counted towards the position of the point: it is
    smaller than the offset times the sigma of the turn.
    """
    if not forward and not left:
        return odometry
    offset = forward + 1j * left
    dx, dy, turn = odometry.increments.T
    moved = dx + 1j * dy + (np.exp(1j * turn) - 1.0) * offset
    return odometry._replace(increments=locked(np.stack((moved.real, moved.imag, turn), 1)))
