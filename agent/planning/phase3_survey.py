"""Phase 3 with noisy sensors: both robots move, each to where its next ranges are expected to tell most.

Both compute the same pair of manoeuvres from the same logs, and each executes its own (see `active_sensing`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from msgspec.structs import replace

from agent.estimation.gaussian.followed_pair import followed
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.mission_measurements import MANY_MUTUAL_RANGES, has_failed, m2_of
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.planning import phase2_orbit, range_seeking
from agent.planning.active_sensing import CONTINUED, next_objective, plan_together
from agent.planning.drive import step_length
from agent.planning.state import RobotState
from agent.planning.strides import stride
from agent.planning.tasks import Listening, Retreating, Surveying
from protocol.messages import Localised
from protocol.mission import Mission, Role
from protocol.motion import Controls, Pose, compose, inverse

LOST_AFTER_IN_PHASE_3 = 6
"""The LOST_AFTER of b in phase 3, in which b may drive slightly out of its anchor's range."""

JointManoeuvres = Callable[
    [Sequence[PlanningHypothesis], tuple[float, float], float, Mission], tuple[Controls, Controls]
]
"""The type of `Assured.joint_manoeuvres`."""


def sensed(state: RobotState, task: Surveying | Listening | Retreating) -> RobotState:
    """Return `state` with the task that follows `task`: the peer, or b's anchor, may be out of range."""
    mission = state.config.mission
    match task:
        case Retreating(_, since) if state.tick - since < 2 * stride(mission):
            return state
        case Retreating() if state.in_contact:
            return state.doing(Surveying("peer", since=state.tick))
        case Retreating():
            return phase2_orbit.surveyed(state)
        case _ if state.config.role == "b" and range_seeking.is_lost(state, LOST_AFTER_IN_PHASE_3):
            return range_seeking.turned_back(state)
        case _ if not state.in_contact:
            back = Controls(0.0 - task.command.v, 0.0 - task.command.omega)
            return state.doing(Retreating(back, state.tick))
        case _:
            return state


def decided(state: RobotState, planned: JointManoeuvres) -> RobotState:
    """Return `state`, in contact, after the evaluation of both logs: with a verdict, or with the next plan.

    It listens until the peer's log suffices, and stays as it is if no report of the peer has been received.
    """
    if state.peer_state.start is None:
        return state
    if state.known_through < state.log.moved(state.config.mission.noise.standstill_bound):
        return state.doing(Listening())
    if state.belief.encounter_tick is None:
        state = replace(state, belief=replace(state.belief, encounter_tick=state.tick))
    measured, belief, hypotheses, verdict = followed(state)
    state = replace(state, belief=belief)
    if verdict is not None:
        return state.ended(verdict)
    if state.config.role == "a" and _measures_in_vain(state, measured):
        return _leave(state)
    if not hypotheses:
        return _drive_without_hypotheses(state)
    since, objective = next_objective(state, "peer", measured.paths)
    resting: Role | None = None
    if isinstance(state.peer_state.verdict, Localised):
        resting = "b" if state.config.role == "a" else "a"
    if objective != CONTINUED or resting is not None:
        planned = partial(plan_together, objective=objective, resting=resting)
    a, b = planned(hypotheses, m2_of(state.config), state.mutual[-1].range, state.config.mission)
    return state.doing(Surveying("peer", a if state.config.role == "a" else b, since))


def _measures_in_vain(state: RobotState, pair: JointMeasurements) -> bool:
    """Return whether this meeting has so many ranges that more will hardly settle the poses."""
    many = MANY_MUTUAL_RANGES * (1 + state.belief.attempt.returns)
    return len(pair.mutual_places) >= many and len(state.mutual) - state.belief.earlier_ranges >= many


def _drive_without_hypotheses(state: RobotState) -> RobotState:
    """Drive without hypotheses about the poses: b stands, a drives straight on (Section III.C.a)."""
    mission = state.config.mission
    if state.config.role == "b" or not state.mutual:
        return state.doing(Surveying("peer", since=state.tick))
    step = step_length("peer", state.mutual[-1].range, mission)
    return state.doing(Surveying("peer", Controls(step / mission.period, 0.0), state.tick))


def _leave(state: RobotState) -> RobotState:
    """Drive back to the anchor, because MANY_MUTUAL_RANGES have not settled the poses.

    A robot a without a range to its anchor meanwhile begins again, as after a missed encounter.
    """
    config, belief = state.config, state.belief
    if not (config.begins_again and has_failed(state, state.log.ranges[-1].tick, state.tick + 1)):
        return range_seeking.turned_back(state)
    start = state.start
    if belief.pair:
        here = belief.poses[0]
        local = Pose(here.x - config.anchor.x, here.y - config.anchor.y, here.heading)
        start = compose(local, inverse(state.odometry))
    return range_seeking.begun_again(state, start)
