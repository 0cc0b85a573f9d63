"""The way of a visitor: to the anchor of the robot that it visits, its search there, and past other robots.

Robots of other meetings are passed at the safety distance, by ranges alone. In each tick, a robot drives at
most half of the way that is left to the safety distance, in any direction. Two robots that both do so keep
it. A robot on a straight way may then be blocked by one that stands there: it drives back, then aside, and
straight on from there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec.structs import replace

from agent.planning import separation
from agent.planning.agenda import Bypass
from agent.planning.drive import way_to
from agent.planning.state import RobotState
from agent.planning.tasks import Travelling
from protocol.messages import Contact
from protocol.mission import Mission
from protocol.motion import Pose, compose, inverse
from protocol.orbits import SEARCH_SIDES, SHORT_OF_ANCHOR, leg_end, search_legs

SEARCHED_SIGMAS = 4.0
"""The sigmas of the heading at the claim that a visitor's search allows for."""

MOST_SIDES = 8
"""The most sides of a search. They reach 14 R to either side, and are 128 R long."""

BLOCKED = 0.1
"""The way that is left in a tick, as a fraction of A_0, below which a robot may be blocked."""

BLOCKED_AFTER = 4
"""The ticks with so little way after which it drives aside. One that drives away has more way by then."""

CLEARANCE = 0.25
"""The distance by which a way aside is longer than needed, and at which robots yield, as a fraction of R."""

YIELDS = 60
"""The ticks after which a robot does not yield any longer, because the other one does not drive away."""


def searching(state: RobotState) -> RobotState:
    """Return `state` of a visitor out of range; if it has arrived, on the next leg of its search."""
    assert isinstance(state.task, Travelling)
    if way_to(state, state.task.place) is not None:
        return state
    begin, anchor = state.agenda.framed_at, _peer_anchor(state)
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
    assert state.agenda.fix is not None
    if state.agenda.fix.claim.covariance is None:
        return 0
    begin, anchor = state.agenda.framed_at, _peer_anchor(state)
    sigma = state.agenda.fix.claim.covariance.heading_sigma
    aside = SEARCHED_SIGMAS * sigma * math.hypot(anchor.x - begin.x, anchor.y - begin.y)
    needed = 1 + math.ceil(0.5 * aside / state.config.mission.sensing_range)
    return min(max(SEARCH_SIDES, needed), MOST_SIDES)


def _peer_anchor(state: RobotState) -> Pose:
    """Return the place of the peer's anchor, in m in the odometry's frame."""
    peer_anchor = state.config.peer_anchor
    return compose(inverse(state.agenda.frame), Pose(peer_anchor.x, peer_anchor.y, 0.0))


def stop(state: RobotState) -> tuple[float, float]:
    """Return the place of a visit, in m in the odometry's frame: on the way to the anchor, short of it."""
    anchor = _peer_anchor(state)
    dx, dy = anchor.x - state.odometry.x, anchor.y - state.odometry.y
    distance = math.hypot(dx, dy)
    short = SHORT_OF_ANCHOR * state.config.mission.sensing_range
    share = 1.0 - short / distance if distance > short else 0.0
    return state.odometry.x + share * dx, state.odometry.y + share * dy


# --- past robots of other meetings ---


def passing_others(state: RobotState, contacts: Sequence[Contact]) -> RobotState:
    """Return `state` on its way past the robots in contact that it does not meet, after a tick."""
    task, passing, mission = state.task, state.agenda.passing, state.config.mission
    if not mission.safety_distance:
        return state
    free = leeway(contacts, state.config.peer if state.in_contact else None, mission)
    if isinstance(task, Travelling) and yielding(passing, _leading(state, contacts), mission):
        yielded = passing.yielded + 1
        return state.with_agenda(passing=replace(passing, leeway=0.0, blocked=0, yielded=yielded))
    now = passed(passing, task, state.odometry, free, mission)
    if isinstance(task, Travelling) and (now.places or passing.places):
        places = now.places
        if places and way_to(state, places[0]) is None:
            places = places[1:]
        now = replace(now, places=places)
        task = Travelling(places[0] if places else stop(state))
    return state.doing(task).with_agenda(passing=now)


def _leading(state: RobotState, contacts: Sequence[Contact]) -> list[Contact]:
    """Return those of `contacts` that travel, too, and go first: those with smaller ids."""
    own = state.config.robot
    return [one for one in contacts if one.peer < own and state.other(one.peer).travels]


def leeway(contacts: Sequence[Contact], peer: str | None, mission: Mission) -> float:
    """Return how far in m a robot may drive in the next tick, for all robots in contact but its `peer`.

    `peer` is None if it does not go on with the meeting: then the robot passes it like any other.
    """
    free = [
        0.0 if one.range is None else separation.leeway_of_each(one.range, mission)
        for one in contacts
        if one.peer != peer
    ]
    return min(free, default=math.inf)


def yielding(passing: Bypass, leading: Sequence[Contact], mission: Mission) -> bool:
    """Return whether a robot stands still, because one of the robots in `leading`, which go first, is near.

    It does so for YIELDS ticks at most.
    """
    near = CLEARANCE * mission.sensing_range
    close = any(one.range is None or separation.leeway(one.range, mission) < near for one in leading)
    return close and passing.yielded < YIELDS


def passed(passing: Bypass, task: object, odometry: Pose, free: float, mission: Mission) -> Bypass:
    """Return `passing` after a tick that led to `odometry` in `task`, where `free` m may be driven next."""
    if not isinstance(task, Travelling):
        return Bypass(free, detours=passing.detours)
    blocked = passing.blocked + 1 if free < BLOCKED * mission.first_straight else 0
    passing = replace(
        passing, leeway=free, blocked=blocked, yielded=passing.yielded if math.isfinite(free) else 0
    )
    if passing.places or blocked < BLOCKED_AFTER:
        return passing
    places = _aside(odometry, task.place, mission, 1.0 if passing.detours % 2 == 0 else -1.0)
    return Bypass(free, detours=passing.detours + 1, places=places)


def _aside(
    here: Pose, place: tuple[float, float], mission: Mission, side: float
) -> tuple[tuple[float, float], ...]:
    """Return the way aside of a robot that is blocked on its way to `place`: back, then to one `side`."""
    dx, dy = place[0] - here.x, place[1] - here.y
    distance = math.hypot(dx, dy)
    ux, uy = (dx / distance, dy / distance) if distance else (math.cos(here.heading), math.sin(here.heading))
    clearance = CLEARANCE * mission.sensing_range
    back, aside = mission.safety_distance + clearance, 2.0 * mission.safety_distance + clearance
    x, y = here.x - back * ux, here.y - back * uy
    return (x, y), (x - side * aside * uy, y + side * aside * ux)
