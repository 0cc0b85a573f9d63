"""The true poses of recorded robots at any time, and the bounds within which they are interpolated."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from compose.recording.estimating.sound_odometry import sound
from compose.recording.ranging.range_recording import SAME_TIME_S, Numbers, RecordedRobot, TruePath, locked
from compose.recording.ranging.range_steps import dead_reckoned, relative
from protocol.motion import wrap

ARC_S = 1.0
"""The longest time in s between true poses within which a robot is taken to move on one arc."""

TRUTH_GAP_S = 10.0
"""The longest time in s between true poses within which they are interpolated, along the odometry.

Of true poses 10 s apart, those of TIERS, LIAS and MRCLAM in between are off by 0.01 to 0.03 m, less than
the sigma of most ranges, and by up to 0.06 rad (RMS); with 30 s, by up to 0.12 m and 0.1 rad.
"""

TRUTH_END_S = 0.02
"""The time in s for which a true pose holds that is farther from others."""


def with_bridged_truth(robot: RecordedRobot) -> RecordedRobot:
    """Return `robot` with further true poses, at most half of ARC_S apart, along its odometry.

    They are between true poses that are more than ARC_S and at most TRUTH_GAP_S apart, if there is odometry
    all the time. Its error until the next true pose is taken to grow with time.
    """
    truth, odometry = robot.truth, robot.odometry
    if truth is None or not len(odometry.t0):
        return robot
    lasts = np.diff(truth.t)
    bridged = (lasts > ARC_S) & (lasts <= TRUTH_GAP_S)
    bridged &= (truth.t[:-1] >= odometry.t0[0] - SAME_TIME_S) & (truth.t[1:] <= odometry.t1[-1] + SAME_TIME_S)
    for begin, end in odometry.gaps:
        bridged &= (end - begin <= ARC_S) | (truth.t[1:] <= begin) | (truth.t[:-1] >= end)
    if not np.any(bridged):
        return robot
    whole = sound(odometry).odometry
    times, poses = [truth.t], [truth.poses]
    for i in np.flatnonzero(bridged).tolist():
        count = 2 * math.ceil(lasts[i] / ARC_S)
        t = np.linspace(truth.t[i], truth.t[i + 1], count + 1)
        times.append(t[1:-1])
        poses.append(_bridge(truth.poses[i], truth.poses[i + 1], dead_reckoned(whole, t))[1:-1])
    t, all_poses = np.concatenate(times), np.concatenate(poses)
    order = np.argsort(t, kind="stable")
    return robot._replace(truth=TruePath(locked(t[order]), locked(all_poses[order])))


def _bridge(first: Numbers, last: Numbers, reckoned: Numbers) -> Numbers:
    """Return poses from `first` to `last` that move like those `reckoned`, at equal times; shape (N, 3)."""
    share = np.linspace(0.0, 1.0, len(reckoned))
    moved = relative(np.broadcast_to(reckoned[0], reckoned.shape), reckoned)
    turn = wrap(float(last[2] - first[2] - moved[-1, 2]))
    steps = np.diff(moved[:, 0] + 1j * moved[:, 1]) * np.exp(0.5j * turn * (share[1:] + share[:-1]))
    place = np.concatenate(([0.0], np.cumsum(steps))) * np.exp(1j * first[2])
    place += share * (complex(last[0] - first[0], last[1] - first[1]) - place[-1])
    heading = first[2] + moved[:, 2] + share * turn
    return np.stack((first[0] + place.real, first[1] + place.imag, heading), 1)


def true_pose(robot: RecordedRobot, t: float) -> Numbers | None:
    """Return the true pose at `t` s, shape (3,); None without truth around that time.

    Between two true poses at most ARC_S apart, the robot moves with constant speed on one arc. The
    first and the last arc go on for as long as they last. A true pose farther from others holds for
    TRUTH_END_S.
    """
    truth = robot.truth
    if truth is None or not len(truth.t):
        return None
    after = min(max(int(np.searchsorted(truth.t, t)), 1), len(truth.t) - 1)
    before = max(after - 1, 0)
    lasts = float(truth.t[after] - truth.t[before])
    if not 0.0 < lasts <= ARC_S:
        nearest = min((before, after), key=lambda one: abs(float(truth.t[one]) - t))
        return truth.poses[nearest].copy() if abs(float(truth.t[nearest]) - t) <= TRUTH_END_S else None
    share = (t - float(truth.t[before])) / lasts
    if not -1.0 <= share <= 2.0:
        return None
    x, y, heading = truth.poses[before].tolist()
    dx, dy, turned = (truth.poses[after] - truth.poses[before]).tolist()
    half = 0.5 * wrap(turned)
    way = math.hypot(dx, dy) * (share if half == 0.0 else math.sin(share * half) / math.sin(half))
    course = math.atan2(dy, dx) + (share - 1.0) * half
    return np.array((x + way * math.cos(course), y + way * math.sin(course), heading + share * 2.0 * half))


def in_frame_of(name: str, t: float, robots: Sequence[RecordedRobot]) -> Iterator[RecordedRobot]:
    """Yield `robots` with their true poses in the frame of that of the robot `name` at `t` s.

    If that is unknown, so are all true poses.
    """
    origin = next(true_pose(one, t) for one in robots if one.id == name)
    for one in robots:
        if (truth := one.truth) is not None:
            poses = truth.poses[: 0 if origin is None else None]
            poses = relative(np.full_like(poses, 0.0 if origin is None else origin), poses)
            truth = TruePath(truth.t[: len(poses)], locked(poses))
        yield one._replace(truth=truth)


def true_antenna(robot: RecordedRobot, t: Numbers) -> Numbers:
    """Return the true positions of the antenna at `t`; NaN where they are unknown; shape (N, 3)."""
    forward, left, height = robot.antenna
    places = np.full((len(t), 3), np.nan)
    for place, at in zip(places, t.tolist(), strict=True):
        if (pose := true_pose(robot, at)) is not None:
            offset = complex(forward, left) * complex(math.cos(pose[2]), math.sin(pose[2]))
            place[:] = pose[0] + offset.real, pose[1] + offset.imag, height
    return places
