"""Phase 3 by turns: a moves while b stands, then one after the other, until one placement is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from msgspec.structs import replace

from agent.estimation.estimator import PairEstimate
from agent.estimation.gaussian.followed_pair import followed
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.mission_measurements import MANY_MUTUAL_RANGES, has_failed
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.planning import phase2_orbit, phase3_last_manoeuvre, range_seeking, tasks
from agent.planning.active_sensing import CONTINUED, next_objective, plan_together
from agent.planning.drive import step_length
from agent.planning.phase3_last_manoeuvre import Plan, Question
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.strides import stride
from protocol.messages import Localised
from protocol.mission import SHORTEST_STEP, Mission, Role
from protocol.motion import Controls, Pose, compose, inverse

PlannedLast = Callable[[Question, Mission], Plan | None]
"""The type of `LogPlanner.last_manoeuvre`."""


def met_on_orbits(state: RobotState, planned: object) -> RobotState:
    """Begin phase 3 once both robots are on their orbits, as published."""
    del planned
    peer, orbiting = state.peer_state, isinstance(state.task, tasks.Orbiting)
    return begun(state) if orbiting and (peer.phase == 3 or peer.state == state.task.name) else state


def begun(state: RobotState) -> RobotState:
    """Begin phase 3: b stops, a drives straight on (Section III.C.a).

    With a safety distance, a begins only when it knows that b stands far enough away.
    """
    posterior = replace(state.posterior, encounter_tick=state.tick)
    if state.config.role == "b":
        return replace(state, task=tasks.Standing(), posterior=posterior)
    # In contact without a range (a drop-out), the peer is only known to be within R.
    rho = state.mutual[-1].range if state.mutual else state.config.mission.sensing_range
    if state.config.mission.safety_distance and not _may_drive_straight(state):
        return state
    straight = tasks.Straight("peer", state.odometry, rho)
    return replace(state, task=straight, posterior=posterior)


def _may_drive_straight(state: RobotState) -> bool:
    """Return whether a knows that b stands, and is far enough from b to drive straight on.

    Once b stands, it does so until a rests, or has its result; a report that says so may be late.
    """
    if not state.mutual or state.mutual[-1].tick != state.tick:
        return False
    peer = state.peer_state
    rests = peer.state == tasks.Standing.name or isinstance(peer.verdict, Localised)
    stands = rests or peer.peer.through == state.tick
    return stands and step_length("peer", state.mutual[-1].range, state.config.mission) >= SHORTEST_STEP


def sought(state: RobotState, task: tasks.Searching, manoeuvres: Manoeuvres) -> RobotState:
    """Return `state` after a tick of a's search for its second mutual range.

    If a does not find b all around, b has driven on: its reports were late. a goes back to its orbit.
    """
    if not state.in_contact and range_seeking.has_come_round(task, state.odometry):
        return state.doing(phase2_orbit.aligning(state))
    seeking = range_seeking.onward(state, task, state.in_contact, manoeuvres)
    return state.doing(seeking or tasks.Waiting())


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
    """Return `state` with the posterior and the verdict of the estimate of both poses, and the estimate.

    The arguments are those of `Estimator.pair`. The estimate is None if the measurements do not suffice yet.
    """
    estimate = state.estimator.pair(state, first_tick, second_range=second_range)
    if estimate is None:
        return state, None
    state = replace(state, posterior=estimate.posterior)
    return state if estimate.verdict is None else state.ended(estimate.verdict), estimate


def last_manoeuvre(state: RobotState, estimate: PairEstimate, planned: PlannedLast) -> RobotState | None:
    """Return `state` on its last manoeuvre; None if every manoeuvre violates the safety distance.

    `planned` returns the manoeuvre that tells several placements apart, or tests one for the first time.
    """
    question = Question(state.config.role, estimate.a, estimate.b, tuple(estimate.placements))
    mission = state.config.mission
    if estimate.checked and len(estimate.placements) == 1:
        plan = phase3_last_manoeuvre.most_informative_manoeuvre(
            question, state.posterior.observations, mission
        )
    else:
        plan = planned(question, mission)
    if plan is None:
        return None
    return replace(state, task=tasks.LastManoeuvre(plan.command, state.odometry), plan=plan)


def as_published(state: RobotState, planned: PlannedLast) -> RobotState:
    """Evaluate phase 3 after a's second mutual range, and again after b's last manoeuvre.

    The mutual ranges count from the encounter on. Return `state` with a verdict, with b's last
    manoeuvre, or with the same task.
    """
    evaluated = with_new_ticks(state)
    if evaluated is None:
        return state
    first_tick, moved = state.posterior.encounter_tick, state.plan is not None
    assert first_tick is not None
    a_waits = not isinstance(state.task, tasks.Standing) or state.peer_state.state == tasks.Waiting.name
    second = a_waits or moved
    state, estimate = pair_estimate(evaluated, first_tick, second_range=second)
    if estimate is None or state.verdict is not None or state.config.role == "a":
        return state
    if moved:
        return state.undecided(estimate.failure)
    if state.config.mission.safety_distance and state.peer_state.state not in PEER_RESTS:
        return state  # a still drives, and its report of that is late
    moving = last_manoeuvre(state, estimate, planned)
    return moving if moving is not None else state.undecided("no manoeuvre keeps the safety distance")


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


def decided(state: RobotState, planned: PlannedLast) -> RobotState:
    """Return `state` after the evaluation of both logs: with a verdict, a last manoeuvre, or as it was.

    All ticks count, including those before the encounter. The robots take turns until a redundant range
    has confirmed the placement, and then until the ranges determine it.
    """
    evaluated = with_new_ticks(state)
    if evaluated is None:
        return state
    state, estimate = pair_estimate(evaluated, 0, second_range=True)
    if estimate is None:  # There are too few ranges, or b was still driving while a drove straight on.
        b_stands = isinstance(state.task, tasks.Waiting) and state.peer_state.state == tasks.Standing.name
        return begun(state) if b_stands else state
    if state.verdict is not None:
        return state
    # A peer that has localised itself does not move again.
    if not isinstance(state.peer_state.verdict, Localised):
        turn = phase3_last_manoeuvre.turn(state.posterior.observations) if estimate.checked else "b"
        if state.config.role != turn or state.peer_state.state not in PEER_RESTS:
            return state
    return last_manoeuvre(state, estimate, planned) or state


# --- the steps of `assured` under noise ---------------------------------------------------------------

LOST_AFTER_IN_PHASE_3 = 6
"""The LOST_AFTER of b in phase 3, in which b may drive slightly out of its anchor's range."""

