"""The one model of a range recording: robots with odometry, ranges between radios, anchors, and any truth.

A recording does not depend on the format of its file. Times are in s on one clock, lengths in m, angles in
rad. All arrays are read-only.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Places = NDArray[np.intp]
Scalar = TypeVar("Scalar", bound=np.generic)


class RobotOdometry(NamedTuple):
    """The odometry of a robot: N increments, which do not overlap.

    An increment is the pose at its end in the frame of the pose at its start. If one starts after the end of
    the one before, there is a gap, in which the motion is unknown.
    """

    t0: Numbers
    """The start of each increment in s; shape (N,)."""
    t1: Numbers
    """The end of each increment in s, at or after its start; shape (N,)."""
    increments: Numbers
    """dx forward (m), dy to the left (m) and dheading (rad); shape (N, 3)."""
    covariance: Numbers
    """The stated covariance of the error of each increment; NaN where none is stated; shape (N, 3, 3)."""

    @property
    def gaps(self) -> Numbers:
        """The start and end in s of each interval between increments without odometry; shape (G, 2)."""
        gap = self.t0[1:] - self.t1[:-1] > SAME_TIME_S
        return np.stack((self.t1[:-1][gap], self.t0[1:][gap]), axis=1)


class TruePath(NamedTuple):
    """The true poses of a robot's centre."""

    t: Numbers
    """The times in s, not decreasing; shape (N,)."""
    poses: Numbers
    """x (m), y (m) and heading (rad), as in the file, wrapped or not; shape (N, 3)."""


class Jump(NamedTuple):
    """An increment of odometry that lasts too long, or begins too late, for an estimate across it."""

    begin_s: float
    """The end of the increment before it, or its own start if that is within LONGEST_GAP_S."""
    end_s: float
    """The start of this increment, or its end if it lasts too long itself."""
    why: str
    """The row, and what is wrong, in one line."""


class RecordedRobot(NamedTuple):
    """One robot of a range recording."""

    id: str
    odometry: RobotOdometry
    truth: TruePath | None = None
    """The true poses; None if the file has none."""
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The position of its radio in m: forward and to the left of its centre, and its height."""
    jumps: tuple[Jump, ...] = ()
    """The jumps of its odometry by more than LONGEST_GAP_S."""


class FixedAnchor(NamedTuple):
    """A radio that does not move."""

    id: str
    x: float
    """The x coordinate in m; NaN if it is unknown."""
    y: float
    """The y coordinate in m; NaN if it is unknown."""
    height: float = 0.0
    """The height in m, above the same level as those of the robots' radios."""
    sigma: float = 0.0
    """The standard deviation of both coordinates in m. 0: surveyed; infinite: unknown."""


class RangeSeries(NamedTuple):
    """N ranges in the order of time."""

    t: Numbers
    """The times in s; shape (N,)."""
    first: Places
    """The index in `RangeRecording.radios` of the robot that measured, or to which an anchor did; (N,)."""
    second: Places
    """The index of the other robot or the anchor, in `RangeRecording.radios`; shape (N,)."""
    range: Numbers
    """The measured ranges in m; shape (N,)."""
    sigma: Numbers
    """The stated standard deviation in m of each range; NaN where none is stated; shape (N,)."""

    def rows(self, chosen: NDArray[np.bool_] | Places) -> RangeSeries:
        """Return the ranges in `chosen`."""
        columns: Any = [locked(column[chosen]) for column in self]
        return RangeSeries(*columns)


