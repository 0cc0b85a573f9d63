"""The way of a robot to another one: to the anchor beside which that one waits, and past all others.

If the robot that it visits is not in range at the end of the way, a visitor searches across it.

The way past those that it does not meet follows from ranges alone, and keeps the safety distance. In each
tick, a robot drives at most half of the way that is left to the safety distance, in any direction. Two robots
that both do so keep it. On its way to another robot, or to its orbit and on it, a robot may then be blocked
by another one, which stands there or is blocked itself: it drives back, then aside, and on.

A blocked robot waits only for those with a smaller id, so of robots that block each other the one with the
smallest id never waits. The others wait for a few ticks at most: that one may not be on its way.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from msgspec.structs import replace

from agent.planning import drive, phase2_orbit, separation
from agent.planning.drive import way_to
from agent.planning.state import Bypass, RobotState
from agent.planning.tasks import Homing, Measuring, Orbiting, Travelling, drives_aside, transformed
from protocol.coverage_strips import Place
from protocol.messages import Contact
from protocol.mission import Mission
from protocol.motion import Controls, Pose, compose, inverse
from protocol.orbits import SEARCH_SIDES, SHORT_OF_ANCHOR, leg_end, search_legs

# --- the way of a visitor ---

SEARCHED_SIGMAS = 4.0
"""The sigmas of the heading at the claim that a visitor's search allows for."""

MOST_SIDES = 8
"""The most sides of a search. They reach 14 R to either side, and are 128 R long."""


def searching(state: RobotState) -> RobotState:
    """Return `state` of a visitor out of range; if it has arrived, on the next leg of its search."""
    assert isinstance(state.task, Travelling)
    if way_to(state, state.task.place) is not None:
        return state
    begin, anchor = state.framed_at, _peer_anchor(state)
    leg = next_leg(state.task, (begin.x, begin.y), (anchor.x, anchor.y), state.config.mission)
    return state.doing(leg)


def next_leg(
    task: Travelling, begin: tuple[float, float], anchor: tuple[float, float], mission: Mission
) -> Travelling:
    """Return the leg after `task` of the search for a robot that waits beside `anchor` (see `leg_end`).

    The robot knew its pose at `begin`. An error of its heading there turns the way about that place. So the
    legs end on the arc about it that leads through the anchor. Both places are in m in the frame of the
    odometry, in which the anchor is where it would be without that error.
    """
    leg, (dx, dy) = task.leg + 1, (anchor[0] - begin[0], anchor[1] - begin[1])
    radius, aside = math.hypot(dx, dy), leg_end(leg) * mission.sensing_range
    turned = min(max(aside / radius, -math.pi), math.pi) if radius else 0.0
    bearing = math.atan2(dy, dx) + turned
    return Travelling((begin[0] + radius * math.cos(bearing), begin[1] + radius * math.sin(bearing)), leg)


def has_searched(state: RobotState) -> bool:
    """Return whether the robot has searched for its peer in vain."""
    task = state.task
    return isinstance(task, Travelling) and task.leg > 0 and task.leg > search_legs(_search_sides(state))


def _search_sides(state: RobotState) -> int:
    """Return the number of sides of the search for the peer: with an inaccurate heading, more are necessary.

    They reach SEARCHED_SIGMAS of the error that the heading at the claim has led to, to either side.
    """
    assert state.fix is not None
    if state.fix.claim.covariance is None:
        return 0
    begin, anchor = state.framed_at, _peer_anchor(state)
    sigma = state.fix.claim.covariance.heading_sigma
    aside = SEARCHED_SIGMAS * sigma * math.hypot(anchor.x - begin.x, anchor.y - begin.y)
    needed = 1 + math.ceil(0.5 * aside / state.config.mission.sensing_range)
    return min(max(SEARCH_SIDES, needed), MOST_SIDES)


def _peer_anchor(state: RobotState) -> Pose:
    """Return the place of the peer's anchor, in m in the odometry's frame."""
    peer_anchor = state.config.peer_anchor
    return compose(inverse(state.frame), Pose(peer_anchor.x, peer_anchor.y, 0.0))


