"""The bounds of a group that are announced in place of the planned one, once a robot is late.

A robot is late if it is not localised by its bound in the plan: it may be dead, or the robot that was to
visit it. Localised robots then go to robots of which they have not heard that they are localised, the nearest
first. Without any localised robot, the next pair of the plan tries again. A corrected bound is the time by
which one localised robot has been everywhere, so that all are localised that still can be.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import msgspec

from compose.recording.run import Run
from protocol.coverage_strips import Place, widest_distance
from protocol.coverage_ticks import ticks_of_parts
from protocol.orbits import SEARCH_SIDES, meeting_ticks, search_ticks
from world.faults import exchange_ticks
from world.scenario import PlannedConfirmation, Scenario


class CorrectedBound(msgspec.Struct, frozen=True):
    """A bound that is announced while robots of a group are late."""

    tick: int
    """The tick in which it is announced."""
    late: tuple[str, ...]
    """The robots that should be localised by then, and are not."""
    bound_ticks: int
    """The tick by which all robots are localised that can be."""


def corrected_bounds(run: Run) -> tuple[CorrectedBound, ...]:
    """Return the bounds that correct the planned one of the group in `run`, in their order; none for pairs.

    Each depends on the plan and on the claims until its tick only. The first is announced when a robot is
    late. As long as pairs are left that try again, another follows: if nobody is localised, when the time of
    a pair is over; otherwise when the bound is over, because those that are localised, such as an attacker,
    have then not helped the others.
    """
    if run.world is None or not run.scenario.meetings:
        return ()
    scenario, last = run.scenario, run.length - 1
    if scenario.confirmation is not None:
        return _of_confirmation(run, scenario.confirmation)
    claims = {robot: claim.tick for robot in run.robots if (claim := run.claim(robot)) is not None}
    ends = {one.robot: one.ends for one in scenario.members}
    if (planned := scenario.planned_sweep) is not None:
        ends |= dict.fromkeys(scenario.unanchored, math.ceil(planned.ends / scenario.mission.period))
    overdue = [end + 1 for robot, end in ends.items() if claims.get(robot, end + 1) > end]
    tick = min(overdue, default=last)
    stages = [max(ends.values())]
    stages += [math.ceil((one.begins + one.lasts) / scenario.mission.period) for one in scenario.retries]
    found: list[CorrectedBound] = []
    while tick < last:
        localised = {robot for robot, claimed in claims.items() if claimed <= tick}
        left = [stage for stage in stages if stage >= tick]
        if localised and not found:
            begins = max(tick, stages[0])
        elif left:
            begins = left[0]
        else:
            break
        late = tuple([robot for robot in run.robots if ends[robot] < tick and robot not in localised])
        waiting = [robot for robot in run.robots if robot not in localised]
        tour = _tour_ticks(scenario, waiting)
        bound = begins + _return_ticks(scenario, waiting) + tour + _coverage_ticks(scenario, tour)
        found.append(CorrectedBound(tick, late, bound))
        tick = (bound if min(claims.values(), default=last) <= begins else begins) + 1
    return tuple(found)


def _of_confirmation(run: Run, planned: PlannedConfirmation) -> tuple[CorrectedBound, ...]:
    """Return the end of the visits that confirm poses, if a robot is late after the first pass of them."""
    period, late = run.scenario.mission.period, math.ceil(planned.ends / run.scenario.mission.period)
    claims = {robot: run.claim(robot) for robot in run.robots}
    robots = tuple([robot for robot, claim in claims.items() if claim is None or claim.tick > late])
    if not robots or late + 1 >= run.length - 1:
        return ()
    last = max([one.begins + one.lasts for one in planned.visits], default=planned.ends)
    return (CorrectedBound(late + 1, robots, math.ceil(last / period)),)


def _coverage_ticks(scenario: Scenario, tour: int) -> int:
    """Return the ticks in which one robot covers all parts of the area; 0 if all robots have an anchor.

    After each part, it makes a tour of at most `tour` ticks to robots that are late.
    """
    if scenario.planned_sweep is None:
        return 0
    area = scenario.planned_sweep.sweep
    widest = widest_distance((*_anchors(scenario), *area.corners))
    parts = ticks_of_parts(area, scenario.mission, widest, len(scenario.unanchored))
    return sum([tour + ticks for ticks in parts])


def _anchors(scenario: Scenario) -> list[Place]:
    """Return the places of all anchors, in m."""
    return [(at.x, at.y) for one in scenario.robots if (at := one.given_anchor) is not None]


def _return_ticks(scenario: Scenario, waiting: Collection[str]) -> int:
    """Return the ticks within which all of `waiting` are back from their orbits, and are visited again.

    A visitor that did not find a robot beside its anchor returns after the time of the longest way.
    """
    step = scenario.mission.max_speed * scenario.mission.period
    radii = [one.rendezvous.a.radius for one in scenario.robots if one.id in waiting and one.role == "a"]
    if not radii:
        return 0
    return math.ceil((max(radii) + widest_distance(tuple(_anchors(scenario)))) / step)


def _tour_ticks(scenario: Scenario, waiting: Collection[str]) -> int:
    """Return the ticks in which a robot that begins at any anchor goes to all others, the nearest first.

    It meets those of `waiting`. With noisy sensors, it searches each of them.
    """
    mission = scenario.mission
    step = mission.max_speed * mission.period
    turn = math.ceil(math.pi / (mission.max_turn_rate * mission.period))
    anchors = _anchors(scenario)
    ways = [_way_to_all(anchors, begin) for begin in range(len(anchors))]
    visits = len(anchors) - 1
    way = math.ceil(max(ways) / step) + visits * (turn + 1 + search_ticks(mission, SEARCH_SIDES))
    each, once = exchange_ticks(scenario.faults)
    return way + len(waiting) * (meeting_ticks(mission) + each) + once


def _way_to_all(places: Sequence[Place], begin: int) -> float:
    """Return the length in m of the way from the place at index `begin` to all others, the nearest first."""
    left = list(places)
    here, way = left.pop(begin), 0.0
    while left:
        nearest = min(left, key=lambda place: math.dist(place, here))
        way += math.dist(nearest, here)
        left.remove(nearest)
        here = nearest
    return way