JointManoeuvres = Callable[
    [Sequence[PlanningHypothesis], tuple[float, float], float, Mission], tuple[Controls, Controls]
]
"""The type of `LogPlanner.joint_manoeuvres`."""


def sensed(state: RobotState, task: tasks.Surveying | tasks.Listening | tasks.Retreating) -> RobotState:
    """Return `state` with the task that follows `task`: the peer, or b's anchor, may be out of range."""
    mission = state.config.mission
    match task:
        case tasks.Retreating(_, since) if state.tick - since < 2 * stride(mission):
            return state
        case tasks.Retreating() if state.in_contact:
            return state.doing(tasks.Surveying("peer", since=state.tick))
        case tasks.Retreating():
            return phase2_orbit.surveyed(state)
        case _ if state.config.role == "b" and range_seeking.is_lost(state, LOST_AFTER_IN_PHASE_3):
            return range_seeking.turned_back(state)
        case _ if not state.in_contact:
            back = Controls(0.0 - task.command.v, 0.0 - task.command.omega)
            return state.doing(tasks.Retreating(back, state.tick))
        case _:
            return state


def surveyed(state: RobotState, planned: JointManoeuvres) -> RobotState:
    """Return `state`, in contact, after the evaluation of both logs: with a verdict, or with the next plan.

    It listens until the peer's log suffices, and stays as it is if no report of the peer has been received.
    """
    if state.peer_state.start is None:
        return state
    if state.known_through < state.log.moved(state.config.mission.noise.standstill_bound):
        return state.doing(tasks.Listening())
    if state.posterior.encounter_tick is None:
        state = replace(state, posterior=replace(state.posterior, encounter_tick=state.tick))
    measured, posterior, hypotheses, verdict = followed(state)
    state = replace(state, posterior=posterior)
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
    a, b = planned(hypotheses, state.m2, state.mutual[-1].range, state.config.mission)
    return state.doing(tasks.Surveying("peer", a if state.config.role == "a" else b, since))


def _measures_in_vain(state: RobotState, pair: JointMeasurements) -> bool:
    """Return whether this meeting has so many ranges that more will hardly settle the poses."""
    many = MANY_MUTUAL_RANGES * (1 + state.posterior.attempt.returns)
    return len(pair.mutual_places) >= many and len(state.mutual) - state.posterior.earlier_ranges >= many


def _drive_without_hypotheses(state: RobotState) -> RobotState:
    """Drive without hypotheses about the poses: b stands, a drives straight on (Section III.C.a)."""
    mission = state.config.mission
    if state.config.role == "b" or not state.mutual:
        return state.doing(tasks.Surveying("peer", since=state.tick))
    step = step_length("peer", state.mutual[-1].range, mission)
    return state.doing(tasks.Surveying("peer", Controls(step / mission.period, 0.0), state.tick))


def _leave(state: RobotState) -> RobotState:
    """Drive back to the anchor, because MANY_MUTUAL_RANGES have not settled the poses.

    A robot a without a range to its anchor meanwhile begins again, as after a missed encounter.
    """
    config, posterior = state.config, state.posterior
    if not (config.begins_again and has_failed(state, state.log.ranges[-1].tick, state.tick + 1)):
        return range_seeking.turned_back(state)
    start = state.start
    if posterior.pair:
        here = posterior.poses[0]
        local = Pose(here.x - config.anchor.x, here.y - config.anchor.y, here.heading)
        start = compose(local, inverse(state.odometry))
    return range_seeking.begun_again(state, start)
