"""Phase 2 with noisy sensors: each range to the anchor corrects the way; b takes some as it waits."""

from __future__ import annotations

import math

from msgspec.structs import replace

from agent.estimation.gaussian.own_anchor import anchor_planning_hypotheses, followed, is_fit_due
from agent.planning import drive, homing, phase2_orbit
from agent.planning.active_sensing import plan_alone
from agent.planning.homing import LOST_AFTER
from agent.planning.state import RobotState
from agent.planning.strides import is_planning_tick, stride
from agent.planning.tasks import Orbital, Orbiting, Radial
from protocol.motion import REST, Controls

JOINING_TURN = math.pi / 2
"""The angle in rad that a robot can turn in a tick if it joins its orbit without a turn on the spot.

A robot that turns more slowly would drive a wide arc on the way out, and overshoot its orbit.
"""

OFF_RADIUS = 0.5
"""The heading error in rad relative to the radius from which on the robot aligns again in phase 2."""


def begun(state: RobotState) -> RobotState:
    """Begin phase 2, for the first time or again."""
    return continued(state, phase2_orbit.aligning(state))


def continued(state: RobotState, task: Orbital, ranged: bool = False) -> RobotState:
    """Continue phase 2 with the latest anchor range, if `ranged`."""
    mission, orbit = state.config.mission, state.orbit
    planning = is_planning_tick(state)
    waiting = isinstance(task, Orbiting) and orbit.v == 0.0
    due = ranged and planning and (not waiting or is_fit_due(state))
    if due and (found := followed(state)) is not None:
        state = replace(state, own_anchor=found)
        if isinstance(task, Radial) and abs(phase2_orbit.orientation(state.local_pose)) > OFF_RADIUS:
            return begun(state)
    if orbit.v != 0.0 and mission.max_turn_rate * mission.period >= JOINING_TURN:
        task = task if isinstance(task, Orbiting) else Orbiting()
    task = phase2_orbit.onward(state, task)
    if orbit.v == 0.0 and isinstance(task, Radial | Orbiting) and homing.is_lost(state):
        return homing.begun(state)
    if not isinstance(task, Orbiting):
        return state.doing(task)
    since = task.since or state.tick
    if orbit.v == 0.0:
        return state.doing(Orbiting(_while_waiting(state, task, planning, ranged), since))
    search = (orbit.radius / mission.max_speed + state.config.rendezvous.bound) / mission.period
    if state.tick - since > LOST_AFTER * stride(mission) + search and not state.in_contact:
        return homing.begun_again(state, state.start) if state.config.begins_again else homing.begun(state)
    return state.doing(Orbiting(drive.pursuit(state.local_pose, orbit, mission), since))


def _while_waiting(state: RobotState, task: Orbiting, planning: bool, ranged: bool) -> Controls:
    """Return the controls of robot b, which waits beside its anchor and takes ranges to it."""
    if not planning:
        return task.command or REST
    if not ranged or not state.own_anchor.hypotheses:
        return REST
    return plan_alone(anchor_planning_hypotheses(state), state.config.mission, state.orbit.radius)
