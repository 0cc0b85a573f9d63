"""The way of a robot past those that it does not meet, at the safety distance, by ranges alone.

In each tick, a robot drives at most half of the way that is left to the safety distance, in any direction.
Two robots that both do so keep it. On its way to another robot, or to its orbit and on it, a robot may then
be blocked by another one, which stands there or is blocked itself: it drives back, then aside, and on.

A blocked robot waits only for those with a smaller id, so of robots that block each other the one with the
smallest id never waits. The others wait for a few ticks at most: that one may not be on its way.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from msgspec.structs import replace

from agent.planning import drive, phase2_orbit, separation, visit
from agent.planning.state import Bypass, RobotState
from agent.planning.tasks import Orbital, Orbiting, Travelling, transformed
from protocol.coverage_strips import Place
from protocol.messages import Contact
from protocol.mission import Mission
from protocol.motion import Controls, Pose, compose

RESERVE = 0.05
"""The way that a robot leaves unused, as a fraction of A_0, except on a way aside, which uses it.

Without it, two robots come so near that neither has any way left, and both stand there for ever. What is
allowed for errors of the ranges is a part of it: most of them are smaller, and leave the robots some way.
"""

BLOCKED_AFTER = 4
"""The number of ticks with little way left, which does not grow, after which a robot drives aside."""

BLOCKED_ASIDE_AFTER = 16
"""The number of such ticks on a way aside after which it leads elsewhere.

With as few as BLOCKED_AFTER, noise of the ranges turns robots to and fro that have hardly begun to back off.
"""

CLEARANCE = 0.25
"""The distance by which a way aside is longer than needed, as a fraction of R."""

MOST_YIELDED = 8
"""The ticks for which a blocked robot stands still if one with a smaller id is near.

With 60, groups take as long.
"""


def onward(state: RobotState, contacts: Sequence[Contact]) -> RobotState:
    """Return `state` on its way past the robots in contact that it does not meet, after a tick.

    A peer that does not go on with the meeting is passed like any other robot.
    """
    mission, passing, task = state.config.mission, state.passing, state.task
    if not mission.safety_distance:
        return state
    met = state.config.peer if state.in_contact else None
    ranges = {one.peer: one.range for one in contacts if one.peer != met}
    stays = isinstance(task, Orbiting) and state.config.orbit.v == 0.0
    if stays or not isinstance(task, Travelling | Orbital):
        return replace(state, passing=Bypass(leeway(ranges, mission), detours=passing.detours))
    if passing.places:  # what it does after the way aside begins where that ends
        on_visit = isinstance(task, Travelling)
        state = state.doing(Travelling(visit.stop(state)) if on_visit else phase2_orbit.aligning(state))
        if drive.way_to(state, passing.places[0], backward=True) is None:
            passing = replace(passing, places=passing.places[1:])
            state = replace(state, passing=passing)
    before = [one for one in ranges if one < state.config.robot]
    after = passed(passing, ranges, before, state.odometry, drive.controls(state), mission)
    if after.detours > passing.detours and (passing.places or isinstance(task, Travelling)):
        after = replace(after, places=after.places[:2])  # its next task leads past the other robot
    return replace(state, passing=after)


def limited(controls: Controls, passing: Bypass, mission: Mission) -> Controls:
    """Return `controls`, shortened to the way that is left less the reserve; on a way aside, to all of it."""
    allowed = separation.SHARE_OF_EACH * separation.largest_error(mission)
    reserve = 0.0 if passing.places else max(0.0, RESERVE * mission.first_straight - allowed)
    return separation.slowed(controls, max(0.0, passing.leeway - reserve), mission)


def leeway(ranges: Mapping[str, float | None], mission: Mission) -> float:
    """Return how far in m a robot may drive in the next tick for the robots at these `ranges`."""
    free = [0.0 if rho is None else separation.leeway_of_each(rho, mission) for rho in ranges.values()]
    return min(free, default=math.inf)


def passed(
    passing: Bypass,
    ranges: Mapping[str, float | None],
    before: Collection[str],
    here: Pose,
    controls: Controls,
    mission: Mission,
) -> Bypass:
    """Return `passing` after a tick that led `here`, at `ranges` (m) from others.

    `controls` are the next ones. While little way is left but grows, one of two robots drives away from the
    other, and none is blocked. A blocked robot drives aside, but stands still first for those that come
    `before` it.
    """
    free = leeway(ranges, mission)
    blocked = passing.blocked + (free <= passing.leeway) if separation.is_tight(free, mission) else 0
    yielded = passing.yielded if math.isfinite(free) else 0
    if blocked < (BLOCKED_ASIDE_AFTER if passing.places else BLOCKED_AFTER) or controls.v == 0.0:
        return replace(passing, leeway=free, blocked=blocked, yielded=yielded)
    waits = separation.is_tight(leeway({one: ranges[one] for one in before}, mission), mission)
    if waits and yielded < MOST_YIELDED:
        return replace(passing, leeway=0.0, blocked=blocked, yielded=yielded + 1)
    course = here if controls.v > 0.0 else compose(here, Pose(0.0, 0.0, math.pi))
    places = aside(course, mission, 1.0 if passing.detours % 2 == 0 else -1.0)
    return Bypass(free, detours=passing.detours + 1, places=places)


def aside(course: Pose, mission: Mission, side: float) -> tuple[Place, ...]:
    """Return the way aside of a robot that is blocked on its `course`: back, to one `side`, and past."""
    clearance = CLEARANCE * mission.sensing_range
    back, beside = mission.safety_distance + clearance, 2.0 * mission.safety_distance + clearance
    ways = (-back, 0.0), (-back, side * beside), (beside, side * beside)
    return transformed(course, ways)
