"""The transitions of a localised robot that looks for robots without an anchor, and stops where it finds one.

All functions are pure. `GroupPlanner` calls them.
"""

from __future__ import annotations

from msgspec.structs import replace

from agent.planning import sweep
from agent.planning.group_state import GroupState
from agent.planning.sweep import LOOPS_FOR, Looping, Sweeping
from protocol.messages import RobotConfigWithSweep
from protocol.motion import Pose, compose, inverse
from protocol.sweep_strips import NEAR


def wanted(state: GroupState) -> bool:
    """Return whether there are robots without an anchor that this robot can still help."""
    return any(is_helped(state, robot) for robot in _unanchored(state))


def is_helped(state: GroupState, robot: str) -> bool:
    """Return whether `robot` has no anchor, and still needs the poses of this robot, as far as it knows."""
    known = state.other(robot)
    return robot in _unanchored(state) and not (known.localised or known.served)


def _unanchored(state: GroupState) -> tuple[str, ...]:
    config = state.config
    return config.unanchored if isinstance(config, RobotConfigWithSweep) else ()


def next_part(state: GroupState) -> GroupState:
    """Return `state` of a localised robot that sweeps the next part of the area, its own one first.

    It stops again for robots that it has left before.
    """
    config = state.config
    assert isinstance(config, RobotConfigWithSweep)
    for robot in config.unanchored:
        state = state.with_other(robot, replace(state.other(robot), failed=False))
    part = (config.part + state.parts) % config.sweep.parts
    into = inverse(state.frame)
    ends = [compose(into, Pose(x, y, 0.0)) for x, y in config.sweep.path(part, config.mission.sensing_range)]
    mode = Sweeping(tuple([(end.x, end.y) for end in ends]))
    return replace(
        state,
        pair=replace(state.pair, mode=mode),
        parts=state.parts + 1,
        swept=state.pair.tick,
        visiting=False,
        unmet=0,
        silence=0,
    )


def onward(state: GroupState) -> GroupState | None:
    """Return `state` after a tick of a sweep; None at its end.

    Near robots without an anchor, it drives squares until they are localised or LOOPS_FOR ticks are over, and
    then returns to where it has left its strip.
    """
    pair, mission = state.pair, state.config.mission
    mode, tolerance = pair.mode, pair.estimator.pose_tolerance
    assert isinstance(mode, Sweeping | Looping)
    mode = sweep.onward(mode, pair.odometry, mission, tolerance)
    found = [one for one in _unanchored(state) if is_helped(state, one) and _is_near(state, one)]
    if isinstance(mode, Looping) and pair.tick - mode.since > LOOPS_FOR:
        for robot in found:
            state = state.with_other(robot, replace(state.other(robot), failed=True))
        found = []
    match mode:
        case Sweeping(places) if found:
            here = (pair.odometry.x, pair.odometry.y)
            mode = sweep.looping(pair.odometry, mission, pair.tick, then=(here, *places))
        case Looping((), then, since) if found:
            mode = sweep.looping(pair.odometry, mission, since, then)
        case Looping(_, then) if not found:
            mode = sweep.onward(Sweeping(then), pair.odometry, mission, tolerance)
    if isinstance(mode, Sweeping) and not mode.places:
        return None
    return replace(state, pair=replace(pair, mode=mode))


def _is_near(state: GroupState, robot: str) -> bool:
    """Return whether this robot is near enough to `robot` to drive a square, or drives one already."""
    known, pair = state.other(robot), state.pair
    if known.failed or not known.mutual or known.mutual[-1].tick != pair.tick:
        return False
    return (
        isinstance(pair.mode, Looping) or known.mutual[-1].range <= NEAR * state.config.mission.sensing_range
    )
