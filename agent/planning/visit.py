"""The way of a visitor: to the anchor of the robot that it visits, and its search there."""

from __future__ import annotations

import math

from agent.planning.drive import way_to
from agent.planning.state import RobotState
from agent.planning.tasks import Travelling
from protocol.mission import Mission
from protocol.motion import Pose, compose, inverse
from protocol.orbits import SEARCH_SIDES, SHORT_OF_ANCHOR, leg_end, search_legs

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
