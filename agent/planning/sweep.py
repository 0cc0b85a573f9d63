"""The sweep of an area, in which a localised robot looks for robots without an anchor, and stops for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from msgspec.structs import replace

from agent.planning import exchange
from agent.planning.drive import towards
from agent.planning.state import RobotState
from agent.planning.tasks import Looping, Sweeping
from protocol.messages import Localised, Report, ReportedPose
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
        task = replace(task, places=task.places[1:])
    return task


def wanted(state: RobotState) -> bool:
    """Return whether there are robots without an anchor that this robot can still help."""
    return any(is_helped(state, robot) for robot in state.config.unanchored)


def is_helped(state: RobotState, robot: str) -> bool:
    """Return whether `robot` has no anchor, and still needs the poses of this robot, as far as it knows."""
    other = state.other(robot)
    finished = other.localised or other.served or robot == state.config.robot
    return robot in state.config.unanchored and not finished


def outside_meeting(state: RobotState, peer: str) -> Report:
    """Return the report to `peer` outside a meeting: this robot's verdict, and the strips that it sweeps.

    A robot without an anchor gets the pose of a localised one until it has determined its own by it.
    """
    agenda, pose = state.agenda, None
    if is_helped(state, peer) and isinstance(agenda.robot_verdict, Localised):
        pose = ReportedPose(state.tick, exchange.reported_pose(state, agenda.frame))
    return replace(exchange.report_without_log(state, agenda.robot_verdict), prior=pose, strips=strips(state))


def strips(state: RobotState) -> tuple[int, int] | None:
    """Return the strips that the robot still sweeps, as Report.strips has them."""
    match state.task:
        case Sweeping(places):
            left = len(places)
        case Looping(_, then):
            left = len(then) - 1  # the first one is where it has left its strip
        case _:
            return None
    end = state.agenda.strips_end
    return None if end is None else (end - (left + 1) // 2, end)


def without_strips(state: RobotState, others: tuple[int, int] | None) -> RobotState:
    """Return `state` without the last strips of its sweep, if these are those that another robot sweeps."""
    own = strips(state)
    if own is None or others is None or own[1] != others[1] or own[0] >= others[0]:
        return state
    most, task = -2 * (others[1] - others[0]), state.task
    match task:
        case Sweeping(places):
            task = Sweeping(places[:most])
        case Looping(_, then):
            task = replace(task, then=then[:most])
    return state.doing(task).with_agenda(strips_end=others[0])


def next_part(state: RobotState) -> RobotState:
    """Return `state` of a localised robot that sweeps the next part of the area, its own one first.

    It stops again for robots that it has left before.
    """
    config = state.config
    assert config.sweep is not None
    for robot in config.unanchored:
        state = state.with_other(robot, failed=False)
    part = (config.part + state.agenda.parts) % config.sweep.parts
    state = _along(state, config.sweep.strips_of(part, config.mission.sensing_range))
    return state.with_agenda(part_tick=state.tick, visiting=False, unmet=0, silence=0)


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
    state = _along(replace(state, config=replace(state.config, part=part)), (first, end))
    assert isinstance(state.task, Sweeping)
    here = (state.odometry.x, state.odometry.y)
    return state.doing(Looping((), (here, *state.task.places), state.tick))


def _along(state: RobotState, along: tuple[int, int]) -> RobotState:
    """Return `state` at the begin of a sweep of the strips `along`."""
    config, agenda = state.config, state.agenda
    assert config.sweep is not None
    path = config.sweep.path(along, config.mission.sensing_range)
    shares = not (state.estimator.corrects_poses or config.tolerates)
    state = state.with_agenda(parts=agenda.parts + 1, strips_end=along[1] if shares else None)
    return state.doing(Sweeping(transformed(inverse(agenda.frame), path)))


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
