"""The motion of a robot between two poses of its odometry: how far it may be from the arc that joins them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from compose.recording.ranging.range_recording import SAME_TIME_S, Numbers, RobotOdometry
from compose.recording.ranging.range_steps import dead_reckoned, over_of, relative, within

FEWEST_WINDOWS = 3
"""The number of windows from which on they tell how far a robot is from its arcs."""

UNKNOWN, UNKNOWN_TURN = 0.25, 0.5
"""The sigmas with fewer windows: of a position, relative to the increment's way; of a heading in rad."""

LONGEST_S = 64.0
"""The length in s of the longest windows: over longer increments, there are no estimates."""


class Deviations(NamedTuple):
    """The deviations of a robot's motion in the middle of windows of one length from arcs across them."""

    ends: Numbers
    """The times in s at which windows end, ascending; shape (W,)."""
    so_far: Numbers
    """The root mean square of the deviations up to each: along an axis (m), of the heading; shape (W, 2)."""


class UnseenMotion(NamedTuple):
    """The deviation of a robot from the arcs of constant speeds that its increments are taken for.

    It is measured on the odometry itself. Over a window of several increments, the pose in the middle by the
    increments is compared with that on the one arc that joins both ends of the window.
    """

    odometry: RobotOdometry
    windows: dict[float, Deviations]
    """The deviations by the length of the windows in s: a power of 2, at least that of two increments."""

    def sigmas(self, t: Numbers) -> Numbers:
        """Return the sigmas along each axis (m) and of the heading (rad) at times in s; shape (N, 2).

        They are 0 at the ends of increments, and in between those of a walk whose end is known, by the
        windows that have ended before.
        """
        row = np.maximum(np.searchsorted(self.odometry.t0, t, side="right") - 1, 0)
        lasts, over = (self.odometry.t1 - self.odometry.t0)[row], over_of(self.odometry, row, t)
        way = np.hypot(*self.odometry.increments[row, :2].T)
        found: Numbers = np.stack((UNKNOWN * way, np.full(len(t), UNKNOWN_TURN)), axis=1)
        lengths = window_lengths(lasts)
        for length, known in self.windows.items():
            place = np.searchsorted(known.ends, t, side="right") - 1
            told = (lengths == length) & (place >= FEWEST_WINDOWS - 1)
            found[told] = known.so_far[place[told]] * np.sqrt(lasts[told] / length)[:, None]
        return found * np.sqrt(4.0 * over * (1.0 - over))[:, None]


def window_lengths(lasts: Numbers) -> Numbers:
    """Return the length in s of the windows that tell of increments that last so long; shape (N,)."""
    return np.asarray(2.0 ** np.ceil(np.log2(2.0 * np.maximum(lasts, SAME_TIME_S))), np.float64)


def unseen_motion(odometry: RobotOdometry) -> UnseenMotion:
    """Return the deviations of a robot's motion from arcs, by its odometry without gaps."""
    lengths = np.unique(window_lengths(odometry.t1 - odometry.t0)).tolist()
    return UnseenMotion(odometry, {one: _deviations(odometry, one) for one in lengths if one <= LONGEST_S})


def _deviations(odometry: RobotOdometry, length: float) -> Deviations:
    """Return the deviations in windows of so many seconds, none of whose increments is longer than half."""
    first = np.flatnonzero(odometry.t0 + length <= odometry.t1[-1] + SAME_TIME_S)
    begin = odometry.t0[first]
    past = np.searchsorted(odometry.t0, begin + length - SAME_TIME_S)
    lasts = np.append(odometry.t1 - odometry.t0, 0.0)
    longest = np.maximum.reduceat(lasts, np.stack((first, past), axis=1).ravel())[::2]
    begin = begin[longest <= 0.5 * length + SAME_TIME_S]
    if not len(begin):
        return Deviations(np.zeros(0), np.zeros((0, 2)))
    poses = [dead_reckoned(odometry, begin + part * length) for part in (0.0, 0.5, 1.0)]
    arc = within(relative(poses[0], poses[2]), np.full(len(begin), 0.5))
    x, y, heading = np.square(relative(poses[0], poses[1]) - arc).T
    sums = np.cumsum(np.stack((0.5 * (x + y), heading), axis=1), axis=0)
    return Deviations(begin + length, np.sqrt(sums / np.arange(1, len(begin) + 1)[:, None]))