class RangeRecording(NamedTuple):
    """The content of a recording of odometry and ranges."""

    source: str
    """The file or folder, for messages."""
    robots: tuple[RecordedRobot, ...]
    anchors: tuple[FixedAnchor, ...]
    ranges: RangeSeries
    unused: Mapping[str, int] = {}
    """The number of entries of the file that are no part of this model, by their kind."""
    origin: str | None = None
    """The robot whose first pose defined the frame of a run without anchors; None in that of anchors."""
    of_mission: bool = False
    """True if the ranges are those of a mission: distances, whose errors its robots know."""

    @property
    def radios(self) -> tuple[str, ...]:
        """The names of all robots, then of all anchors."""
        return (*[one.id for one in self.robots], *[one.id for one in self.anchors])

    @property
    def span(self) -> tuple[float, float]:
        """The first and the last time in s of all odometry; NaN if there is none."""
        paths = [one.odometry for one in self.robots if len(one.odometry.t0)]
        if not paths:
            return (np.nan, np.nan)
        return float(min(one.t0[0] for one in paths)), float(max(one.t1[-1] for one in paths))

    def robot(self, name: str) -> RecordedRobot:
        """Return the robot `name`. Raises KeyError if there is none."""
        for one in self.robots:
            if one.id == name:
                return one
        raise KeyError(name)

    def pairs(self) -> dict[tuple[str, str], Places]:
        """Return the rows of the ranges of each pair of radios, by their names in the order of `radios`."""
        radios = self.radios
        low = np.minimum(self.ranges.first, self.ranges.second)
        high = np.maximum(self.ranges.first, self.ranges.second)
        key = low * len(radios) + high
        return {
            (radios[one // len(radios)], radios[one % len(radios)]): np.flatnonzero(key == one)
            for one in np.unique(key)
        }

    def anchors_of(self, robot: int) -> tuple[FixedAnchor, ...]:
        """Return the anchors to which the robot at this place has ranges, that with the most first."""
        seconds = self.ranges.second[self.ranges.first == robot] - len(self.robots)
        counts = np.bincount(seconds[seconds >= 0], minlength=len(self.anchors)).tolist()
        order = sorted([k for k, count in enumerate(counts) if count], key=lambda k: -counts[k])
        return tuple([self.anchors[k] for k in order])

    def part(self, robots: Iterable[str], first_s: float, last_s: float) -> RangeRecording:
        """Return the part with `robots`, in their order, over [first_s, last_s].

        It has the increments that lie in that interval, the poses and ranges in it, and all anchors.
        Raises KeyError if there is no such robot.
        """
        found = tuple([_between(self.robot(name), first_s, last_s) for name in robots])
        return self._among(found, self.anchors, first_s, last_s)

    def with_places(self) -> RangeRecording:
        """Return this recording without the anchors whose position is unknown, and without their ranges."""
        anchors = tuple([one for one in self.anchors if one.sigma < np.inf])
        return self if anchors == self.anchors else self._among(self.robots, anchors, -np.inf, np.inf)

    def _among(
        self,
        robots: tuple[RecordedRobot, ...],
        anchors: tuple[FixedAnchor, ...],
        first_s: float,
        last_s: float,
    ) -> RangeRecording:
        """Return the recording of these robots and anchors, with the ranges in [first_s, last_s]."""
        radios = [*[one.id for one in robots], *[one.id for one in anchors]]
        places = {name: number for number, name in reversed([*enumerate(radios)])}
        place = np.array([places.get(one, -1) for one in self.radios], np.intp)
        ranges = self.ranges
        first, second = place[ranges.first], place[ranges.second]
        kept = (first >= 0) & (second >= 0) & (first_s <= ranges.t) & (ranges.t <= last_s)
        moved = ranges._replace(first=first, second=second)
        used = moved.rows(kept)
        return RangeRecording(self.source, robots, anchors, used, of_mission=self.of_mission)


LONG_GAP_S = 10.0
"""The time in s without odometry, or of one increment, from which on nothing is computed inside.

A robot of 0.5 m/s may be 5 m away then, and ranges to it say little. With less, the short gaps of radios and
drivers would be bridged in one step; with more, a single row costs more steps.
"""

LONGEST_GAP_S = 3600.0
"""The longest time in s without odometry that an estimate bridges.

After an hour, nothing is known of where a robot is. The usual cause is a clock that was set: stamps then jump
by years.
"""

SAME_TIME_S = 1e-6
"""The difference in s of two stamps of the same time: the rounding of stamps in files."""


def _between(robot: RecordedRobot, first_s: float, last_s: float) -> RecordedRobot:
    whole = (robot.odometry.t0 >= first_s) & (robot.odometry.t1 <= last_s)
    odometry = RobotOdometry(*[locked(column[whole]) for column in robot.odometry])
    truth = robot.truth
    if truth is not None:
        within = (truth.t >= first_s) & (truth.t <= last_s)
        truth = TruePath(*[locked(column[within]) for column in truth])
    jumps = [one for one in robot.jumps if first_s <= one.begin_s and one.end_s <= last_s]
    return robot._replace(odometry=odometry, truth=truth, jumps=tuple(jumps))


def locked(values: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return `values`, which cannot be changed any more."""
    values.flags.writeable = False
    return values
