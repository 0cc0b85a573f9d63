"""The ways of a sweep of an area, and the loops of a robot that stops for one without an anchor."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from msgspec.structs import replace

from agent.planning.drive import way_to
from agent.planning.state import RobotState
from agent.planning.tasks import Looping, Sweeping, transformed
from protocol.motion import inverse
from protocol.sweep_strips import SIDE, Place


def looping(state: RobotState, since: int, then: tuple[Place, ...] = ()) -> Looping:
    """Return a square that begins ahead of the robot and goes to the left, with these `since` and `then`."""
    side, odometry = SIDE * state.config.mission.sensing_range, state.odometry
    x, y = side * math.cos(odometry.heading), side * math.sin(odometry.heading)
    corners = [(0.0, 0.0), (x, y), (x - y, y + x), (-y, x)]
    places = [(odometry.x + dx, odometry.y + dy) for dx, dy in corners]
    return Looping((*places[1:], places[0]), then, since)


def looping_both_ways(
    state: RobotState, along: float, aside: float, since: int, then: tuple[Place, ...] = ()
) -> Looping:
    """Return a rectangle behind the robot, to its left, and then the same to its right.

    Its sides are `along` and `aside`, in m. In both together, the robot turns as much to the left as to the
    right, so an error of the scale of its gyro does not add up.
    """
    corners = [
        (x, side * aside * y)
        for side in (1.0, -1.0)
        for x, y in ((0.0, 1.0), (-along, 1.0), (-along, 0.0), (0.0, 0.0))
    ]
    return Looping(transformed(state.odometry, corners), then, since)


def onward(state: RobotState, task: Sweeping | Looping) -> Sweeping | Looping:
    """Return `task` without the places at which the robot has arrived."""
    while task.places and way_to(state, task.places[0]) is None:
        task = replace(task, places=task.places[1:])
    return task


def reports_covariance(state: RobotState) -> bool:
    """Return whether robots without an anchor need the covariance of a pose that is reported to them."""
    return bool(state.config.unanchored) and state.estimator.corrects_poses


def shares(state: RobotState) -> bool:
    """Return whether robots that were found search with those that have found them.

    With noisy sensors they cannot, because they have no anchor and no beacon that correct their odometry. If
    robots may report false data, their poses are not independent of those that have found them.
    """
    return not (reports_covariance(state) or state.config.tolerates)


def strips(state: RobotState) -> tuple[int, int] | None:
    """Return the strips that the robot has not begun to sweep, as Report.strips has them."""
    match state.task:
        case Sweeping(places):
            left = len(places)
        case Looping(_, then):
            left = len(then) - 1  # the first one is where it has left its strip
        case _:
            return None
    end = state.agenda.strips_end
    return None if end is None else (end - left // 2, end)


def without_strips(state: RobotState, others: tuple[int, int] | None) -> RobotState:
    """Return `state` without the last strips of its sweep, if these are those that another robot sweeps."""
    own = strips(state)
    if own is None or others is None or not own[0] < others[0] < others[1] == own[1]:
        return state
    most, task = -2 * (others[1] - others[0]), state.task
    match task:
        case Sweeping(places):
            task = Sweeping(places[:most])
        case Looping(_, then):
            task = replace(task, then=then[:most])
    return state.doing(task).with_agenda(strips_end=others[0])


def second_half(state: RobotState, others: tuple[int, int]) -> RobotState:
    """Return `state` of a robot that sweeps the second half of the strips of another one, which it is beside.

    It stands still until that one has heard it. Its way to them is at most R longer than that one's. Strips
    that the area does not have change nothing.
    """
    begin, end = others
    first = begin + (end - begin + 1) // 2
    area, reach = state.config.sweep, state.config.mission.sensing_range
    assert area is not None
    if not begin < end <= area.strips(reach):
        return state
    part = area.part_of(begin, reach)
    if first == end:  # it begins with the next part
        return replace(state, config=replace(state.config, part=part + 1))
    state = along(replace(state, config=replace(state.config, part=part)), (first, end))
    assert isinstance(state.task, Sweeping)
    here = (state.odometry.x, state.odometry.y)
    return state.doing(Looping((), (here, *state.task.places), state.tick))


def along(state: RobotState, chosen: tuple[int, int]) -> RobotState:
    """Return `state` at the begin of a sweep of the strips `chosen`."""
    config, agenda = state.config, state.agenda
    assert config.sweep is not None
    path = config.sweep.path(chosen, config.mission.sensing_range)
    state = state.with_agenda(parts=agenda.parts + 1, strips_end=chosen[1] if shares(state) else None)
    return state.doing(Sweeping(transformed(inverse(agenda.frame), path)))


def moved_on(
    state: RobotState,
    helped: Sequence[str],
    loop: Callable[[int, tuple[Place, ...]], Looping],
    *,
    stops: bool,
    longest: int,
) -> RobotState:
    """Return `state` after a tick of a sweep, in which the robots `helped` without an anchor are in contact.

    If it `stops` for them, it leaves its strip and drives a `loop`, of which it gives the first tick and the
    places that are left of the sweep. It repeats the loop until nobody is in contact any more, or for
    `longest` ticks, and then returns to where it has left its strip.
    """
    assert isinstance(state.task, Sweeping | Looping)
    task = onward(state, state.task)
    if isinstance(task, Looping) and state.tick - task.since > longest:
        for robot in helped:
            state = state.with_other(robot, failed=True)
        helped = []
    match task:
        case Sweeping(places) if stops:
            task = loop(state.tick, ((state.odometry.x, state.odometry.y), *places))
        case Looping((), then, since) if helped:
            task = loop(since, then)
        case Looping(_, then) if not helped:
            task = onward(state, Sweeping(then))
    return state.doing(task)


def is_over(state: RobotState) -> bool:
    """Return whether the robot has driven along all strips of its part."""
    return isinstance(state.task, Sweeping) and not state.task.places
