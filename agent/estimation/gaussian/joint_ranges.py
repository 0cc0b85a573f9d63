"""The measurements of any number of robots for one fit: paths, ranges to anchors and ranges between robots.

They are a function of a set of facts, in canonical order: robots by name, ranges by kind, radios and tick.
An anchor that is not surveyed is a robot that stands: its position is estimated with the poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.estimation.elementary import hypot
from agent.estimation.facts import AnchorPlace, Facts, Manoeuvre, MeasuredRange
from agent.estimation.gaussian.odometry_noise import Array, Places, Track, track
from agent.estimation.gaussian.range_model import IMPOSSIBLE, MOST_CORRELATED_RANGES, SIGMA_FLOOR, Ranges
from protocol.noise import Noise

MOST_MUTUAL_RANGES = 1024
"""The most ranges between robots in one fit, of all pairs together; see MOST_CORRELATED_RANGES.

The time of a step is linear in their number. A group of 16 robots that meet as planned has about 500. With
less, 16 robots that all range each other would use fewer than 8 ranges of each pair.
"""


class JointRanges(msgspec.Struct, frozen=True, dict=True, eq=False):
    """N ranges: those of each robot to its anchors, and then those between robots."""

    rho: Array
    """The measured ranges (m); shape (N,)."""
    tick: Places
    sigma: Array
    """The standard deviation (m) of each range; shape (N,)."""
    first: Places
    """The index of the robot, or of the first of two; shape (N,)."""
    second: Places
    """The index of the second robot; -1 for a range to an anchor; shape (N,)."""
    place: Array
    """The position (m) of each range's anchor; 0 for ranges between robots; shape (N, 2)."""
    radio: Places
    """The index of each range's pair of radios, in the order of the ranges; shape (N,).

    -1 for a range that has no error but a white one, and is no outlier.
    """

    @cached_property
    def pairs(self) -> list[NDArray[np.bool]]:
        """The ranges of each pair of radios that has some; shapes (N,)."""
        return self.single.pairs

    @cached_property
    def single(self) -> Ranges:
        """All ranges as if they were those of one robot, for models that do not ask who measured them."""
        return Ranges(self.rho, self.tick, self.sigma, (len(self.rho), 0, 0), self.place, self.radio)

    def rows(self, some: NDArray[np.bool] | Places) -> JointRanges:
        """Return the ranges selected by `some`."""
        return JointRanges(*[part[some] for part in msgspec.structs.astuple(self)])

    def then(self, more: JointRanges) -> JointRanges:
        """Return these ranges followed by `more`."""
        both = zip(msgspec.structs.astuple(self), msgspec.structs.astuple(more), strict=True)
        return JointRanges(*[np.concatenate(parts) for parts in both])

    def of(self, robot: int) -> NDArray[np.bool]:
        """Return which ranges are those of a robot; shape (N,)."""
        involved: NDArray[np.bool] = (self.first == robot) | (self.second == robot)
        return involved


class PosePrior(NamedTuple):
    """A normal prior of the poses of n robots at tick 0."""

    mean: Array
    """The expected x and y (m, relative to the origin) and heading (rad) of each robot; shape (n, 3)."""
    information: Array
    """The inverse covariance; 0 for what is not known; shape (3 n, 3 n)."""
    rank: int
    """The rank of `information`: the number of unknowns that it determines."""
    log_information: float = 0.0
    """The logarithm of its determinant for these unknowns, if evidences with other priors are compared."""


