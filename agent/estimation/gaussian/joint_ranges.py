"""The measurements of any number of robots for one fit: paths, ranges to anchors and ranges between robots.

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
from agent.estimation.facts import AnchorPlace
from agent.estimation.gaussian.odometry_noise import Array, Places, Track
from agent.estimation.solver import Solver
from protocol.noise import Noise, Priors

IMPOSSIBLE = 6.0
"""The number of sigmas beyond R from which a range is an outlier under any guess."""

MOVED = 0.01
"""The fraction of R that a robot must have moved for a range to count as one from another place."""

HELD = 1e24
"""The information (1 / rad^2) of a heading that is held: more than any ranges have."""

MOST_CORRELATED_RANGES = 96
"""The most ranges of a pair of radios that a fit weighs if odometry is noisy.

The cost of a fit is linear in their number. Old ranges tell little of the present pose then. Missions of the
sweep `noise` have up to 70; with a bound of less than that, they would take longer; with more, each search.
"""

MOST_RANGES_BY_EXACT_ODOMETRY = 2048
"""The most ranges of a pair of radios without white odometry noise. The cost is linear, and old ranges tell
as much as new ones.

With it, a tick takes 10 ms. A mission that needs more ranges than that does not reach its accuracy.
"""

MOST_MUTUAL_RANGES = 1024
"""The most ranges between robots in one fit, of all pairs together; see MOST_CORRELATED_RANGES.

