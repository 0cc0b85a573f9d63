"""The meetings of a group: those that were planned, when they localised their robots, and those that were."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

import msgspec

from compose.recording.run import Run
from compose.recording.run_setup import Meetings, PresentMeeting, meetings_after

TICK_ROUNDING = 1e-6
"""The rounding error in ticks up to which a bound in ticks counts as a whole number."""


class MeetingResult(msgspec.Struct, frozen=True):
    """A planned meeting of two robots of a group, and when it localised them."""

    visitor: str
    """The robot that drives to the other one."""
    visited: str
    """The robot that waits beside its anchor."""
    bound_s: float
    """The computed bound in s of the time at which both are localised."""
    bound_ticks: int
    """That bound in ticks, rounded up."""
    localised_tick: int | None
    """The first tick in which both claimed their poses; missing if one never did."""


class SearchResult(msgspec.Struct, frozen=True):
    """A robot without an anchor, and when it was localised."""

    robot: str
    """The robot."""
    bound_s: float
    """The computed bound in s of the time at which it is localised."""
    bound_ticks: int
    """That bound in ticks, rounded up."""
    localised_tick: int | None
    """The first tick in which it claimed its pose; missing if it never did."""


def search_results(run: Run) -> Iterator[SearchResult]:
    """Yield the robots without an anchor, in the order of the scenario."""
    planned = run.scenario.planned_sweep
    if planned is None:
        return
    for robot in run.scenario.unanchored:
        claim, ticks = run.claim(robot), planned.ends / run.scenario.mission.period
        yield SearchResult(
            robot, planned.ends, math.ceil(ticks - TICK_ROUNDING), claim.tick if claim is not None else None
        )


def meeting_results(run: Run) -> Iterator[MeetingResult]:
    """Yield the meetings of a group, in the order of their bounds; none for pairs and in hardware mode."""
    if run.world is None:
        return
    claims = {robot: run.claim(robot) for robot in run.robots} if run.scenario.meetings else {}
    period = run.scenario.mission.period
    confirmed = run.scenario.confirmation
    for one in run.scenario.meetings:
        ends = confirmed.ends if confirmed is not None else one.ends
        ticks = [claim.tick for robot in (one.visitor, one.visited) if (claim := claims[robot]) is not None]
        yield MeetingResult(
            one.visitor,
            one.visited,
            ends,
            math.ceil(ends / period - TICK_ROUNDING),
            max(ticks) if len(ticks) == 2 else None,
        )


class PastMeeting(msgspec.Struct, frozen=True):
    """A meeting of a group in a run."""

    a: str
    """The robot of role a."""
    b: str
    """The robot of role b."""
    first: int
    """The tick in which a leaves for it; 0 if it is the first one of both robots."""
    last: int
    """The tick before the first of the robots leaves for its next meeting, or the last one of the run."""
    number: int = 1
    """The number of meetings of the two so far, this one included."""
    newcomers: frozenset[str] = frozenset()
    """The robots whose first meeting this is."""


def past_meetings(run: Run) -> tuple[PastMeeting, ...]:
    """Return the meetings of the group in `run` that have begun, in that order; empty for pairs."""
    if run.setup is None or not run.setup.visits:
        return ()
    begun = _begun(run)
    spans = sorted(
        (first, _last(begun, robot, meeting.peer, first, run.length), robot, meeting.peer)
        for robot, meetings in begun.items()
        for first, meeting in meetings
        if meeting.role == "a" and meeting.peer in begun
    )
    found: list[PastMeeting] = []
    times: Counter[frozenset[str]] = Counter()
    met: set[str] = set()
    for first, last, a, b in spans:
        robots = frozenset((a, b))
        times[robots] += 1
        found.append(PastMeeting(a, b, first, last, times[robots], robots - met))
        met |= robots
    return tuple(found)


Begun = dict[str, list[tuple[int, PresentMeeting]]]
"""The meetings of each robot with the ticks in which they begin."""


def _begun(run: Run) -> Begun:
    begun: Begun = {}
    meetings: Meetings = {}
    for tick in range(run.length):
        commands = {robot: one for robot in run.robots if (one := run.command(robot, tick)) is not None}
        earlier, meetings = meetings, meetings_after(meetings, commands)
        for robot in commands if meetings is not earlier else ():
            if robot in meetings and meetings[robot] != earlier.get(robot):
                begun.setdefault(robot, []).append((tick, meetings[robot]))
    return begun


def _last(begun: Begun, a: str, b: str, first: int, length: int) -> int:
    """Return the last tick of the meeting of `a` and `b` that begins in tick `first`."""
    leaves = [tick for tick, _ in begun[a] if tick > first]
    leaves += [tick for tick, meeting in begun[b] if tick > first and meeting.peer != a]
    return min([length, *leaves]) - 1
