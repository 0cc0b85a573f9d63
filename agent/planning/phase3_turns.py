"""Phase 3 by turns: a moves while b stands, then one after the other, until one placement is left."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from agent.estimation.estimator import PairEstimate
from agent.planning import phase3_last_manoeuvre, tasks
from agent.planning.drive import step_length
from agent.planning.phase3_last_manoeuvre import Plan, Question
from agent.planning.state import RobotState
from protocol.messages import Localised
from protocol.mission import SHORTEST_STEP, Mission
from protocol.motion import Controls


def met_on_orbits(state: RobotState, planned: object) -> RobotState:
    """Begin phase 3 once both robots are on their orbits, as published."""
    del planned
    peer = state.peer_state
    return begun(state) if peer.phase == 3 or peer.state == state.task.name else state


def begun(state: RobotState) -> RobotState:
    """Begin phase 3: b stops, a drives straight on (Section III.C.a).

    With a safety distance, a begins only when it knows that b stands far enough away.
    """
    belief = replace(state.belief, encounter_tick=state.tick)
    if state.config.role == "b":
        return replace(state, task=tasks.Standing(), belief=belief)
    # In contact without a range (a drop-out), the peer is only known to be within R.
    rho = state.mutual[-1].range if state.mutual else state.config.mission.sensing_range
    if state.config.mission.safety_distance and not _may_drive_straight(state):
        return state
    straight = tasks.Straight("peer", state.odometry, rho)
    return replace(state, task=straight, belief=belief)


def _may_drive_straight(state: RobotState) -> bool:
    """Return whether a knows that b stands, and is far enough from b to drive straight on.

    Once b stands, it does so until a rests; a report that says so may be late.
    """
    if not state.mutual or state.mutual[-1].tick != state.tick:
        return False
    peer = state.peer_state
    stands = peer.peer.through == state.tick or peer.state == tasks.Standing.name
    return stands and step_length("peer", state.mutual[-1].range, state.config.mission) >= SHORTEST_STEP


def after_last_manoeuvre(state: RobotState, task: tasks.LastManoeuvre | tasks.Returning) -> RobotState:
    """Return `state` after a tick of a last manoeuvre: at rest, or on the way back into the peer's range."""
    if isinstance(task, tasks.LastManoeuvre) and not state.in_contact:
        back = Controls(-task.command.v, -task.command.omega)
        return state.doing(tasks.Returning(back, state.odometry))
    return state.doing(tasks.Standing() if state.config.role == "b" else tasks.Waiting())


def with_new_ticks(state: RobotState) -> RobotState | None:
    """Return `state` with the last tick that both logs cover marked as evaluated; None if it was before.

    The result is also None until the peer's log covers every tick up to the one in which this robot stopped.
    """
    assert isinstance(state.task, tasks.Resting)
    last = min(state.tick, state.peer_state.peer.through)
    if last < state.log.moved() or last == state.task.through:
        return None
    return state.doing(replace(state.task, through=last))


def pair_estimate(
    state: RobotState, first_tick: int, *, second_range: bool
) -> tuple[RobotState, PairEstimate | None]:
    """Return `state` with the belief and the verdict of the estimate of both poses, and the estimate.

    The arguments are those of `Estimator.pair`. The estimate is None if the measurements do not suffice yet.
    """
    estimate = state.estimator.pair(state, first_tick, second_range=second_range)
    if estimate is None:
        return state, None
    state = replace(state, belief=estimate.belief)
    return state if estimate.verdict is None else state.ended(estimate.verdict), estimate


def last_manoeuvre(
    state: RobotState, estimate: PairEstimate, planned: Callable[[Question, Mission], Plan | None]
) -> RobotState | None:
    """Return `state` on its last manoeuvre; None if every manoeuvre violates the safety distance.

    `planned` returns the manoeuvre that tells several placements apart, or tests one for the first time.
    """
    question = Question(state.config.role, estimate.a, estimate.b, tuple(estimate.placements))
    mission = state.config.mission
    if estimate.checked and len(estimate.placements) == 1:
        plan = phase3_last_manoeuvre.most_informative_manoeuvre(question, estimate.observations, mission)
    else:
        plan = planned(question, mission)
    if plan is None:
        return None
    return replace(state, task=tasks.LastManoeuvre(plan.command, state.odometry), plan=plan)


# --- the steps of `assured` ---------------------------------------------------------------------------

PEER_RESTS = (tasks.Standing.name, tasks.Waiting.name)
"""The tasks of the peer in which this robot may plan a manoeuvre.

If both moved at once, they might do so in mirror image, and the new range would not select a placement.
"""


def met(state: RobotState, planned: object) -> RobotState:
    """Begin phase 3 once the peer's phase 1 has ended, and b is off its anchor."""
    del planned
    peer = state.peer_state
    return begun(state) if peer.phase == 3 or (peer.start is not None and state.off_anchor) else state


def decided(state: RobotState, planned: Callable[[Question, Mission], Plan | None]) -> RobotState:
    """Return `state` after the evaluation of both logs: with a verdict, a last manoeuvre, or as it was.

    All ticks count, including those before the encounter. The robots take turns until a redundant range
    has confirmed the placement, and then until the ranges determine it.
    """
    evaluated = with_new_ticks(state)
    if evaluated is None:
        return state
    state, estimate = pair_estimate(evaluated, 0, second_range=True)
    if estimate is None:  # There are too few ranges, or b was still driving while a drove straight on.
        b_is_standing = (
            isinstance(state.task, tasks.Waiting) and state.peer_state.state == tasks.Standing.name
        )
        return begun(state) if b_is_standing else state
    if state.verdict is not None:
        return state
    # A peer that has localised itself does not move again.
    if not isinstance(state.peer_state.verdict, Localised):
        turn = phase3_last_manoeuvre.turn(estimate.observations) if estimate.checked else "b"
        if state.config.role != turn or state.peer_state.state not in PEER_RESTS:
            return state
    return last_manoeuvre(state, estimate, planned) or state
