"""The localisation of a group: its planned meetings, and the ticks in which they were over."""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec

from compose.recording.run import Run

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
