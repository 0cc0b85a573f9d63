"""The recorded steps and ranges of robots, prepared for the estimate of any number of them.

The estimator counts in ticks. A tick is so short that no robot moves further in half of it than a small part
of a range's sigma, and each range counts at the nearest tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import Track, track
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, Ranges
from compose.errors import BadRecording
from compose.recording.estimating.recorded_noise import RecordedNoise
from compose.recording.estimating.sound_odometry import SoundOdometry, at_antenna, sound
from compose.recording.ranging.range_recording import (
    SAME_TIME_S,
    FixedAnchor,
    Numbers,
    Places,
    RangeRecording,
    locked,
)
from compose.recording.ranging.range_steps import NEARLY_ALL, RangeSteps, StepOptions, speeds, steps_of
from protocol.noise import Noise

EPOCH_S = 0.5
"""The time in s between two estimates."""

RANGE_SPACING_S = 1.0
"""The least time in s between two ranges of the same radios.

The errors of a radio's ranges within a second are correlated: more of them would count for more than they
tell. With less, claims are too confident.
"""

RANGE_SILENCE_S = 1.0
"""The time in s without a range and without the end of an increment after which there are no estimates.

So the measurements bound the number of estimates, not the time between them.
"""

MOST_TICKS_APART = 50
"""The largest number of ticks in an epoch."""

SHARE = 0.25
"""The largest part of a range's sigma that a robot moves in half a tick.

With it, rounding the times of ranges adds at most 1 % to their sigma.
"""

HORIZON = 1.25
"""The assumed sensing range, as a multiple of the longest range so far.

