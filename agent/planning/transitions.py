"""The transitions between tasks that planners share."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from agent.estimation.estimator import AnchorEstimate, FittedBranch, PairEstimate
from agent.planning import drive, phase1_anchor, phase2_orbit, phase3_last_manoeuvre, tasks
from agent.planning.phase3_last_manoeuvre import Plan, Question
from agent.planning.planner import Manoeuvres
from agent.planning.range_seeking import step_length
from agent.planning.state import RobotState
from protocol.messages import BranchKind
from protocol.mission import SHORTEST_STEP, Mission
from protocol.motion import Controls

# --- phase 1 ------------------------------------------------------------------------------------------


def start_phase1(state: RobotState, rho0: float | None) -> RobotState:
    """Start phase 1 with the first anchor range `rho0` in m; None if the anchor was not detected."""
    if rho0 is None:
        return state.undecided("the anchor is out of range at the start")
    on_anchor = state.estimator.on_anchor(state, rho0)
    if on_anchor is not None:
        return end_phase1(state, on_anchor, "on-anchor")
    return state.doing(tasks.Straight("anchor", state.odometry, rho0))


def anchor_estimate(state: RobotState) -> AnchorEstimate:
    """Return the branches that the anchor ranges allow, after the second or a further one."""
    task = state.task
    return state.estimator.anchor(state, task.branches if isinstance(task, tasks.ThirdPoint) else ())


def branch_kind(state: RobotState) -> BranchKind | None:
    """Return how phase 1 ends if one branch is left; None if a further range has to check it.

    A third range that is missing is the paper's virtual measurement.
    """
    match state.task:
        case tasks.ThirdPoint():
            measured = state.log.ranges[-1].tick == state.tick
            return "three-ranges" if measured else "three-ranges-virtual"
        case tasks.Circling():
            return "circle"
        case _:
            return None


def to_third_point(
    state: RobotState, estimate: AnchorEstimate, manoeuvres: Manoeuvres, *, pinning: bool = False
) -> RobotState:
    """Plan the manoeuvre to the next measurement point of phase 1 (see `phase1_anchor.third_point`)."""
    if not estimate.branches:
        return state.undecided("no pose explains the anchor ranges")
    places = phase1_anchor.local(estimate.branches, state.odometry)
    command = phase1_anchor.third_point(
        places, state.config.mission, manoeuvres, margin=estimate.margin, pinning=pinning
    )
    if command is None:
        return state.undecided("eq. (5) allows no manoeuvre to a third range")
    return state.doing(tasks.ThirdPoint(estimate.branches, state.odometry, command))


def end_phase1(state: RobotState, fitted: FittedBranch, kind: BranchKind) -> RobotState:
    """End phase 1: store the branch and the anchor error of `fitted`, and start phase 2."""
    belief = replace(
        state.belief,
        branch=fitted.branch,
        branch_kind=kind,
        phase1_done_tick=state.tick,
        own_anchor=fitted.anchor_error,
    )
    state = replace(state, belief=belief)
    return continue_phase2(state, aligning(state))


def aligning(state: RobotState) -> tasks.Aligning:
    """Return the first task of phase 2, from the present pose."""
    return tasks.Aligning(state.odometry.heading - phase2_orbit.orientation(state.local_pose))


def continue_phase2(state: RobotState, task: tasks.Orbital) -> RobotState:
    """Continue phase 2 from `task`. A robot whose pose is corrected follows its orbit by pursuit."""
    task = phase2_orbit.onward(state, task)
    if isinstance(task, tasks.Orbiting) and state.estimator.corrects_poses:
        task = tasks.Orbiting(drive.pursuit(state.local_pose, state.orbit, state.config.mission))
    return state.doing(task)


# --- phase 3 ------------------------------------------------------------------------------------------


def begin_phase3(state: RobotState) -> RobotState:
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
    """Return whether a knows that b stands, and is far enough from b to drive straight on."""
    now = bool(state.mutual) and state.mutual[-1].tick == state.tick == state.peer_state.peer.through
    return now and step_length("peer", state.mutual[-1].range, state.config.mission) >= SHORTEST_STEP


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
    task = state.task if estimate.verdict is None else tasks.Done(3, estimate.verdict)
    return replace(state, belief=estimate.belief, task=task), estimate


def last_manoeuvre(
    state: RobotState, estimate: PairEstimate, planned: Callable[[Question, Mission], Plan | None]
) -> RobotState | None:
    """Return `state` on its last manoeuvre; None if every manoeuvre violates the safety distance.

    `planned` returns the manoeuvre that tells several placements apart, or tests one for the first time.
    """
    mover, mission = state.config.role, state.config.mission
    a, b, placements = estimate.a, estimate.b, estimate.placements
    if estimate.checked and len(placements) == 1:
        plan = phase3_last_manoeuvre.most_informative_manoeuvre(
            mover, a, b, placements[0], estimate.observations, mission
        )
    else:
        plan = planned(Question(mover, a, b, tuple(placements)), mission)
    if plan is None:
        return None
    return replace(state, task=tasks.LastManoeuvre(plan.command, state.odometry), plan=plan)
