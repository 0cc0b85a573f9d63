"""The measurements of two recorded robots as the estimator takes them: paths in short steps, and ranges.

The estimator counts in ticks. A tick is so short that no robot moves further in half of it than a small part
of a range's sigma, and each range counts at the nearest tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.odometry_noise import Track, track
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, PairRanges, Ranges
from compose.errors import UserError
from compose.recording.estimating.recorded_noise import RecordedNoise
from compose.recording.estimating.sound_odometry import SoundOdometry, at_antenna, sound
from compose.recording.ranging.range_recording import (
    FixedAnchor,
    Numbers,
    Places,
    RangeRecording,
    locked,
)
from compose.recording.ranging.range_steps import NEARLY_ALL, StepOptions, speeds, steps_of
from protocol.noise import Noise

EPOCH_S = 1.0
"""The time in s between two estimates; also the least time between two ranges of the same radios.

The errors of a radio's ranges within a second are correlated: more of them would count for more than they
tell. With less, claims are too confident.
"""

MOST_TICKS = 50
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


class NoAnchors(UserError):
    """The robots have no ranges to two anchors at different places."""


class OneRobot(NamedTuple):
    """One robot: its path in ticks, and how it was prepared."""

    id: str
    anchor: FixedAnchor
    """The anchor whose ranges are used; the first of several."""
    path: Track
    """The path of the antenna, in the frame of its first pose."""
    sound: SoundOdometry
    antenna: tuple[float, float, float]


class PairMeasurements(NamedTuple):
    """All measurements of two robots."""

    a: OneRobot
    b: OneRobot
    t0: float
    """The time in s of tick 0."""
    ticks_per_epoch: int
    ranges: Ranges
    t: Numbers
    """The time in s of each range; shape (N,)."""
    noise: Noise
    unused: dict[str, int]
    """The number of ranges that are not used, by the reason."""

    @property
    def period(self) -> float:
        """The length of a tick in s."""
        return EPOCH_S / self.ticks_per_epoch

    @property
    def epochs(self) -> int:
        """The number of epochs with odometry of all robots."""
        return len(self.a.path.v) // self.ticks_per_epoch

    @property
    def sides(self) -> tuple[OneRobot, ...]:
        """Both robots."""
        return self.a, self.b

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """The names of each pair of radios, in the order of the ranges."""
        a, b = self.a, self.b
        return (a.id, a.anchor.id), (b.id, b.anchor.id), (a.id, b.id)

    @property
    def anchors(self) -> tuple[FixedAnchor, ...]:
        """The anchors whose ranges are used."""
        return self.a.anchor, self.b.anchor

    def anchors_of(self, robot: OneRobot) -> list[str]:
        """Return the names of the anchors whose ranges to `robot` are used."""
        return [robot.anchor.id]

    @property
    def apart(self) -> tuple[float, float]:
        """The vector (m) from the anchor of a to that of b."""
        return self.b.anchor.x - self.a.anchor.x, self.b.anchor.y - self.a.anchor.y

    def until(self, epoch: int) -> PairRanges:
        """Return what was measured up to the end of `epoch`; the first is 1."""
        ticks = epoch * self.ticks_per_epoch
        known = self.t <= self.t0 + epoch * EPOCH_S
        counts = tuple([int(np.count_nonzero(known[self.ranges.rows(kind)])) for kind in range(3)])
        first, second, mutual = counts
        some = Ranges(
            self.ranges.rho[known],
            self.ranges.tick[known],
            self.ranges.sigma[known],
            (first, second, mutual),
        )
        longest = float(np.max(some.rho)) if len(some.rho) else 1.0
        reach = HORIZON * longest
        nothing = np.empty(0, np.intp)
        return PairRanges(
            (self.a.path.until(ticks), self.b.path.until(ticks)),
            some.within(reach, self.noise.priors).thinned(self.noise),
            (nothing, nothing, nothing),
            self.apart,
            reach,
            self.noise,
        )


def pair_measurements(
    recording: RangeRecording,
    robots: Sequence[str],
    assumed: RecordedNoise,
    *,
    ticks: int | None = None,
    anchors: tuple[str, str] | None = None,
) -> PairMeasurements:
    """Return the measurements of two `robots`, with the noise that is `assumed`.

    `ticks` is the number of them in an epoch; None: by the speed of the robots. Each robot ranges to one of
    two `anchors`; None: to those with the most ranges. Raises UserError if there are none.
    """
    noise = assumed.noise
    prepared = [sound(recording.robot(name).odometry, assumed.odometry) for name in robots]
    whole = recording._replace(
        robots=tuple(
            [
                recording.robot(name)._replace(
                    odometry=at_antenna(one.odometry, *recording.robot(name).antenna[:2])
                )
                for name, one in zip(robots, prepared, strict=True)
            ]
        ),
    )
    part = _of_robots(recording, whole, robots)
    ticks = ticks or ticks_per_epoch(part, noise)
    steps = steps_of(part, robots, StepOptions(period_s=EPOCH_S / ticks, range_spacing_s=EPOCH_S))
    radios, ranges = part.radios, steps.ranges
    if anchors is None:
        of_anchor = _own_anchors(part, ranges.first, ranges.second, robots)
    else:
        first, second = anchors
        of_anchor = _anchor(part, first), _anchor(part, second)
    tick = steps.step + (steps.fraction >= HALF)
    lists: list[Places] = []
    for robot, anchor in enumerate(of_anchor):
        to_anchor = (ranges.first == robot) & (ranges.second == radios.index(anchor.id))
        lists.append(np.flatnonzero(to_anchor))
    lists.append(np.flatnonzero((ranges.first < len(robots)) & (ranges.second < len(robots))))
    used = np.concatenate(lists)
    heights = np.array([*[one.antenna[2] for one in part.robots], *[one.height for one in part.anchors]])
    rho, ratio = levelled(ranges.range[used], heights[ranges.first[used]] - heights[ranges.second[used]])
    counts = (len(lists[0]), len(lists[1]), len(lists[2]))
    told = np.repeat([noise.anchor_sigma, noise.anchor_sigma, noise.mutual_sigma], counts)
    if assumed.stated:
        told = np.where(np.isfinite(ranges.sigma[used]), ranges.sigma[used], told)
    sigma = np.maximum(told, SIGMA_FLOOR) * ratio
    sides = []
    for i, (name, anchor) in enumerate(zip(robots, of_anchor, strict=True)):
        path = path_of_steps(steps.increments[i], steps.covariance[i], EPOCH_S / ticks)
        sides.append(OneRobot(name, anchor, path, prepared[i], part.robots[i].antenna))
    unused = {
        "to other anchors": len(ranges.t) - len(used),
        "within a second after another": steps.thinned,
        "without odometry of both robots": steps.outside,
    }
    return PairMeasurements(
        sides[0],
        sides[1],
        float(steps.t[0]),
        ticks,
        Ranges(locked(rho), locked(tick[used]), locked(sigma), counts),
        locked(ranges.t[used].copy()),
        noise,
        {why: count for why, count in unused.items() if count},
    )


HALF = 0.5


def _anchor(recording: RangeRecording, name: str) -> FixedAnchor:
    return next(one for one in recording.anchors if one.id == name)


def _of_robots(recording: RangeRecording, whole: RangeRecording, robots: Sequence[str]) -> RangeRecording:
    """Return the recording of these `robots` alone, with the odometry that `whole` has for them."""
    first, last = recording.span
    part = recording.part(robots, first, last)
    return part._replace(
        robots=tuple(
            [
                one._replace(odometry=other.odometry)
                for one, other in zip(part.robots, whole.robots, strict=True)
            ]
        )
    )


def ticks_per_epoch(recording: RangeRecording, noise: Noise) -> int:
    """Return the number of ticks in an epoch, by the speed of the fastest robot (see SHARE)."""
    least = min(noise.anchor_sigma, noise.mutual_sigma)
    fastest = max(float(np.percentile(speeds(one.odometry)[0], NEARLY_ALL)) for one in recording.robots)
    return min(max(math.ceil(0.5 * EPOCH_S * fastest / (SHARE * max(least, 1e-3))), 1), MOST_TICKS)


def _own_anchors(
    recording: RangeRecording, first: Places, second: Places, robots: Sequence[str]
) -> tuple[FixedAnchor, FixedAnchor]:
    """Return the anchor of each robot: of all choices of two different places, that with the most ranges."""
    anchors, base = recording.anchors, len(recording.robots)
    counts = [
        [int(np.count_nonzero((first == robot) & (second == base + k))) for k in range(len(anchors))]
        for robot in range(2)
    ]
    best: tuple[int, int, int] | None = None
    for i, one in enumerate(anchors):
        for j, other in enumerate(anchors):
            if (one.x, one.y) == (other.x, other.y) or not min(counts[0][i], counts[1][j]):
                continue
            many = counts[0][i] + counts[1][j]
            if best is None or many > best[0]:
                best = (many, i, j)
    if best is None:
        heard = []
        for name, row in zip(robots, counts, strict=True):
            known = [anchors[k].id for k, count in enumerate(row) if count]
            heard.append(f"{name} has ranges to {', '.join(known) or 'no anchor'}")
        raise NoAnchors(
            f"{recording.source}: two robots need ranges to two anchors at different places: "
            + ", ".join(heard)
        )
    return anchors[best[1]], anchors[best[2]]


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