class JointMeasurements(msgspec.Struct, frozen=True, dict=True, eq=False):
    """The odometry and the ranges of n robots."""

    robots: tuple[str, ...]
    """The names of the robots, then of the anchors without a position, then of those with a sigma."""
    anchors: tuple[str, ...]
    """The anchors to which there are ranges."""
    radios: tuple[tuple[str, str], ...]
    """The names of each pair of radios; `JointRanges.radio` is an index of it."""
    paths: tuple[Track, ...]
    """The measured path of each robot, in the frame of its pose at tick 0."""
    ranges: JointRanges
    period: float
    """The length of a tick in s."""
    origin: tuple[float, float]
    """The point of <W> (m) to which all positions are relative, so that they have small numbers."""
    noise: Noise
    prior: PosePrior | None = None
    """The prior of the poses at tick 0; None if nothing is known of them besides the ranges."""
    surveyed: tuple[AnchorPlace | None, ...] = ()
    """The place of each of `robots` that is an anchor, relative to the origin; None of one that drives.

    Empty if none is an anchor.
    """

    def is_anchor(self, robot: int) -> bool:
        """Return whether one of `robots` is an anchor."""
        return bool(self.surveyed) and self.surveyed[robot] is not None

    @property
    def driving(self) -> tuple[str, ...]:
        """The names of the robots that are no anchors."""
        return tuple([name for k, name in enumerate(self.robots) if not self.is_anchor(k)])

    @property
    def placed(self) -> tuple[int, ...]:
        """The anchors among `robots` with a position and a sigma."""
        return tuple([k for k, one in enumerate(self.surveyed) if one is not None and one.sigma < math.inf])

    @cached_property
    def as_surveyed(self) -> JointMeasurements:
        """These measurements as if anchors with a sigma were surveyed, and ranges to them less accurate."""
        if not self.placed:
            return self
        ranges = self.ranges
        second, place, sigma = ranges.second.copy(), ranges.place.copy(), ranges.sigma.copy()
        for k in self.placed:
            one, own = self.surveyed[k], ranges.second == k
            assert one is not None
            second[own], place[own] = -1, (one.x, one.y)
            sigma[own] = hypot(sigma[own], one.sigma)
        told = msgspec.structs.replace(ranges, second=second, place=place, sigma=sigma)
        return msgspec.structs.replace(self, ranges=told)

    @property
    def speeds(self) -> Array:
        """The largest possible rate (m/s) of each range: the speed of the robot, or of both; shape (N,)."""
        found = np.zeros(len(self.ranges.rho))
        for robot, path in enumerate(self.paths):
            rows = self.ranges.of(robot)
            found[rows] += path.speeds(self.ranges.tick[rows])
        return found

    def until(self, tick: int) -> JointMeasurements:
        """Return what was measured up to `tick`."""
        return msgspec.structs.replace(
            self,
            paths=tuple([path.until(min(tick, len(path.v))) for path in self.paths]),
            ranges=self.ranges.rows(self.ranges.tick <= tick),
        )

    def thinned(self, reach: float) -> JointMeasurements:
        """Return the measurements with as many ranges as a fit weighs, and none that must be an outlier.

        Of each pair of radios they are all recent ones and some older ones (see `Ranges.thinned`). `reach` is
        the longest range (m) that is expected.
        """
        ranges, priors = self.ranges, self.noise.priors
        loose = np.sqrt(np.square(ranges.sigma) + ranges.single.loosened(priors, self.speeds))
        ranges = ranges.rows(ranges.rho <= reach + IMPOSSIBLE * loose)
        pairs = ranges.pairs
        mutual = sum(1 for own in pairs if ranges.second[np.argmax(own)] >= 0)
        most = min(MOST_CORRELATED_RANGES, max(MOST_MUTUAL_RANGES // max(mutual, 1), WEIGHED_OF_PAIR))
        left = np.zeros(len(ranges.rho), bool)
        for own in pairs:
            rows = np.flatnonzero(own)
            bound = most if ranges.second[rows[0]] >= 0 else MOST_CORRELATED_RANGES
            left[rows[_recent(len(rows), bound)]] = True
        return msgspec.structs.replace(self, ranges=ranges if left.all() else ranges.rows(left))

    def some(self, chosen: Sequence[int]) -> JointMeasurements:
        """Return the measurements of the `chosen` robots alone, in ascending order.

        All anchors with a sigma are chosen, too: they are the last ones.
        """
        chosen = (*[one for one in chosen if one not in self.placed], *self.placed)
        surveyed = tuple([self.surveyed[one] for one in chosen]) if self.surveyed else ()
        index = np.full(len(self.robots) + 1, -2)  # the last entry is that of second == -1
        index[list(chosen)] = np.arange(len(chosen))
        index[-1] = -1
        ranges = self.ranges
        first, second = index[ranges.first], index[ranges.second]
        moved = msgspec.structs.replace(ranges, first=first, second=second)
        return msgspec.structs.replace(
            self,
            robots=tuple([self.robots[one] for one in chosen]),
            paths=tuple([self.paths[one] for one in chosen]),
            ranges=moved.rows((first >= 0) & (second >= -1)),
            surveyed=surveyed,
            prior=_prior(surveyed),
        )


WEIGHED_OF_PAIR = 8
"""The number of ranges of a pair of robots that are always weighed."""


def _recent(count: int, most: int) -> Places:
    """Return at most `most` of the indices below `count`: the latest half, and every 2^k-th of the others."""
    if count <= most:
        return np.arange(count)
    older, step = count - most // 2, 1
    while -(-older // step) > most - most // 2:
        step *= 2
    return np.concatenate((np.arange(0, older, step), np.arange(older, count)))


class _Row(NamedTuple):
    """A range with the names of its radios, in the order of the ranges of a fit."""

    mutual: bool
    first: str
    second: str
    tick: int
    measured: MeasuredRange


def joint_measurements(facts: Facts, noise: Noise, period: float) -> JointMeasurements:
    """Return the measurements in `facts`, with ticks of `period` s.

    The path of a robot reaches to its first unknown manoeuvre; ranges after it are not used, nor those to
    anchors of which no position is known.
    """
    places = {key.robot: value for key, value in facts.known if isinstance(value, AnchorPlace)}
    surveyed = {name: one for name, one in places.items() if not one.sigma}
    steps: dict[str, list[Manoeuvre]] = {name: [] for name in facts.robots}
    for key, value in facts.of_kind("manoeuvre"):
        if isinstance(value, Manoeuvre) and key.tick == len(steps[key.robot]):
            steps[key.robot].append(value)
    rows = []
    for key, value in facts.ordered:
        if not isinstance(value, MeasuredRange) or key.tick > len(steps[key.robot]):
            continue
        mutual = key.kind == "mutual range"
        if key.tick <= len(steps[key.other]) if mutual else key.other in places:
            rows.append(_Row(mutual, key.robot, key.other, key.tick, value))
    rows.sort(key=lambda row: row[:4])
    used = tuple(sorted({row.second for row in rows if not row.mutual}))
    unsure = [one for one in used if one not in surveyed]
    unsure.sort(key=lambda name: places[name].sigma < math.inf)
    index = {name: number for number, name in enumerate((*facts.robots, *unsure))}
    radios = tuple(dict.fromkeys([(row.first, row.second) for row in rows]))
    radio = {names: number for number, names in enumerate(radios)}
    first = sorted(used, key=lambda name: places[name].sigma)[:1]
    origin = places[first[0]] if first else AnchorPlace(0.0, 0.0)
    at = [surveyed.get(row.second, origin) for row in rows]
    standing = [Manoeuvre(0.0, 0.0)] * max(map(len, steps.values()), default=0)
    relative = [
        places[name]._replace(x=places[name].x - origin.x, y=places[name].y - origin.y) for name in unsure
    ]
    anchors = (*[None] * len(facts.robots), *relative) if unsure else ()
    return JointMeasurements(
        tuple(index),
        used,
        radios,
        tuple([_path(steps.get(name, standing), period) for name in index]),
        JointRanges(
            np.array([row.measured.range for row in rows], np.float64),
            np.array([row.tick for row in rows], np.intp),
            np.maximum(np.array([row.measured.sigma for row in rows], np.float64), SIGMA_FLOOR),
            np.array([index[row.first] for row in rows], np.intp),
            np.array([index.get(row.second, -1) for row in rows], np.intp),
            np.array([(one.x - origin.x, one.y - origin.y) for one in at], np.float64).reshape(-1, 2),
            np.array([radio[row.first, row.second] for row in rows], np.intp),
        ),
        period,
        (origin.x, origin.y),
        noise,
        _prior(anchors),
        anchors,
    )


def _prior(surveyed: tuple[AnchorPlace | None, ...]) -> PosePrior | None:
    """Return what is known of the poses of robots, some of which are anchors; None if none are.

    The heading of an anchor means nothing, and is held.
    """
    if not any(surveyed):
        return None
    mean, information = np.zeros((len(surveyed), 3)), np.zeros((3 * len(surveyed), 3 * len(surveyed)))
    for k, one in enumerate(surveyed):
        if one is not None:
            mean[k, :2] = one.x, one.y
            told = np.array((one.sigma**-2, one.sigma**-2, 1.0))
            information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.diag(told)
    known = np.diagonal(information)[np.diagonal(information) > 0.0].tolist()
    return PosePrior(mean, information, len(known), sum(map(math.log, known)))


def _path(steps: Sequence[Manoeuvre], period: float) -> Track:
    """Return the path of `steps`; without slip or extra variances if all of them are 0."""
    v, omega, slip, *extra = np.array(steps, np.float64).reshape(-1, 5).T
    path = track(v + 0.0, omega + 0.0, period, slip if slip.any() else None)
    both = np.stack(extra)
    return path._replace(extra=both) if both.any() else path
