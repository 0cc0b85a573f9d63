"""The motion of a robot between two poses of its odometry: how far it may be from the arc that joins them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from compose.recording.ranging.range_recording import SAME_TIME_S, Numbers, RobotOdometry
from compose.recording.ranging.range_steps import Flags, dead_reckoned, over_of, relative, within

FEWEST_WINDOWS = 3
"""The number of windows from which on they tell how far a robot is from its arcs."""

UNKNOWN, UNKNOWN_TURN = 0.25, 0.5
"""The sigmas with fewer windows: of a position, relative to the increment's way; of a heading in rad.

They are guesses, which hold at the begin of a recording only.
"""

TURNING = 0.02
"""The turn rate (rad/s) from which on a robot moves."""

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
    windows: dict[tuple[float, bool], Deviations]
    """The deviations by the length of the windows, and whether only those count in which the robot moved.

    The length in s is a power of 2, and at least that of two increments.
    """
    resting: float
    """The speed (m/s) below which a robot rests that hardly turns: then it says nothing of its motion."""

    def sigmas(self, t: Numbers) -> Numbers:
        """Return the sigmas along each axis (m) and of the heading (rad) at times in s; shape (N, 2).

        They are 0 at the ends of increments, and in between those of a walk whose end is known, by the
        windows that have ended before.
        """
        row = np.maximum(np.searchsorted(self.odometry.t0, t, side="right") - 1, 0)
        lasts, over = (self.odometry.t1 - self.odometry.t0)[row], over_of(self.odometry, row, t)
        way = np.hypot(*self.odometry.increments[row, :2].T)
        sigmas: Numbers = np.stack((UNKNOWN * way, np.full(len(t), UNKNOWN_TURN)), axis=1)
        lengths, moves = window_lengths(lasts), _moves(self.odometry.increments[row], lasts, self.resting)
        for (length, moved), deviations in self.windows.items():
            latest = np.searchsorted(deviations.ends, t, side="right") - 1
            rows = (lengths == length) & (moves == moved) & (latest >= FEWEST_WINDOWS - 1)
            sigmas[rows] = deviations.so_far[latest[rows]] * np.sqrt(lasts[rows] / length)[:, None]
        return sigmas * np.sqrt(4.0 * over * (1.0 - over))[:, None]


def window_lengths(lasts: Numbers) -> Numbers:
    """Return the length in s of the windows that tell of increments that last so long; shape (N,)."""
    return np.asarray(2.0 ** np.ceil(np.log2(2.0 * np.maximum(lasts, SAME_TIME_S))), np.float64)


def unseen_motion(odometry: RobotOdometry, resting: float) -> UnseenMotion:
    """Return the deviations of a robot's motion from arcs, by its odometry without gaps.

    `resting` is the speed (m/s) below which it rests.
    """
    lengths = np.unique(window_lengths(odometry.t1 - odometry.t0)).tolist()
    windows: dict[tuple[float, bool], Deviations] = {}
    for length in lengths:
        if length <= LONGEST_S:
            windows[length, False], windows[length, True] = _deviations(odometry, length, resting)
    return UnseenMotion(odometry, windows, resting)


def _moves(motion: Numbers, lasts: Numbers | float, resting: float) -> Flags:
    """Return whether a robot moves, by each `motion` and the time in s that it `lasts`; shape (N,)."""
    moves: Flags = np.hypot(*motion[:, :2].T) > resting * lasts
    return moves | (np.abs(motion[:, 2]) > TURNING * lasts)


def _deviations(odometry: RobotOdometry, length: float, resting: float) -> tuple[Deviations, Deviations]:
    """Return the deviations in all windows of so many seconds, and in those in which the robot moved.

    No increment of a window is longer than half of it. The robot moved in a window from half of `resting`
    and TURNING on: what counts as motion in an increment then does so in a window.
    """
    begin = odometry.t0[odometry.t0 + length <= odometry.t1[-1] + SAME_TIME_S]
    long = odometry.t1 - odometry.t0 > 0.5 * length + SAME_TIME_S
    before = np.concatenate(([0], np.cumsum(long)))
    first, past = (np.searchsorted(odometry.t0, begin + off) for off in (0.0, length - SAME_TIME_S))
    begin = begin[before[first] == before[past]]
    start, middle, end = [dead_reckoned(odometry, begin + part * length) for part in (0.0, 0.5, 1.0)]
    half, whole = relative(start, middle), relative(start, end)
    x, y, heading = np.square(half - within(whole, np.full(len(begin), 0.5))).T
    squares, ends = np.stack((0.5 * (x + y), heading), axis=1), begin + length
    moved = _moves(half, 0.25 * length, resting) | _moves(whole, 0.5 * length, resting)
    return _so_far(ends, squares), _so_far(ends[moved], squares[moved])


def _so_far(ends: Numbers, squares: Numbers) -> Deviations:
    """Return the deviations whose `squares` are of windows that end at `ends`."""
    return Deviations(ends, np.sqrt(np.cumsum(squares, axis=0) / np.arange(1, len(ends) + 1)[:, None]))
