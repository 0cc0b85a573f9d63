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

EPOCH_S = 0.5
"""The time in s between two estimates."""

RANGE_SPACING_S = 1.0
"""The least time in s between two ranges of the same radios.

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


SHORTEST_RANGE_M = 1e-3
"""The least length in m of the longest range. A recording whose ranges are all 0 says nothing."""


def horizon(ranges: Ranges) -> float:
    """Return the assumed sensing range (m), for which `ranges` are those so far."""
    return HORIZON * max(float(np.max(ranges.rho, initial=0.0)), SHORTEST_RANGE_M)


class NoAnchors(UserError):
    """The robots have no ranges to two anchors at different places."""


class OneRobot(NamedTuple):
    """One robot: its path in ticks, and how it was prepared."""

    id: str
    anchors: tuple[FixedAnchor, ...]
    """The anchors to which it has ranges. Poses are relative to the first, which has the most."""
    path: Track
    """The path of the antenna, in the frame of its first pose."""
    sound: SoundOdometry
    antenna: tuple[float, float, float]

    @property
    def anchor(self) -> FixedAnchor:
        """The first of its anchors."""
        return self.anchors[0]


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
        """The names of each pair of radios, in the order of `Ranges.pairs`."""
        to_anchors = [(side.id, anchor.id) for side in self.sides for anchor in side.anchors]
        return (*to_anchors, (self.a.id, self.b.id))

    @property
    def anchors(self) -> tuple[FixedAnchor, ...]:
        """The anchors of both robots."""
        return tuple({one.id: one for side in self.sides for one in side.anchors}.values())

    def counts(self, ranges: Ranges) -> tuple[int, ...]:
        """Return the number of `ranges` of each of the `pairs`."""
        if ranges.radio is None:
            return ranges.counts
        return tuple(np.bincount(ranges.radio, minlength=len(self.pairs)).tolist())

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
        place, radio = self.ranges.place, self.ranges.radio
        some = Ranges(
            self.ranges.rho[known],
            self.ranges.tick[known],
            self.ranges.sigma[known],
            (first, second, mutual),
            place[known] if place is not None else None,
            radio[known] if radio is not None else None,
        )
        reach = horizon(some)
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
    all_anchors: bool = False,
) -> PairMeasurements:
    """Return the measurements of two `robots`, with the noise that is `assumed`.

    `ticks` is the number of them in an epoch; None: by the speed of the robots. Each robot ranges to one of
    two `anchors`; None: those with the most ranges. Ranges to other anchors are used only if `all_anchors` is
    set. Raises UserError if there are no two such anchors.
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
    steps = steps_of(part, robots, StepOptions(period_s=EPOCH_S / ticks, range_spacing_s=RANGE_SPACING_S))
    radios, ranges = part.radios, steps.ranges
    if anchors is None:
        of_anchor = _own_anchors(part, ranges.first, ranges.second, robots)
    else:
        first, second = anchors
        of_anchor = _anchor(part, first), _anchor(part, second)
    tick = steps.step + (steps.fraction >= HALF)
    mutual = (ranges.first < len(robots)) & (ranges.second < len(robots))
    lists = [
        np.flatnonzero(
            ~mutual & (ranges.first == robot) & (all_anchors | (ranges.second == radios.index(anchor.id)))
        )
        for robot, anchor in enumerate(of_anchor)
    ]
    lists.append(np.flatnonzero(mutual))
    used = np.concatenate(lists)
    of_robot = [_anchors_of(part, ranges.second[lists[i]], one) for i, one in enumerate(of_anchor)]
    heights = np.array([*[one.antenna[2] for one in part.robots], *[one.height for one in part.anchors]])
    rho, ratio = levelled(ranges.range[used], heights[ranges.first[used]] - heights[ranges.second[used]])
    counts = (len(lists[0]), len(lists[1]), len(lists[2]))
    told = np.repeat([noise.anchor_sigma, noise.anchor_sigma, noise.mutual_sigma], counts)
    if assumed.stated:
        told = np.where(np.isfinite(ranges.sigma[used]), ranges.sigma[used], told)
    sigma = np.maximum(told, SIGMA_FLOOR) * ratio
    sides = []
    for i, (name, own) in enumerate(zip(robots, of_robot, strict=True)):
        path = path_of_steps(steps.increments[i], steps.covariance[i], EPOCH_S / ticks)
        sides.append(OneRobot(name, own, path, prepared[i], part.robots[i].antenna))
    place, radio = _several(of_robot, [[radios[k] for k in ranges.second[rows]] for rows in lists])
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
        Ranges(locked(rho), locked(tick[used]), locked(sigma), counts, place, radio),
        locked(ranges.t[used].copy()),
        noise,
        {why: count for why, count in unused.items() if count},
    )


