"""The way of a robot of a group past robots of other meetings, at the safety distance, by ranges alone.

In each tick, it drives at most half of the way that is left to the safety distance, in any direction. Two
robots that both do so keep it. A robot on a straight way may then be blocked by one that stands there: it
drives back, then aside, and straight on from there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from agent.planning import separation
from agent.planning.tasks import Travelling
from protocol.messages import Contact
from protocol.mission import Mission
from protocol.motion import Pose

BLOCKED = 0.1
"""The way that is left in a tick, as a fraction of A_0, below which a robot may be blocked."""

BLOCKED_AFTER = 4
"""The ticks with so little way after which it drives aside. One that drives away has more way by then."""

CLEARANCE = 0.25
"""The distance by which a way aside is longer than needed, and at which robots yield, as a fraction of R."""

YIELDS = 60
"""The ticks after which a robot does not yield any longer, because the other one does not drive away."""


class Bypass(msgspec.Struct, frozen=True):
    """The passing of robots of other meetings."""

    leeway: float = math.inf
    """The length in m that the robot may drive in the next tick."""
    blocked: int = 0
    """The number of consecutive ticks in which it has hardly moved on its way."""
    yielded: int = 0
    """The number of consecutive ticks in which it has stood still, to let another one go first."""
    detours: int = 0
    """The number of times that it has driven aside."""
    places: tuple[tuple[float, float], ...] = ()
    """The ends of the straights of the way aside, in m in the frame of the odometry."""


def leeway(contacts: Sequence[Contact], peer: str | None, mission: Mission) -> float:
    """Return how far in m a robot may drive in the next tick, for all robots in contact but its `peer`.

    `peer` is None if it does not go on with the meeting: then the robot passes it like any other.
    """
    free = [
        0.0 if one.range is None else separation.SHARE_OF_EACH * separation.leeway(one.range, mission)
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
