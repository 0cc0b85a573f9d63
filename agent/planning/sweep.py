"""The sweep of an area, in which a localised robot looks for robots without an anchor, and stops for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import msgspec

from agent.planning.drive import towards
from agent.planning.state import RobotState
from agent.planning.tasks import Looping, Sweeping
from protocol.mission import Mission
from protocol.motion import Pose, compose, inverse
from protocol.sweep_strips import SIDE, STRIP_REACH, Place

LOOPS_FOR = 200
"""The ticks after which robots stop driving squares that have localised nobody: the other one may be dead."""


def transformed(transform: Pose, places: Iterable[Place]) -> tuple[Place, ...]:
    """Return `places`, in m, in the frame in which their own frame has the pose `transform`."""
    moved = [compose(transform, Pose(x, y, 0.0)) for x, y in places]
    return tuple([(one.x, one.y) for one in moved])


def looping(odometry: Pose, mission: Mission, since: int, then: tuple[Place, ...] = ()) -> Looping:
    """Return a square that begins ahead of `odometry` and goes to the left, with these `since` and `then`."""
    side = SIDE * mission.sensing_range
    x, y = side * math.cos(odometry.heading), side * math.sin(odometry.heading)
    corners = [(0.0, 0.0), (x, y), (x - y, y + x), (-y, x)]
    places = [(odometry.x + dx, odometry.y + dy) for dx, dy in corners]
    return Looping((*places[1:], places[0]), then, since)


def looping_both_ways(
    odometry: Pose, along: float, aside: float, since: int, then: tuple[Place, ...] = ()
) -> Looping:
    """Return a rectangle behind `odometry`, to its left, and then the same to its right.

    Its sides are `along` and `aside`, in m. In both together, the robot turns as much to the left as to the
    right, so an error of the scale of its gyro does not add up.
    """
    corners = [
        (x, side * aside * y)
        for side in (1.0, -1.0)
        for x, y in ((0.0, 1.0), (-along, 1.0), (-along, 0.0), (0.0, 0.0))
    ]
    return Looping(transformed(odometry, corners), then, since)


def onward(
    task: Sweeping | Looping, odometry: Pose, mission: Mission, tolerance: float
) -> Sweeping | Looping:
    """Return `task` without the places at which the robot has arrived."""
    while task.places and towards(task.places[0], odometry, mission, tolerance) is None:
        task = msgspec.structs.replace(task, places=task.places[1:])
    return task


def wanted(state: RobotState) -> bool:
    """Return whether there are robots without an anchor that this robot can still help."""
    return any(is_helped(state, robot) for robot in state.config.unanchored)


def is_helped(state: RobotState, robot: str) -> bool:
    """Return whether `robot` has no anchor, and still needs the poses of this robot, as far as it knows."""
    other = state.other(robot)
    return robot in state.config.unanchored and not (other.localised or other.served)


def next_part(state: RobotState) -> RobotState:
    """Return `state` of a localised robot that sweeps the next part of the area, its own one first.

    It stops again for robots that it has left before.
    """
    config = state.config
    assert config.sweep is not None
    for robot in config.unanchored:
        state = state.with_other(robot, failed=False)
    part = (config.part + state.agenda.parts) % config.sweep.parts
    path = config.sweep.path(part, config.mission.sensing_range)
    task = Sweeping(transformed(inverse(state.agenda.frame), path))
    return state.doing(task).with_agenda(
        parts=state.agenda.parts + 1, part_tick=state.tick, visiting=False, unmet=0, silence=0
    )


def swept(state: RobotState) -> RobotState | None:
    """Return `state` after a tick of a sweep with exact sensors; None at its end.

    Near robots without an anchor, it drives squares until they are localised or LOOPS_FOR ticks are over.
    """
    mission, odometry = state.config.mission, state.odometry
    helped = [one for one in state.config.unanchored if is_helped(state, one) and _is_near(state, one)]
    moved = moved_on(
        state,
        helped,
        lambda since, then: looping(odometry, mission, since, then),
        stops=bool(helped),
        longest=LOOPS_FOR,
    )
    return None if is_over(moved) else moved


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
    mission, tolerance = state.config.mission, state.estimator.pose_tolerance
    assert isinstance(state.task, Sweeping | Looping)
    task = onward(state.task, state.odometry, mission, tolerance)
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
            task = onward(Sweeping(then), state.odometry, mission, tolerance)
    return state.doing(task)


def is_over(state: RobotState) -> bool:
    """Return whether the robot has driven along all strips of its part."""
    return isinstance(state.task, Sweeping) and not state.task.places


def _is_near(state: RobotState, robot: str) -> bool:
    """Return whether this robot is near enough to `robot` to drive a square, or drives one already."""
    other = state.other(robot)
    if other.failed or not other.mutual or other.mutual[-1].tick != state.tick:
        return False
    return (
        isinstance(state.task, Looping)
        or other.mutual[-1].range <= STRIP_REACH * state.config.mission.sensing_range
    )