A missing range of a recording says nothing, so that this only scales the tolerances of the search. With 1,
the estimator would take it for information that no range is longer.
"""

SHORTEST_RANGE_M = 1e-3
"""The least length in m of the longest range. A recording whose ranges are all 0 says nothing."""


def horizon(ranges: Ranges) -> float:
    """Return the assumed sensing range (m), for which `ranges` are those so far."""
    return HORIZON * max(float(np.max(ranges.rho, initial=0.0)), SHORTEST_RANGE_M)


class OneRobot(NamedTuple):
    """One robot: its path in ticks, and how it was prepared."""

    id: str
    anchors: tuple[FixedAnchor, ...]
    """The anchors to which it has ranges, that with the most first; there may be none."""
    path: Track
    """The path of the antenna, in the frame of its first pose."""
    sound: SoundOdometry
    antenna: tuple[float, float, float]


class Measurements(msgspec.Struct, frozen=True, kw_only=True):
    """The measurements of the robots of an estimate."""

    sides: tuple[OneRobot, ...]
    """The robots, in the order of the user."""
    joint: JointMeasurements
    """The measurements as a fit takes them, with the robots in the order of their names."""
    t0: float
    """The time in s of tick 0."""
    ticks_per_epoch: int
    noise: Noise
    unused: dict[str, int]
    """The number of ranges that are not used, by the reason."""
    skipped_s: Numbers
    """The time in s of long gaps that is left out before each tick; shape (K + 1,)."""

    arrivals: Numbers
    """The times in s of all ranges and of the ends of all increments, in order."""

    def is_silent(self, epoch: int) -> bool:
        """Return whether nothing was measured in RANGE_SILENCE_S before the end of `epoch`: no estimate."""
        end = self.end(epoch)
        before = int(np.searchsorted(self.arrivals, end + SAME_TIME_S))
        return not before or float(self.arrivals[before - 1]) < end - RANGE_SILENCE_S

    def end(self, epoch: int) -> float:
        """Return the time in s of the end of `epoch`; the first is 1."""
        return self.t0 + epoch * EPOCH_S + float(self.skipped_s[epoch * self.ticks_per_epoch])

    def time_of(self, tick: Places) -> Numbers:
        """Return the times in s of ticks."""
        return np.asarray(self.t0 + self.period * tick + self.skipped_s[tick], np.float64)

    @property
    def period(self) -> float:
        """The length of a tick in s."""
        return EPOCH_S / self.ticks_per_epoch

    @property
    def origin(self) -> tuple[float, float]:
        """The position (m) to which estimates are relative."""
        return self.joint.origin

    @property
    def anchors(self) -> tuple[FixedAnchor, ...]:
        """The anchors of all robots."""
        return tuple({one.id: one for side in self.sides for one in side.anchors}.values())

    @property
    def epochs(self) -> int:
        """The number of epochs with odometry of all robots."""
        return len(self.sides[0].path.v) // self.ticks_per_epoch

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """The names of each pair of radios."""
        return self.joint.radios

    def until(self, epoch: int) -> tuple[JointMeasurements, float]:
        """Return what was measured up to the end of `epoch`, and the assumed sensing range (m)."""
        known = self.joint.until(epoch * self.ticks_per_epoch)
        reach = horizon(known.ranges.single)
        return known.thinned(reach), reach


class PreparedSteps(NamedTuple):
    """The steps and ranges of some robots of a recording."""

    part: RangeRecording
    """The recording of these robots alone, with the odometry of their antennas."""
    sound: tuple[SoundOdometry, ...]
    """The prepared odometry of each robot."""
    assumed: RecordedNoise
    ticks_per_epoch: int
    steps: RangeSteps

    arrivals: Numbers

    @property
    def ticks(self) -> Places:
        """The tick of each range: the nearest one."""
        return self.steps.step + (self.steps.fraction >= 0.5)

    def robot(self, place: int, anchors: tuple[FixedAnchor, ...]) -> OneRobot:
        """Return the robot at this `place`, which has ranges to `anchors`."""
        robot, steps, period = self.part.robots[place], self.steps, EPOCH_S / self.ticks_per_epoch
        path = path_of_steps(steps.increments[place], steps.covariance[place], period)
        return OneRobot(robot.id, anchors, path, self.sound[place], robot.antenna)

    def anchors_of(self, robot: int) -> tuple[FixedAnchor, ...]:
        """Return the anchors to which the robot at this place has ranges, that with the most first."""
        return self.part._replace(ranges=self.steps.ranges).anchors_of(robot)

    def in_plane(self, rows: Places) -> tuple[Numbers, Numbers]:
        """Return these ranges in the plane (m), and their sigmas (m)."""
        part, ranges, noise = self.part, self.steps.ranges.rows(rows), self.assumed.noise
        heights = np.array([*[one.antenna[2] for one in part.robots], *[one.height for one in part.anchors]])
        rho, ratio = levelled(ranges.range, heights[ranges.first] - heights[ranges.second])
        sigma = np.where(ranges.second < len(part.robots), noise.mutual_sigma, noise.anchor_sigma)
        if self.assumed.stated:
            sigma = np.where(np.isfinite(ranges.sigma), ranges.sigma, sigma)
        return rho, np.maximum(sigma, SIGMA_FLOOR) * ratio


def prepared_steps(
    recording: RangeRecording, robots: Sequence[str], assumed: RecordedNoise, ticks: int | None
) -> PreparedSteps:
    """Return the steps and ranges of `robots`, with the noise that is `assumed`.

    `ticks` is the number of them in an epoch; None: by the speed of the robots.
    """
    part = recording.part(robots, *recording.span)
    for robot in part.robots:
        if not len(robot.odometry.t0):
            raise BadRecording(f"{recording.source}: {robot.id} has no odometry")
        if robot.jumps:
            raise BadRecording(robot.jumps[0].why)
    arrivals = np.sort(np.concatenate([part.ranges.t, *[one.odometry.t1 for one in part.robots]]))
    prepared = tuple([sound(recording.robot(name).odometry, assumed.odometry) for name in robots])
    part = part._replace(
        robots=tuple(
            [
                robot._replace(odometry=at_antenna(one.odometry, *robot.antenna[:2]))
                for robot, one in zip(part.robots, prepared, strict=True)
            ]
        )
    )
    ticks = ticks or ticks_per_epoch(part, assumed.noise)
    options = StepOptions(period_s=EPOCH_S / ticks, range_spacing_s=RANGE_SPACING_S)
    return PreparedSteps(part, prepared, assumed, ticks, steps_of(part, robots, options), locked(arrivals))


def ticks_per_epoch(recording: RangeRecording, noise: Noise) -> int:
    """Return the number of ticks in an epoch, by the speed of the fastest robot (see SHARE)."""
    least = min(noise.anchor_sigma, noise.mutual_sigma)
    fastest = max(float(np.percentile(speeds(one.odometry)[0], NEARLY_ALL)) for one in recording.robots)
    return min(max(math.ceil(0.5 * EPOCH_S * fastest / (SHARE * max(least, 1e-3))), 1), MOST_TICKS_APART)


def levelled(measured: Numbers, higher: Numbers) -> tuple[Numbers, Numbers]:
    """Return the ranges (m) in the plane of antennas that differ in height, and the factors of the sigmas."""
    level = np.sqrt(np.maximum(np.square(measured) - np.square(higher), 0.0))
    steep = np.where(higher == 0.0, 1.0, measured / np.maximum(level, LEVEL * np.maximum(measured, 1e-3)))
    return level, steep


LEVEL = 0.1
"""The least ratio of a range in the plane to the range itself: steeper ranges tell hardly anything."""


def path_of_steps(increments: Numbers, covariance: Numbers, period: float) -> Track:
    """Return the path over steps of `period` s; its `extra` variances are those of the increments.

    The error sideways is not used: a path has none but that of its heading.
    """
    dx, dy, turn = increments.T
    half = 0.5 * turn
    course = np.arctan2(dy, dx)
    slip = np.remainder(course - half + math.pi, math.tau) - math.pi
    backwards = np.abs(slip) > 0.5 * math.pi
    slip = np.where(backwards, np.remainder(slip, math.tau) - math.pi, slip)
    unit = period * np.sinc(half / math.pi)
    moved = np.hypot(dx, dy)
    slip = np.where(moved > 0.0, slip, 0.0)
    v = np.where(backwards, -moved, moved) / unit
    along = np.stack((np.cos(half + slip), np.sin(half + slip)), 1)
    extra = np.stack(
        (
            np.einsum("ki,kij,kj->k", along, covariance[:, :2, :2], along) / np.square(unit),
            covariance[:, 2, 2] / period**2,
        )
    )
    return track(v, turn / period, period, slip)._replace(extra=extra)
