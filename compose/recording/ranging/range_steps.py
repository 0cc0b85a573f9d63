"""Asynchronous stamps to steps: odometry of robots at common times, with ranges in between.

Within an increment, a robot is assumed to turn and move at constant speeds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from compose.errors import BadRecording
from compose.recording.ranging.range_recording import (
    LONG_GAP_S,
    SAME_TIME_S,
    Numbers,
    Places,
    RangeRecording,
    RangeSeries,
    RobotOdometry,
    locked,
)

Flags = NDArray[np.bool_]
WITHOUT_ODOMETRY = "without odometry of all robots"
"""The reason for which ranges are left out that are of other times than the odometry."""


class RangeSteps(NamedTuple):
    """Odometry of the R robots of a recording over K steps, and M ranges."""

    t: Numbers
    """The times in s of the ends of the steps, the first of their start; shape (K + 1,)."""
    increments: Numbers
    """dx (m), dy (m) and dheading (rad) of each step, in the frame of its start; shape (R, K, 3)."""
    covariance: Numbers
    """The stated covariance of each step's increment; NaN where none is stated; shape (R, K, 3, 3)."""
    ranges: RangeSeries
    """The ranges that are kept; `first` and `second` are indices into the radios of the recording."""
    step: Places
    """The step in which each range lies; shape (M,)."""
    fraction: Numbers
    """The time of each range within its step, as a fraction of the step, from 0 to 1; shape (M,)."""
    unused: dict[str, int]
    """The number of ranges that are left out, by the reason."""
    skipped_s: Numbers
    """The time in s of long gaps that is left out before the end of each step; shape (K + 1,)."""


def steps_of(recording: RangeRecording, period_s: float = 1.0, spacing_s: float = 1.0) -> RangeSteps:
    """Return the steps of all robots, over the time in which all of them have odometry.

    A step lasts `period_s`. The ranges of two radios are at least `spacing_s` apart; 0 keeps all. The errors
    of a radio's ranges within a second are correlated (0.2 to 0.7 was measured on UWB), so that more ranges
    would count for more than they tell. Raises BadRecording if there is no such time.
    """
    paths, ranges = [one.odometry for one in recording.robots], recording.ranges
    t, skipped_s = _common_times(recording, period_s)
    inside = (ranges.t >= t[0]) & (ranges.t <= t[-1])
    covered = ranges.rows(inside)
    in_gap = (np.diff(skipped_s) > 0.0)[_step_at(covered.t, t)]
    known = covered.rows(~in_gap)
    kept = known.rows(spaced(known, spacing_s))
    step = _step_at(kept.t, t)
    poses = [dead_reckoned(path, t) for path in paths]
    return RangeSteps(
        locked(t),
        locked(np.stack([relative(at[:-1], at[1:]) for at in poses])),
        locked(np.stack([step_covariance(path, t) for path in paths])),
        kept,
        locked(step),
        locked((kept.t - t[step]) / (t[step + 1] - t[step])),
        {
            "within a second after another": len(known.t) - len(kept.t),
            WITHOUT_ODOMETRY: int(np.count_nonzero(~inside)),
            "in a gap of the odometry": int(np.count_nonzero(in_gap)),
        },
        locked(skipped_s),
    )


class NoSteps(BadRecording):
    """The odometry of the robots has no step in common."""


def _step_at(times: Numbers, t: Numbers) -> Places:
    """Return the step of each time, where `t` are the ends of the steps."""
    return np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)