HALF = 0.5


def _anchors_of(recording: RangeRecording, ranged: Places, first: FixedAnchor) -> tuple[FixedAnchor, ...]:
    """Return `first`, and then all other anchors among the second radios of ranges, `ranged`."""
    names = {recording.radios[k] for k in set(ranged.tolist())}
    return (first, *[one for one in recording.anchors if one.id in names and one.id != first.id])


def _several(
    anchors: Sequence[tuple[FixedAnchor, ...]], ranged: Sequence[Sequence[str]]
) -> tuple[Numbers | None, Places | None]:
    """Return `place` and `radio` of `Ranges`; None each if both robots have one anchor.

    `anchors` are those of each robot, and `ranged` the names of the second radio of each range: those to the
    anchors of a robot, in the order of the robots, and then the mutual ones.
    """
    if all(len(own) == 1 for own in anchors):
        return None, None
    place, radio, before = [], [], 0
    for own, names in zip(anchors, ranged, strict=False):
        index = {one.id: k for k, one in enumerate(own)}
        place += [(own[index[name]].x - own[0].x, own[index[name]].y - own[0].y) for name in names]
        radio += [before + index[name] for name in names]
        before += len(own)
    mutual = len(ranged[-1])
    return np.array([*place, *[(0.0, 0.0)] * mutual]), np.array([*radio, *[before] * mutual], np.intp)


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
        np.bincount(second[(first == robot) & (second >= base)] - base, minlength=len(anchors)).tolist()
        for robot in range(2)
    ]
    best: tuple[int, int, int] | None = None
    for i in _most_ranged(anchors, counts[0]):
        for j in _most_ranged(anchors, counts[1]):
            if (anchors[i].x, anchors[i].y) == (anchors[j].x, anchors[j].y):
                continue
            many = counts[0][i] + counts[1][j]
            if best is None or many > best[0]:
                best = (many, i, j)
    if best is None:
        heard = []
        for name, row in zip(robots, counts, strict=True):
            known = [anchors[k].id for k, count in enumerate(row) if count]
            heard.append(f"{name} has ranges to {listed(known) or 'no anchor'}")
        raise NoAnchors(
            f"{recording.source}: two robots need ranges to two anchors at different places: "
            + ", ".join(heard)
        )
    return anchors[best[1]], anchors[best[2]]


def _most_ranged(anchors: Sequence[FixedAnchor], counts: Sequence[int]) -> list[int]:
    """Return the indices of two anchors with ranges, at different places, which have the largest `counts`.

    The anchors of two robots at different places, with the most ranges in all, are among these two of each.
    """
    found: dict[tuple[float, float], int] = {}
    for k in sorted([k for k, count in enumerate(counts) if count], key=lambda k: -counts[k]):
        found.setdefault((anchors[k].x, anchors[k].y), k)
    return sorted(list(found.values())[:2])


MOST_LISTED = 8
"""The largest number of names in a list for a user."""


def listed(names: Sequence[str]) -> str:
    """Return `names` in one line: the first MOST_LISTED, and the number of the others."""
    more = len(names) - MOST_LISTED
    return ", ".join(names[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")


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
