"""The motion log: the manoeuvres and anchor ranges of a robot, its own or as received from its peer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import msgspec

from protocol.messages import MAX_REPORT_RANGES, MAX_REPORT_RUNS, Ranged
from protocol.motion import Pose, Segment, arc, follow


class MotionLog(msgspec.Struct, frozen=True):
    """The manoeuvres executed over the ticks [0, through], as measured by odometry, and the anchor ranges."""

    through: int = 0
    runs: tuple[Segment, ...] = ()
    ranges: tuple[Ranged, ...] = ()

    def moved(self, standstill_bound: tuple[float, float] = (0.0, 0.0)) -> int:
        """Return the tick at which the last motion ended.

        The odometry of a robot at rest may measure up to `standstill_bound`, in m/s and rad/s.
        """
        at_rest = 0
        for run in reversed(self.runs):
            if abs(run.v) > standstill_bound[0] or abs(run.omega) > standstill_bound[1]:
                break
            at_rest += run.ticks
        return self.through - at_rest

    def until(self, tick: int) -> tuple[Segment, ...]:
        """Return the segments over [0, tick]."""
        return self.runs if tick >= self.through else _between(self.runs, 0, tick)

    def drove(self, v: float, omega: float, ticks: int = 1) -> MotionLog:
        """Return the log with `ticks` more ticks of one manoeuvre. Equal manoeuvres are joined."""
        runs = self.runs
        if runs:
            last = runs[-1]
            if last.v == v and last.omega == omega:
                longer = Segment(last.ticks + ticks, v, omega)
                return MotionLog(self.through + ticks, runs[:-1] + (longer,), self.ranges)
        return MotionLog(self.through + ticks, (*runs, Segment(ticks, v, omega)), self.ranges)

    def ranged(self, distance: float) -> MotionLog:
        """Return the log with an anchor range in m at its last tick."""
        return MotionLog(self.through, self.runs, (*self.ranges, Ranged(self.through, distance)))

    def after(self, since: int, ranges_since: int) -> MotionLog:
        """Return the part of the log that a peer lacks which has acknowledged it up to `since`.

        The peer also has the first `ranges_since` ranges. The part is limited to what one report can carry,
        and its segments begin at tick `since`.
        """
        unacknowledged = [begin for begin, run in _with_first_ticks(self.runs) if begin + run.ticks > since]
        through = unacknowledged[MAX_REPORT_RUNS] if len(unacknowledged) > MAX_REPORT_RUNS else self.through
        ranges = self.ranges[ranges_since : ranges_since + MAX_REPORT_RANGES]
        return MotionLog(through, _between(self.runs, since, through), ranges)

    def extended(self, since: int, ranges_since: int, addition: MotionLog) -> MotionLog:
        """Return the log extended by `addition` (see `after`). Data that would leave a gap are ignored."""
        log = self
        if since <= self.through:
            for run in _between(addition.runs, self.through - since, addition.through - since):
                log = log.drove(run.v, run.omega, run.ticks)
        present = len(self.ranges)
        new_ranges = addition.ranges[present - ranges_since :] if ranges_since <= present else ()
        return MotionLog(log.through, log.runs, self.ranges + new_ranges)

    def between(self, first: int, last: int) -> tuple[Segment, ...]:
        """Return the segments over [first, last], with equal manoeuvres joined."""
        runs = _between(self.runs, first, last)
        if all(one.v != other.v or one.omega != other.omega for one, other in pairwise(runs)):
            return runs
        return MotionLog().extended(0, 0, MotionLog(last - first, runs)).runs

    def pose(self, start: Pose, tick: int, period: float) -> Pose:
        """Return the pose at `tick` for the pose `start` at tick 0."""
        return follow(start, self.until(tick), period)

    def track(
        self, start: Pose, first: int, last: int, period: float, poses: Sequence[Pose] = ()
    ) -> list[Pose]:
        """Return the poses at each tick in [first, last] for the pose `start` at tick 0.

        `poses` are the first of them, from an earlier call. They are not computed again.
        """
        track = list(poses) or [self.pose(start, first, period) if first else start]
        begin = 0
        for run in _between(self.runs, first, last) if first else self.until(last):
            done = len(track) - 1 - begin
            if done < run.ticks:
                track += arc(track[begin], run, period, done)
            begin += run.ticks
        return track


def _with_first_ticks(runs: Iterable[Segment]) -> Iterator[tuple[int, Segment]]:
    """Yield the first tick of each segment, and the segment."""
    begin = 0
    for run in runs:
        yield begin, run
        begin += run.ticks


def _between(runs: tuple[Segment, ...], first: int, last: int) -> tuple[Segment, ...]:
    """Return the segments over [first, last]; the outer ones are cut."""
    segments: list[Segment] = []
    end = 0
    for run in runs:
        begin, end = end, end + run.ticks
        if begin >= last:
            break
        if end > first:
            whole = begin >= first and end <= last
            segments.append(run if whole else Segment(min(end, last) - max(begin, first), run.v, run.omega))
    return tuple(segments)
