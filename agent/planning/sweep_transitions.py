"""The transitions of a localised robot that looks for robots without an anchor, and stops where it finds one.

All functions are pure. `GroupPlanner` calls them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from msgspec.structs import replace

from agent.planning import sweep
from agent.planning.state import RobotState
from agent.planning.sweep import LOOPS_FOR, Looping, Sweeping
from protocol.motion import inverse
from protocol.sweep_strips import STRIP_REACH, Place


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
        state = state.with_other(robot, replace(state.other(robot), failed=False))
    part = (config.part + state.parts) % config.sweep.parts
    path = config.sweep.path(part, config.mission.sensing_range)
    mode = Sweeping(sweep.transformed(inverse(state.frame), path))
    return replace(
        state,
        mode=mode,
        parts=state.parts + 1,
        part_tick=state.tick,
        visiting=False,
        unmet=0,
        silence=0,
    )


def onward(state: RobotState) -> RobotState | None:
    """Return `state` after a tick of a sweep with exact sensors; None at its end.

    Near robots without an anchor, it drives squares until they are localised or LOOPS_FOR ticks are over.
    """
    mission, odometry = state.config.mission, state.odometry
    helped = [one for one in state.config.unanchored if is_helped(state, one) and _is_near(state, one)]
    moved = moved_on(
        state,
        helped,
        lambda since, then: sweep.looping(odometry, mission, since, then),
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
    assert isinstance(state.mode, Sweeping | Looping)
    mode = sweep.onward(state.mode, state.odometry, mission, tolerance)
    if isinstance(mode, Looping) and state.tick - mode.since > longest:
        for robot in helped:
            state = state.with_other(robot, replace(state.other(robot), failed=True))
        helped = []
    match mode:
        case Sweeping(places) if stops:
            mode = loop(state.tick, ((state.odometry.x, state.odometry.y), *places))
        case Looping((), then, since) if helped:
            mode = loop(since, then)
        case Looping(_, then) if not helped:
            mode = sweep.onward(Sweeping(then), state.odometry, mission, tolerance)
    return replace(state, mode=mode)


def is_over(state: RobotState) -> bool:
    """Return whether the robot has driven along all strips of its part."""
    return isinstance(state.mode, Sweeping) and not state.mode.places


def _is_near(state: RobotState, robot: str) -> bool:
    """Return whether this robot is near enough to `robot` to drive a square, or drives one already."""
    other = state.other(robot)
    if other.failed or not other.mutual or other.mutual[-1].tick != state.tick:
        return False
    return (
        isinstance(state.mode, Looping)
        or other.mutual[-1].range <= STRIP_REACH * state.config.mission.sensing_range
    )