def stop(state: RobotState) -> tuple[float, float]:
    """Return the place of a visit, in m in the odometry's frame: on the way to the anchor, short of it."""
    anchor = _peer_anchor(state)
    dx, dy = anchor.x - state.odometry.x, anchor.y - state.odometry.y
    distance = math.hypot(dx, dy)
    short = SHORT_OF_ANCHOR * state.config.mission.sensing_range
    share = 1.0 - short / distance if distance > short else 0.0
    return state.odometry.x + share * dx, state.odometry.y + share * dy


# --- past those that it does not meet ---

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
    is_aside = drives_aside(task) and not (isinstance(task, Orbiting) and state.config.orbit.v == 0.0)
    seeks = is_aside and isinstance(task, Measuring | Homing)  # it does not plan with the place of its peer
    met = state.config.peer if state.in_contact and not seeks else None
    ranges = {one.peer: one.range for one in contacts if one.peer != met}
    if not is_aside:
        return replace(state, passing=Bypass(leeway(ranges, mission), detours=passing.detours))
    if passing.places:  # what it does after the way aside begins where that ends
        if isinstance(task, Travelling):
            state = state.doing(Travelling(stop(state)))
        elif not seeks:
            state = state.doing(phase2_orbit.aligning(state))
        if way_to(state, passing.places[0], backward=True) is None:
            passing = replace(passing, places=passing.places[1:])
            state = replace(state, passing=passing)
    before = [one for one in ranges if one < state.config.robot]
    after = passed(passing, ranges, before, state.odometry, drive.controls(state), mission)
    if after.detours > passing.detours and (passing.places or seeks or isinstance(task, Travelling)):
        after = replace(after, places=after.places[:2])  # its next task leads past the other robot
    return replace(state, passing=after)


def limited(controls: Controls, passing: Bypass, mission: Mission) -> Controls:
    """Return `controls`, shortened to the way that is left less the reserve; on a way aside, to all of it."""
    allowed = separation.SHARE_OF_EACH * separation.largest_error(mission)
    reserve = 0.0 if passing.places else max(0.0, RESERVE * mission.first_straight - allowed)
    return separation.slowed(controls, max(0.0, passing.leeway - reserve), mission)


def leeway(ranges: Mapping[str, float | None], mission: Mission, *, aside: bool = False) -> float:
    """Return how far in m a robot may drive in a tick, or `aside`, for the robots at these `ranges`."""
    known = [0.0 if rho is None else rho for rho in ranges.values()]
    return min([separation.leeway_of_each(rho, mission, aside=aside) for rho in known], default=math.inf)


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
    free = leeway(ranges, mission, aside=bool(passing.places))
    blocked = passing.blocked + (free <= passing.leeway) if separation.is_tight(free, mission) else 0
    yielded = passing.yielded if math.isfinite(free) else 0
    if blocked < (BLOCKED_ASIDE_AFTER if passing.places else BLOCKED_AFTER) or controls.v == 0.0:
        return replace(passing, leeway=free, blocked=blocked, yielded=yielded)
    waits = separation.is_tight(leeway({one: ranges[one] for one in before}, mission), mission)
    if waits and yielded < MOST_YIELDED:
        return replace(passing, leeway=0.0, blocked=blocked, yielded=yielded + 1)
    course = here if controls.v > 0.0 else compose(here, Pose(0.0, 0.0, math.pi))
    places = aside(course, mission, 1.0 if passing.detours % 2 == 0 else -1.0)
    return Bypass(leeway(ranges, mission, aside=True), detours=passing.detours + 1, places=places)


def aside(course: Pose, mission: Mission, side: float) -> tuple[Place, ...]:
    """Return the way aside of a robot that is blocked on its `course`: back, to one `side`, and past."""
    clearance = CLEARANCE * mission.sensing_range
    back, beside = mission.safety_distance + clearance, 2.0 * mission.safety_distance + clearance
    ways = (-back, 0.0), (-back, side * beside), (beside, side * beside)
    return transformed(course, ways)
