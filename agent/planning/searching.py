"""A localised robot that looks for robots without an anchor: which part it covers, and what it tells them.

How it finds them depends on its sensors: see `coverage`, and `beacon_coverage` with noisy ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from agent.planning import beacon_coverage, coverage, exchange
from agent.planning.contacted import Contacted
from agent.planning.resected import Resected
from agent.planning.state import RobotState
from protocol.messages import Localised, Report


class CoverageSteps(NamedTuple):
    """The steps of the search for robots without an anchor that depend on the sensors: chosen once."""

    found: Resected | Contacted
    """The knowledge of a robot that is found, before it is."""
    with_pose: Callable[[RobotState, str, Report], Report]
    """The function that adds the robot's pose to its report to one without an anchor, if it may state it."""
    begun: Callable[[RobotState, int], RobotState]
    """The function that begins the coverage of a part of the area."""
    after_tick: Callable[[RobotState, Sequence[str]], RobotState]
    """The function that advances the coverage by a tick, with the robots that it may help."""
    beacon: Callable[[RobotState], str | None]
    """The function that returns the beacon of a robot that covers an area: its latest peer, or this robot.

    None if there is none."""


DEAD_RECKONED = CoverageSteps(
    Resected(), coverage.with_pose, coverage.begun, coverage.after_tick, lambda _: None
)
CORRECTED = CoverageSteps(
    Contacted(),
    beacon_coverage.with_pose,
    beacon_coverage.begun,
    beacon_coverage.after_tick,
    beacon_coverage.beacon,
)


def steps_of(state: RobotState) -> CoverageSteps:
    """Return the steps for the sensors of the mission."""
    return CORRECTED if state.estimator.corrects_poses else DEAD_RECKONED


def wanted(state: RobotState) -> bool:
    """Return whether there are robots without an anchor that this robot can still help."""
    return any(is_helped(state, robot) for robot in state.config.unanchored)


def is_helped(state: RobotState, robot: str) -> bool:
    """Return whether `robot` has no anchor, and still needs the poses of this robot, as far as it knows."""
    other = state.other(robot)
    finished = other.localised or other.served or robot == state.config.robot
    return robot in state.config.unanchored and not finished


def takes_part(state: RobotState) -> bool:
    """Return whether a robot without an anchor is localised, and looks for the others that have none.

    One whose odometry ranges have to correct does not: it has no anchor and no beacon. If robots may report
    false data, its pose is not independent of those that have found it.
    """
    shares = not (state.estimator.corrects_poses or state.config.tolerates)
    return shares and isinstance(state.robot_verdict, Localised)


def beacon(state: RobotState) -> str | None:
    """Return the robot that stays where it is for one that covers an area: the peer, this robot, or None."""
    return steps_of(state).beacon(state)


def is_apart(state: RobotState) -> bool:
    """Return whether the robot is in no meeting any more: it covers an area, or is a beacon."""
    return state.covers or beacon(state) == state.config.robot


def outside_meeting(state: RobotState, peer: str) -> Report:
    """Return the report to `peer` outside a meeting: this robot's verdict, and the strips that it covers.

    A robot without an anchor gets the pose of a localised one until it has determined its own by it.
    """
    verdict = state.robot_verdict
    report = replace(exchange.report_without_log(state, verdict), strips=coverage.strips(state))
    if not (is_helped(state, peer) and isinstance(verdict, Localised)):
        return report
    return steps_of(state).with_pose(state, peer, report)


def next_part(state: RobotState) -> RobotState:
    """Return `state` of a localised robot that covers the next part of the area, its own one first.

    It stops again for robots that it has left before.
    """
    config = state.config
    assert config.sweep is not None
    for robot in config.unanchored:
        state = state.with_other(robot, failed=False)
    part = (config.part + state.parts) % config.sweep.parts
    state = replace(state, parts=state.parts + 1, part_tick=state.tick, visiting=False, parting=0, silence=0)
    return steps_of(state).begun(state, part)


def after_tick(state: RobotState) -> RobotState:
    """Return `state` after a tick of the coverage, or of a contact with robots without an anchor.

    Those that are localised do not count, nor those with which a contact has failed.
    """
    helped = [one for one in state.config.unanchored if is_helped(state, one) and not state.other(one).failed]
    return steps_of(state).after_tick(state, helped)