The time of a step is linear in their number. A group of 16 robots that meet as planned has about 500. With
less, 16 robots that all range each other would use fewer than 8 ranges of each pair.
"""


def range_errors(priors: Priors, pairs: int) -> list[str]:
    """Return the name in `priors` of each constant error of ranges, in the order of a fit of `pairs`."""
    counts = {"range_bias": 1, "range_scale": 1, "pair_bias": pairs, "range_delay": 1}
    counts |= {"range_depth": 1, "range_aside": 1}
    return [name for name, count in counts.items() if getattr(priors, name) for _ in range(count)]


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
    by_second: NDArray[np.bool]
    """True if the second end has measured the range: a depth is along its heading; shape (N,)."""

    @cached_property
    def radios(self) -> list[int]:
        """The values of `radio` that occur, ascending, without -1."""
        # numpy.unique would import numpy.ma in the first search of a mission
        return sorted(set(self.radio.tolist()) - {-1})

    @cached_property
    def pairs(self) -> list[tuple[tuple[int, int], Places]]:
        """The two ends, like `first` and `second`, and the rows of each pair of radios that has ranges."""
        rows_of = [np.flatnonzero(self.radio == one) for one in self.radios]
        return [((int(self.first[rows[0]]), int(self.second[rows[0]])), rows) for rows in rows_of]

    @cached_property
    def of_anchors(self) -> dict[int, list[Places]]:
        """The rows of the ranges to each of its anchors, of each robot that has some."""
        found = dict[int, list[Places]]()
        for (robot, other), rows in self.pairs:
            if other < 0:
                found.setdefault(robot, []).append(rows)
        return found

    def common_errors(self, priors: Priors) -> Array:
        """Return the effect (m) of one sigma of each of the `range_errors` on the ranges; shape (N, c).

        The scale multiplies the measured ranges: then its effects are the same under each guess. The effects
        of a delay and of the share of depth depend on the poses (see `smoother`): their columns are the
        sigmas in s and as a fraction, 0 for a range that has no such error.
        """
        names = range_errors(priors, len(self.radios))
        found = np.tile([float(getattr(priors, name)) for name in names], (len(self.rho), 1))
        if priors.range_scale:
            found[:, names.index("range_scale")] *= self.rho
        if "pair_bias" in names:
            begin = names.index("pair_bias")
            found[:, begin : begin + len(self.radios)] *= self.radio[:, None] == self.radios
        if priors.range_depth:
            by_beacon = self.by_second & (self.second < 0)
            found[by_beacon, names.index("range_depth") :] = 0.0
        return found

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

    def to_anchors(self, robot: int) -> NDArray[np.bool]:
        """Return which ranges are those of a robot to its anchors; shape (N,)."""
        own: NDArray[np.bool] = (self.first == robot) & (self.second < 0)
        return own

    @property
    def mutual(self) -> NDArray[np.bool]:
        """True for each range between robots; shape (N,)."""
        between: NDArray[np.bool] = self.second >= 0
        return between


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

    def some(self, chosen: Sequence[int]) -> PosePrior | None:
        """Return the prior of the `chosen` robots, of which nothing is known together with others."""
        own = np.add.outer(3 * np.array(chosen, np.intp), np.arange(3)).ravel()
        information = self.information[np.ix_(own, own)]
        return prior_of(self.mean[list(chosen)], information) if np.diagonal(information).any() else None


def prior_of(mean: Array, information: Array) -> PosePrior:
    """Return the prior of poses of which nothing is known together."""
    known = np.diagonal(information)[np.diagonal(information) > 0.0].tolist()
    return PosePrior(mean, information, len(known), sum(map(math.log, known)))


class Silence(NamedTuple):
    """The ticks in which a range was possible, but not measured."""

    first: int
    """The index of the robot, or of the first of two."""
    second: int
    """The index of the second robot; -1 if a range to the anchor of the robot was possible."""
    ticks: Places


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
    reach: float = math.inf
    """The longest range (m) that is expected."""
    silent: tuple[Silence, ...] = ()
    """The ticks without a range of each pair of radios; empty if a missing range says nothing."""
    solver: Solver | None = None
    """The solver that the user has chosen; None for the smoother."""

    def __eq__(self, other: object) -> bool:
        """Return whether `other` has the same measurements, to the bit."""
        return isinstance(other, JointMeasurements) and self._content == other._content

    def __hash__(self) -> int:
        """Return the hash of all measurements."""
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(self._content)

    @cached_property
    def _content(self) -> tuple[object, ...]:
        """All measurements as values that can be compared."""
        ranges = tuple([part.tobytes() for part in msgspec.structs.astuple(self.ranges)])
        silent = tuple([(first, second, ticks.tobytes()) for first, second, ticks in self.silent])
        prior = self.prior and (self.prior.mean.tobytes(), self.prior.information.tobytes())
        paths = tuple([path.content for path in self.paths])
        return (
            *(self.robots, self.anchors, self.radios, paths, ranges, self.period, self.origin),
            *(self.noise, prior, self.surveyed, self.reach, silent, self.solver),
        )

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

    @property
    def started(self) -> tuple[int, ...]:
        """The robots whose poses at tick 0 have a prior."""
        known = () if self.prior is None else np.diagonal(self.prior.information)[::3].tolist()
        return tuple([k for k, told in enumerate(known) if told and not self.is_anchor(k)])

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

    @cached_property
    def pivots(self) -> Array:
        """The pivot of each robot: the mean place of its anchors; NaN, without any, for its start; (n, 2)."""
        ranges, found = self.ranges, np.full((len(self.robots), 2), math.nan)
        of_anchors = (ranges.second < 0) & (ranges.radio >= 0)
        for i in range(len(found)):
            rows = ranges.place[of_anchors & (ranges.first == i)]
            places = {tuple(row) for row in rows.tolist()} if (rows[1:] != rows[:-1]).any() else rows[:1]
            if len(places):
                found[i] = [math.fsum(axis) / len(places) for axis in zip(*places, strict=True)]
        return found

    @property
    def loosened(self) -> Array:
        """The variance (m^2) that constant and slow errors add to each range, but for depths; shape (N,)."""
        priors, ranges = self.noise.priors, self.ranges
        of_biases = priors.range_bias**2 + priors.pair_bias**2 + priors.slow_sigma**2
        variance: Array = np.square(priors.range_scale * ranges.rho) + of_biases
        return variance + np.square(priors.range_delay * self.speeds) if priors.range_delay else variance

    def thinned(self, reach: float, after: int = -1, most: int | None = None) -> JointMeasurements:
        """Return the measurements with as many ranges as a fit weighs, and none that must be an outlier.

        They are all up to the tick `after`, and at most `most` of each pair of radios after it: all recent
        ones and some older ones, so that the cost of a tick is bounded. Of those at one place, fewer are left
        first. Which of the older ones are left changes only when their number doubles. Of many pairs of
        robots, fewer are left (see MOST_MUTUAL_RANGES). `reach` is the longest range (m) that is expected.
        """
        ranges = self.ranges
        if ranges.rho.max(initial=0.0) > reach:
            longest = reach + IMPOSSIBLE * np.sqrt(np.square(ranges.sigma) + self.loosened)
            ranges = ranges if (ranges.rho <= longest).all() else ranges.rows(ranges.rho <= longest)
        used, pairs = msgspec.structs.replace(self, ranges=ranges, reach=reach), len(ranges.radios)
        if most is None:
            correlated = self.noise.wanders or self.noise.priors.slow_sigma > 0.0
            most = MOST_CORRELATED_RANGES if correlated else MOST_RANGES_BY_EXACT_ODOMETRY
        if len(ranges.rho) <= min(most, MOST_MUTUAL_RANGES // max(pairs, 1)):
            return used
        mutual = [other >= 0 and not self.is_anchor(other) for (_, other), _ in ranges.pairs]
        of_pair = min(most, max(MOST_MUTUAL_RANGES // max(sum(mutual), 1), WEIGHED_OF_PAIR))
        left = np.zeros(len(ranges.rho), bool)
        for (ends, rows), both_drive in zip(ranges.pairs, mutual, strict=True):
            before = int(np.count_nonzero(ranges.tick[rows] <= after))
            bound = of_pair if both_drive else most
            left[rows[:before]] = True
            left[used._weighed(ends, rows[before:], bound)] = True
        return used if left.all() else msgspec.structs.replace(used, ranges=ranges.rows(left))

    def _weighed(self, ends: tuple[int, int], rows: Places, most: int) -> Places:
        """Return at most `most` of the `rows` of the pair of radios at both `ends`.

        Places (see `from_places`) are left out only where one range of each is still too many.
        """
        if len(rows) <= most:
            return rows
        begins = self.from_places(ends, self.ranges.tick[rows])
        counts, of_place = np.diff(begins, append=len(rows)), most
        while of_place > 1 and np.minimum(counts, of_place).sum() > most:
            of_place //= 2
        of_each = [begin + _recent(count, of_place) for begin, count in zip(begins, counts, strict=True)]
        weighed: Places = rows[np.concatenate(of_each)]
        return weighed[_recent(len(weighed), most)]

    def from_places(self, ends: tuple[int, int], ticks: Places) -> Places:
        """Return the indices of the first of `ticks`, and of each at which one of both `ends` has moved.

        It has moved if it is farther than MOVED * reach from where it was at the index before in the result.
        """
        if not len(ticks):
            return ticks
        paths = [self.paths[end] for end in ends if end >= 0 and not self.is_anchor(end)]
        way, near = np.array([(path.x[ticks], path.y[ticks]) for path in paths]), MOVED * self.reach
        each = np.diff(way)
        steps = hypot(each[:, 0], each[:, 1]).max(axis=0)
        moved = np.append(True, steps > near)
        if np.any((steps > 0.0) & (steps <= near)):  # slow motion adds up
            places = way.transpose(2, 0, 1).tolist()
            last = places[0]
            for one, now in enumerate(places):
                away = [(x - u, y - v) for (x, y), (u, v) in zip(now, last, strict=True)]
                moved[one] = one == 0 or any(math.sqrt(x * x + y * y) > near for x, y in away)
                last = now if moved[one] else last
        return np.flatnonzero(moved)

    @property
    def only_rounding(self) -> bool:
        """True if the sensors are exact: what a fit leaves is rounding."""
        return self.noise.exact

    def has_moved(self, robot: int) -> bool:
        """Return whether the ranges of a robot are from different places in the frame of its odometry."""
        own, path = self.ranges.of(robot), self.paths[robot]
        x, y = path.x[self.ranges.tick[own]], path.y[self.ranges.tick[own]]
        away = hypot(x - x[:1], y - y[:1]).max(initial=0.0)
        return bool(away > MOVED * self.ranges.rho[own].max(initial=0.0))

    @cached_property
    def mutual_places(self) -> Places:
        """The indices of the mutual ranges of a pair that are the first, or follow a motion of a robot."""
        return self.from_places((0, 1), self.ranges.tick[self.ranges.mutual])

    @cached_property
    def places_of_pairs(self) -> list[tuple[tuple[int, int], int]]:
        """The two ends of each pair of radios, and the number of its ranges that are `from_places`."""
        tick = self.ranges.tick
        return [(ends, len(self.from_places(ends, tick[rows]))) for ends, rows in self.ranges.pairs]

    def alone(self, robot: int) -> JointMeasurements:
        """Return the measurements of one robot near its anchor, which is the origin.

        One anchor does not tell the heading at tick 0: it is held at 0, so the axes are those of the
        odometry. Where the anchor should be does not matter, so there is no surveying error. The result for
        each robot is kept, and so is what it caches.
        """
        known: dict[int, JointMeasurements] = self.__dict__.setdefault("of_each", {})
        if robot not in known:
            known[robot] = self._alone(robot)
        return known[robot]

    def _alone(self, robot: int) -> JointMeasurements:
        """Return the measurements of `alone`, which keeps them."""
        own = self.ranges.rows(self.ranges.to_anchors(robot))
        nothing = np.zeros(len(own.rho), np.intp)
        ranges = msgspec.structs.replace(own, first=nothing, place=np.zeros((len(nothing), 2)), radio=nothing)
        silent = [one._replace(first=0) for one in self.silent if (one.first, one.second) == (robot, -1)]
        noise = (
            msgspec.structs.replace(self.noise, survey_error=0.0) if self.noise.survey_error else self.noise
        )
        return msgspec.structs.replace(
            self,
            robots=("",),
            paths=(self.paths[robot],),
            ranges=ranges,
            origin=(0.0, 0.0),
            noise=noise,
            prior=PosePrior(np.zeros((1, 3)), np.diag((0.0, 0.0, HELD)), 1, math.log(HELD)),
            silent=tuple(silent),
        )

    def some(self, chosen: Sequence[int]) -> JointMeasurements:
        """Return the measurements of the `chosen` robots alone, in ascending order.

        All anchors with a sigma are chosen, too: they are the last ones.
        """
        chosen = (*[one for one in chosen if one not in self.placed], *self.placed)
        if chosen == tuple(range(len(self.robots))):
            return self
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
            prior=self.prior and self.prior.some(chosen),
            silent=tuple(
                [
                    Silence(int(index[one.first]), int(index[one.second]), one.ticks)
                    for one in self.silent
                    if index[one.first] >= 0 and index[one.second] >= -1
                ]
            ),
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
