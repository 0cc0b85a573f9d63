"""The coverage of an area by a robot that looks for others without an anchor, and its loops beside them.

With exact sensors, it knows its pose by dead reckoning, stops for all robots that are near, and leaves half
of its strips to those that it has found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

from msgspec.structs import replace

from agent.planning import exchange
from agent.planning.drive import way_to
from agent.planning.state import RobotState
from agent.planning.tasks import Covering, Looping, transformed
from protocol.coverage_strips import SIDE, STRIP_REACH, Place
from protocol.messages import Report, ReportedPose
from protocol.motion import inverse

LINGER = 10
"""The ticks without a range to robots without an anchor after which a contact with them is over."""

LOOPS_FOR = 200
"""The ticks after which robots stop driving squares that have localised nobody: the other one may be dead."""


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


def onward(state: RobotState, task: Covering | Looping) -> Covering | Looping:
    """Return `task` without the places at which the robot has arrived."""
    while task.places and way_to(state, task.places[0]) is None:
        task = replace(task, places=task.places[1:])
    return task


def strips(state: RobotState) -> tuple[int, int] | None:
    """Return the strips that the robot has not begun to cover, as Report.strips has them."""
    match state.task:
        case Covering(places):
            left = len(places)
        case Looping(_, then):
            left = len(then) - 1  # the first one is where it has left its strip
        case _:
            return None
    end = state.strips_end
    return None if end is None else (end - left // 2, end)


def without_strips(state: RobotState, others: tuple[int, int] | None) -> RobotState:
    """Return `state` without its last strips, if these are those that another robot covers."""
    own = strips(state)
    if own is None or others is None or not own[0] < others[0] < others[1] == own[1]:
        return state
    most, task = -2 * (others[1] - others[0]), state.task
    match task:
        case Covering(places):
            task = Covering(places[:most])
        case Looping(_, then):
            task = replace(task, then=then[:most])
    return replace(state, task=task, strips_end=others[0])


def second_half(state: RobotState, others: tuple[int, int]) -> RobotState:
    """Return `state` of a robot that covers the second half of the strips of another one, which it is beside.

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
    state = replace(state, parts=state.parts + 1, config=replace(state.config, part=part))
    state = along(state, (first, end))
    assert isinstance(state.task, Covering)
    here = (state.odometry.x, state.odometry.y)
    return state.doing(Looping((), (here, *state.task.places), state.tick))


def along(state: RobotState, chosen: tuple[int, int]) -> RobotState:
    """Return `state` at the begin of the coverage of the strips `chosen`."""
    config = state.config
    assert config.sweep is not None
    path = config.sweep.path(chosen, config.mission.sensing_range)
    task = Covering(transformed(inverse(state.frame), path))
    return replace(state, task=task, strips_end=None if config.tolerates else chosen[1])


def with_pose(state: RobotState, peer: str, report: Report) -> Report:
    """Return `report` with the present pose of the robot, which is the same for each `peer`."""
    del peer
    pose = exchange.reported_pose(state, state.frame)
    return replace(report, prior=ReportedPose(state.tick, pose))


def begun(state: RobotState, part: int) -> RobotState:
    """Return `state` at the begin of the coverage of a part of the area."""
    area = state.config.sweep
    assert area is not None
    return along(state, area.strips_of(part, state.config.mission.sensing_range))


def after_tick(state: RobotState, helped: Sequence[str]) -> RobotState:
    """Return `state` after a tick of the coverage, and stops for those of `helped` that are near."""
    near = [one for one in helped if _is_near(state, one)]
    return moved_on(state, near, partial(looping, state), stops=bool(near), longest=LOOPS_FOR)


def ticks_since(state: RobotState, robot: str) -> int:
    """Return the number of ticks since the latest range to `robot`; many if there is none."""
    ranges = state.ranges.get(robot)
    return state.tick - ranges[-1].tick if ranges else LINGER + 1


def _is_near(state: RobotState, robot: str) -> bool:
    """Return whether this robot is near enough to `robot` to drive a square, or drives one already."""
    near = STRIP_REACH * state.config.mission.sensing_range
    if ticks_since(state, robot) > 0:
        return False
    return isinstance(state.task, Looping) or state.ranges[robot][-1].range <= near


def moved_on(
    state: RobotState,
    helped: Sequence[str],
    loop: Callable[[int, tuple[Place, ...]], Looping],
    *,
    stops: bool,
    longest: int,
) -> RobotState:
    """Return `state` after a tick of the coverage; the robots `helped` without an anchor are in contact.

    If it `stops` for them, it leaves its strip and drives a `loop`, of which it gives the first tick and the
    places that are left of the coverage. It repeats the loop until nobody is in contact any more, or for
    `longest` ticks, and then returns to where it has left its strip.
    """
    assert isinstance(state.task, Covering | Looping)
    task = onward(state, state.task)
    if isinstance(task, Looping) and state.tick - task.since > longest:
        for robot in helped:
            state = state.with_other(robot, failed=True)
        helped = []
    match task:
        case Covering(places) if stops:
            task = loop(state.tick, ((state.odometry.x, state.odometry.y), *places))
        case Looping((), then, since) if helped:
            task = loop(since, then)
        case Looping(_, then) if not helped:
            task = onward(state, Covering(then))
    return state.doing(task)


def is_over(state: RobotState) -> bool:
    """Return whether the robot has driven along all strips of its part."""
    return isinstance(state.task, Covering) and not state.task.places