def _common_times(recording: RangeRecording, period_s: float) -> tuple[Numbers, Numbers]:
    """Return the ends of steps of `period_s`, and the time in s that is left out before each; (K + 1,) each.

    Of a gap of more than LONG_GAP_S, whole seconds are left out, so that one step bridges them. What is left
    at the end is less than a step and left out.
    """
    for robot in recording.robots:
        if not len(robot.odometry.t0):
            raise BadRecording(f"{recording.source}: {robot.id} has no odometry")
    paths = [one.odometry for one in recording.robots]
    first, last = max(path.t0[0] for path in paths), min(path.t1[-1] for path in paths)
    steps = math.floor((last - first) / period_s + SAME_TIME_S)
    if steps < 1:
        between = f"{first:.15g} s to {last:.15g} s" if last > first else "none"
        names = " and ".join([one.id for one in recording.robots])
        what = f"less than a step of {period_s:g} s in which there is odometry of {names}"
        raise NoSteps(f"{recording.source}: there is {what} ({between})")
    silent = np.concatenate([np.concatenate((path.gaps, np.stack((path.t0, path.t1), 1))) for path in paths])
    whole_second, begun, numbers = max(round(1.0 / period_s), 1), 0, []
    for begin, end in sorted(silent[silent[:, 1] - silent[:, 0] > LONG_GAP_S].tolist()):
        inside = max(math.floor((begin - first) / period_s) + 1, begun + 1)
        past = min(math.ceil((end - first) / period_s), steps + 1)
        left_out = (past - inside) // whole_second * whole_second
        if left_out > 0:
            numbers.append(np.arange(begun, inside))
            begun = inside + left_out
    number = np.concatenate((*numbers, np.arange(begun, steps + 1)))
    if len(number) < 2:
        raise NoSteps(f"{recording.source}: there is no odometry but in a gap of more than {LONG_GAP_S:g} s")
    times: Numbers = first + period_s * number
    times[-1] = min(times[-1], last)
    left: Numbers = np.multiply(period_s, number - np.arange(len(number)), dtype=np.float64)
    return times, left


def spaced(ranges: RangeSeries, spacing_s: float) -> Places:
    """Return the rows of `ranges` without those less than `spacing_s` after the one kept before.

    Each pair of radios counts for itself.
    """
    last: dict[frozenset[int], float] = {}
    kept = []
    for row, (t, first, second) in enumerate(zip(ranges.t, ranges.first, ranges.second, strict=True)):
        pair = frozenset((int(first), int(second)))
        if t - last.get(pair, -math.inf) >= spacing_s - SAME_TIME_S:
            last[pair] = t
            kept.append(row)
    return np.array(kept, np.intp)


# --- dead reckoning -----------------------------------------------------------------------------------------


def dead_reckoned(odometry: RobotOdometry, t: Numbers) -> Numbers:
    """Return the poses at the times `t` (s), in the frame of the first pose; shapes (N,) and (N, 3).

    In a gap and outside of the odometry the robot is taken to stand.
    """
    turned = np.concatenate(([0.0], np.cumsum(odometry.increments[:, 2])))
    moved = np.exp(1j * turned[:-1]) * (odometry.increments[:, 0] + 1j * odometry.increments[:, 1])
    at = np.concatenate(([0.0], np.cumsum(moved)))
    if not len(odometry.t0):
        return np.zeros((len(t), 3))
    row = np.searchsorted(odometry.t0, t, side="right") - 1
    begun = np.maximum(row, 0)
    part = within(odometry.increments[begun], np.where(row < 0, 0.0, over_of(odometry, begun, t)))
    place = at[begun] + np.exp(1j * turned[begun]) * (part[:, 0] + 1j * part[:, 1])
    return np.stack((place.real, place.imag, turned[begun] + part[:, 2]), axis=1)


def over_of(odometry: RobotOdometry, row: Places, t: Numbers) -> Numbers:
    """Return the fraction of each increment `row` that is over at `t`, from 0 to 1; 1 if it takes no time."""
    lasts = odometry.t1[row] - odometry.t0[row]
    over = (t - odometry.t0[row]) / np.where(lasts > 0.0, lasts, 1.0)
    fraction: Numbers = np.clip(np.where(lasts > 0.0, over, 1.0), 0.0, 1.0)
    return fraction


def within(increments: Numbers, fraction: Numbers) -> Numbers:
    """Return the poses after a `fraction` of each increment, in the frame of its start; shape (N, 3).

    The motion is an arc of constant speeds: with the turn u, the position after the fraction f is the whole
    one times (e^(i f u) - 1) / (e^(i u) - 1). Beyond half a turn there are several arcs, and the position is
    interpolated on the straight line.
    """
    turn = increments[:, 2]
    half = np.where(np.abs(turn) <= math.pi, 0.5 * turn, 0.0)
    arc = np.sinc(fraction * half / math.pi) / np.sinc(half / math.pi) * np.exp(1j * (fraction - 1.0) * half)
    place = (increments[:, 0] + 1j * increments[:, 1]) * fraction * arc
    whole = fraction == 1.0  # without rounding
    found = np.stack((place.real, place.imag, fraction * turn), axis=1)
    return np.where(whole[:, None], increments, found)


