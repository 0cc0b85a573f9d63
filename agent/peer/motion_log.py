"""A robot's manoeuvres and anchor ranges, tick by tick: its own, or what it has been told of its peer's."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise

import msgspec

from protocol.messages import MAX_REPORT_RANGES, MAX_REPORT_RUNS, Ranged
from protocol.motion import Pose, Segment, arc, follow


class MotionLog(msgspec.Struct, frozen=True):
    """What was executed over [0, through], never what was asked, and the ranges taken on the way."""

    through: int = 0
    runs: tuple[Segment, ...] = ()
    ranges: tuple[Ranged, ...] = ()

    def moved(self, standstill_bound: tuple[float, float] = (0.0, 0.0)) -> int:
        """The tick by which the last manoeuvre that was no rest had ended.

        A robot at rest may measure up to `standstill_bound`, in m/s and rad/s.
        """
        at_rest = 0
        for run in reversed(self.runs):
            if abs(run.v) > standstill_bound[0] or abs(run.omega) > standstill_bound[1]:
                break
            at_rest += run.ticks
        return self.through - at_rest

    def until(self, tick: int) -> tuple[Segment, ...]:
        """Return what was driven over [0, tick]."""
        return self.runs if tick >= self.through else _between(self.runs, 0, tick)

    def drove(self, v: float, omega: float, ticks: int = 1) -> MotionLog:
        """The log after `ticks` more of one manoeuvre."""
        runs = self.runs
        if runs:
            last = runs[-1]
            if last.v == v and last.omega == omega:
                runs, ticks_in_all = runs[:-1], last.ticks + ticks
                return MotionLog(self.through + ticks, (*runs, Segment(ticks_in_all, v, omega)), self.ranges)
        return MotionLog(self.through + ticks, (*runs, Segment(ticks, v, omega)), self.ranges)

    def ranged(self, distance: float) -> MotionLog:
        """The log with an anchor range (m) at its last tick."""
        return MotionLog(self.through, self.runs, (*self.ranges, Ranged(self.through, distance)))

    def after(self, since: int, ranges_since: int) -> MotionLog:
        """What a peer lacks that knows the manoeuvres through `since`, and the first `ranges_since` ranges.

        No more than one report can carry. Its runs begin at tick `since`.
        """
        fresh = [begin for begin, run in _dated(self.runs) if begin + run.ticks > since]
        through = fresh[MAX_REPORT_RUNS] if len(fresh) > MAX_REPORT_RUNS else self.through
        ranges = self.ranges[ranges_since : ranges_since + MAX_REPORT_RANGES]
        return MotionLog(through, _between(self.runs, since, through), ranges)

    def extended(self, since: int, ranges_since: int, told: MotionLog) -> MotionLog:
        """The log with what `told` (see `after`) adds; of what would leave a gap, nothing."""
        book = self
        if since <= self.through:
            for run in _between(told.runs, self.through - since, told.through - since):
                book = book.drove(run.v, run.omega, run.ticks)
        known = len(self.ranges)
        news = told.ranges[known - ranges_since :] if ranges_since <= known else ()
        return MotionLog(book.through, book.runs, self.ranges + news)

    def between(self, first: int, last: int) -> tuple[Segment, ...]:
        """What was driven over [first, last], as few runs."""
        runs = _between(self.runs, first, last)
        if all(one.v != other.v or one.omega != other.omega for one, other in pairwise(runs)):
            return runs
        return MotionLog().extended(0, 0, MotionLog(last - first, runs)).runs

    def pose(self, start: Pose, tick: int, period: float) -> Pose:
        """Where the robot was at `tick`, if it was at `start` at tick 0."""
        return follow(start, self.until(tick), period)

    def track(self, start: Pose, first: int, last: int, period: float) -> list[Pose]:
        """Where the robot was at each tick in [first, last], if it was at `start` at tick 0."""
        pose = self.pose(start, first, period)
        track = [pose]
        for run in _between(self.runs, first, last):
            track += arc(track[-1], run, period)
        return track


def _dated(runs: Iterable[Segment]) -> Iterator[tuple[int, Segment]]:
    """Each run with the tick it begins at, the first at 0."""
    begin = 0
    for run in runs:
        yield begin, run
        begin += run.ticks


def _between(runs: tuple[Segment, ...], first: int, last: int) -> tuple[Segment, ...]:
    """What was driven over [first, last]."""
    found: list[Segment] = []
    end = 0
    for run in runs:
        begin, end = end, end + run.ticks
        if begin >= last:
            break
        if end > first:
            whole = begin >= first and end <= last
            found.append(run if whole else Segment(min(end, last) - max(begin, first), run.v, run.omega))
    return tuple(found)