def relative(base: Numbers, poses: Numbers) -> Numbers:
    """Return `poses` in the frames of the poses `base`; shapes (N, 3). Headings are not wrapped."""
    moved = (poses[:, 0] - base[:, 0] + 1j * (poses[:, 1] - base[:, 1])) * np.exp(-1j * base[:, 2])
    return np.stack((moved.real, moved.imag, poses[:, 2] - base[:, 2]), axis=1)


# --- properties of the odometry in steps --------------------------------------------------------------------


def _parts(odometry: RobotOdometry, t: Numbers) -> tuple[Places, Places, Numbers, Numbers]:
    """Return the increments cut at the ends of the steps: increment, step, start and end in s of each part.

    Increments and parts outside of the steps are left out.
    """
    last = len(t) - 2
    instant = odometry.t1 == odometry.t0
    begin = np.searchsorted(t, odometry.t0, side="right") - 1
    end = np.where(instant, begin, np.searchsorted(t, odometry.t1, side="left") - 1)
    counts = np.maximum(end - begin + 1, 1)
    row = np.repeat(np.arange(len(counts)), counts)
    step = np.repeat(begin - np.cumsum(counts) + counts, counts) + np.arange(len(row))
    inside = (step >= 0) & (step <= last)
    row, step = row[inside], step[inside]
    return row, step, np.maximum(odometry.t0[row], t[step]), np.minimum(odometry.t1[row], t[step + 1])


def step_covariance(odometry: RobotOdometry, t: Numbers) -> Numbers:
    """Return the covariance of the increments over the steps that end at `t`, to first order; (K, 3, 3).

    The errors of increments are independent, and white within an increment.
    """
    row, step, begin, end = _parts(odometry, t)
    starts, ends = dead_reckoned(odometry, begin), dead_reckoned(odometry, end)
    done = dead_reckoned(odometry, t)
    lasts = odometry.t1[row] - odometry.t0[row]
    share = np.where(lasts > 0.0, (end - begin) / np.where(lasts > 0.0, lasts, 1.0), 1.0)
    turned = starts[:, 2] - done[step, 2]
    after = relative(done[step], done[step + 1])[:, :2] - relative(done[step], ends)[:, :2]
    jacobian = np.zeros((len(row), 3, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = np.cos(turned)
    jacobian[:, 1, 0] = np.sin(turned)
    jacobian[:, 0, 1] = -jacobian[:, 1, 0]
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -after[:, 1], after[:, 0]
    jacobian[:, 2, 2] = 1.0
    covariance = np.zeros((len(t) - 1, 3, 3))
    parts = share[:, None, None] * odometry.covariance[row]
    np.add.at(covariance, step, jacobian @ parts @ jacobian.swapaxes(1, 2))
    return covariance


GROSS_FACTOR = 3.0
"""The factor by which an increment must be faster than nearly all others to be gross.

It is not tuned to a recording. With less, a robot that mostly creeps has its fastest honest motions flagged;
with more, edges are found only that no robot can have driven.
"""
NEARLY_ALL = 99.0
"""The percentile of speeds that stands for those of nearly all increments with motion."""


def speeds(odometry: RobotOdometry) -> tuple[Numbers, Numbers]:
    """Return the implied speed (m/s) and turn rate (rad/s) of each increment, without their signs; (N,).

    Increments shorter than half of the usual time count as so long: their stamps say more than their motion.
    """
    if not len(odometry.t0):
        return np.zeros(0), np.zeros(0)
    lasts = odometry.t1 - odometry.t0
    lasts = np.maximum(lasts, max(0.5 * float(np.median(lasts)), SAME_TIME_S))
    dx, dy, turn = odometry.increments.T
    return np.hypot(dx, dy) / lasts, np.abs(turn) / lasts


def speed_bound(odometry: RobotOdometry) -> tuple[float, float]:
    """Return GROSS_FACTOR times the speeds (m/s, rad/s) that nearly all increments with motion keep."""
    v, omega = [
        GROSS_FACTOR * float(np.percentile(moving, NEARLY_ALL)) if len(moving := one[one > 0.0]) else math.inf
        for one in speeds(odometry)
    ]
    return v, omega


def gross(odometry: RobotOdometry, bound: tuple[float, float]) -> Flags:
    """Return whether each increment is faster than `bound` (m/s, rad/s); shape (N,)."""
    speed, rate = speeds(odometry)
    flags: Flags = (speed > bound[0]) | (rate > bound[1])
    return flags
