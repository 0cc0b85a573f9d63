"""The steps of `assured` with noisy sensors: it measures until poses are as accurate as it is asked.

The phases are those of the paper. In phase 1, a robot collects ranges to its anchor until a better estimate
is not worth the time. In phase 3, both robots move, each to where its next ranges are expected to tell
most (see `active_sensing`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from msgspec.structs import replace

from agent.estimation.gaussian import inference
from agent.estimation.gaussian.inference import MANY_MUTUAL_RANGES, PlanningHypothesis
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import Track
from agent.estimation.judged import FEWEST_FOR_CLAIM, sufficient_mutual_ranges
from agent.estimation.posterior import Hypothesis
from agent.planning import active_sensing, drive, phase2_orbit, range_seeking
from agent.planning.active_sensing import CONTINUED, STALLED, Objective
from agent.planning.pair_claim import inferred, with_claim, with_consistency_test
from agent.planning.phase3_last_manoeuvre import LAST_SPEEDS
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.strides import is_stalled, stride
from agent.planning.tasks import Homing, Listening, Orbital, Orbiting, Radial, Retreating, Straight, Surveying
from protocol.messages import BranchKind, Localised
from protocol.mission import Mission, Role
from protocol.motion import ORIGIN, REST, Controls, Pose, compose, inverse
from protocol.team_motion import next_on_spiral

MANOEUVRES = Manoeuvres(
    directions=(1.0, -1.0), sides=(1.0, -1.0), last_speeds=LAST_SPEEDS, fewest_out_of_range=True
)
"""Both ways, to both sides in phase 1, and at several speeds."""

LOST_AFTER = 3
"""The number of strides without an expected anchor detection after which the robot returns to its anchor."""

LOST_AFTER_IN_PHASE_3 = 6
"""The LOST_AFTER of b in phase 3, in which b may drive slightly out of its anchor's range."""

MISLEADING = -8.0
"""The smallest plausible log-likelihood of the ticks without detection.

If it is smaller even for the most probable hypothesis, the ranges are misleading and not just unlucky.
"""

CONVINCING_RANGES = 14
"""The number of anchor ranges from which on detections do not make them misleading.

It is more than twice the number that ends phase 1 with outliers. Without this bound, a robot whose ranges
are 0.35 m too long drove to and fro for ever, because it had ranges longer than R.
"""

JOINING_TURN = math.pi / 2
"""The angle in rad that a robot can turn in a tick if it joins its orbit without a turn on the spot.

A robot that turns more slowly would drive a wide arc on the way out, and overshoot its orbit.
"""

OFF_RADIUS = 0.5
"""The heading error in rad relative to the radius from which on the robot aligns again in phase 2."""

DROP_OUT_SIGMAS = 3.0
"""The margin for the number of drop-outs, in standard deviations."""

UNLIKELY_DROP_OUTS = 1e-3
"""The probability of so many drop-outs in a row from which on a robot searches for its first range."""


JointManoeuvres = Callable[
    [Sequence[PlanningHypothesis], tuple[float, float], float, Mission], tuple[Controls, Controls]
]
"""The type of `Assured.joint_manoeuvres`."""


def sensed(state: RobotState, ranged: bool) -> RobotState:
    """Return `state` with the task that follows one of active sensing, or of the search for the anchor."""
    if not state.log.ranges:  # it is asleep
        return _without_range(state)
    match state.task:
        case Surveying("anchor"):
            return continue_phase1(state) if is_planning_tick(state) else state
        case Homing() if ranged:
            return continue_phase1(state)
        case Homing(place, side):
            mission, tolerance = state.config.mission, state.estimator.pose_tolerance
            if drive.homing(place, state.odometry, mission, tolerance) is not None:
                return state
            if side is None:
                return state.doing(Straight("anchor", state.odometry, 0.0))
            x, y = next_on_spiral((place.x, place.y), side, mission)
            return state.doing(Homing(Pose(x, y, 0.0), side + 1))
        case Surveying("peer") | Listening() | Retreating():
            return _continue_phase3(state)
        case _:
            return state


def _without_range(state: RobotState) -> RobotState:
    """Return `state` of a robot whose first ranges are drop-outs: it waits for one, or searches.

    If drop-outs hardly explain that it has none, R is smaller than told.
    """
    mission, p = state.config.mission, state.config.mission.noise.drop_outs
    if 0.0 < p < 1.0 and state.tick < math.ceil(math.log(UNLIKELY_DROP_OUTS) / math.log(p)):
        return state
    return state.doing(Straight("anchor", state.odometry, mission.sensing_range))


def is_planning_tick(state: RobotState) -> bool:
    """Return whether the robot plans a manoeuvre in this tick. Both robots plan in the same ticks."""
    return state.tick % stride(state.config.mission) == 0


def continue_phase1(state: RobotState, manoeuvres: Manoeuvres | None = None) -> RobotState:
    """Continue phase 1: update the hypotheses about the anchor, and end phase 1 if they are accurate enough.

    If no hypothesis explains the ticks without detection, the ranges are misleading. The robot then takes
    further ranges around the place of the last one, as at the start. The `manoeuvres` are those of
    `active_sensing`.
    """
    del manoeuvres
    ranged = state.log.ranges[-1].tick == state.tick
    scored = inference.own_anchor(state)
    if scored:
        state = replace(state, belief=inference.with_own(state, scored))
    if _ticks_without_range(state) >= LOST_AFTER * stride(state.config.mission):
        return _return_to_anchor(state)
    if not scored or _are_misleading(state, scored[0]):
        if not ranged:
            return _return_to_anchor(state)
        return state.doing(Straight("anchor", state.odometry, state.log.ranges[-1].range))
    mission = state.config.mission
    if inference.is_anchor_known(state, scored):
        kind: BranchKind = "circle" if len(state.log.ranges) == 2 else "three-ranges"
        first = state.belief.phase1_done_tick
        done = state.tick if first is None else first
        return _start_phase2(
            replace(state, belief=replace(state.belief, branch_kind=kind, phase1_done_tick=done))
        )
    since, objective = _objective(state, "anchor", (inference.own_path(state),))
    hypotheses = inference.anchor_planning_hypotheses(state)
    command = active_sensing.plan_alone(hypotheses, mission, objective=objective)
    return state.doing(Surveying("anchor", command, since))


def _objective(state: RobotState, beacon: str, paths: Sequence[Track]) -> tuple[int, Objective]:
    """Return the tick of the first of the consecutive plans, and the objective of the next one."""
    match state.task:
        case Surveying(before, _, since) if before == beacon:
            mission = state.config.mission
            return since, STALLED if is_stalled(paths, since, stride(mission), mission) else CONTINUED
        case _:
            return state.tick, CONTINUED


def _are_misleading(state: RobotState, best: Hypothesis) -> bool:
    """Return whether the detections and the ticks without one contradict the most probable hypothesis.

    With CONVINCING_RANGES, ranges count more: R may not be as it was told. As many drop-outs as are to be
    expected at most contradict nothing.
    """
    if len(state.log.ranges) >= CONVINCING_RANGES:
        return False
    p = state.config.mission.noise.drop_outs
    expected = p * (state.tick + 1)
    most = expected + DROP_OUT_SIGMAS * math.sqrt(expected)
    return best.detections < MISLEADING + (most * math.log(p) if p else 0.0)


def _ticks_without_range(state: RobotState) -> int:
    """Return the number of ticks since the last anchor range."""
    return state.tick - state.log.ranges[-1].tick


def _return_to_anchor(state: RobotState) -> RobotState:
    """Drive back to the place of the last anchor range, and discard all hypotheses."""
    last_range_tick = state.log.ranges[-1].tick
    place = state.log.pose(ORIGIN, last_range_tick, state.config.mission.period)
    belief = replace(state.belief, own=(), encounter_tick=None, pair=(), returns=state.belief.returns + 1)
    return replace(state, task=Homing(place), belief=belief)


def _begin_again(state: RobotState, start: Pose) -> RobotState:
    """Drive to where the anchor should be if a started at `start` (see `Branch`), to measure phase 1 again.

    The place of the last range is on the rim of the anchor's range, which a robot misses more easily.
    """
    anchor = inverse(start)
    return _return_to_anchor(state).doing(Homing(Pose(anchor.x, anchor.y, 0.0), 0))


def _leave(state: RobotState) -> RobotState:
    """Drive back to the anchor, because MANY_MUTUAL_RANGES have not settled the poses.

    A robot a without a range to its anchor meanwhile begins again, as after a missed encounter.
    """
    config, belief = state.config, state.belief
    if not (config.begins_again and inference.has_failed(state, state.log.ranges[-1].tick, state.tick + 1)):
        return _return_to_anchor(state)
    start = state.start
    if belief.pair:
        here = belief.poses[0]
        local = Pose(here.x - config.anchor.x, here.y - config.anchor.y, here.heading)
        start = compose(local, inverse(state.odometry))
    return _begin_again(state, start)


def _of_this_attempt(state: RobotState) -> RobotState:
    """Return `state` without the hypotheses and tests of an attempt before a last began again."""
    first = inference.beginning(state, inference.known_through(state))
    if first == state.belief.beginning:
        return state
    belief = replace(
        state.belief,
        beginning=first,
        pair=(),
        candidates=None,
        ranges_at_last_search=0,
        inconsistency=None,
        p_value=None,
        inconsistent_searches=0,
        doubtful_claims=0,
        returns=0,
    )
    return replace(state, belief=belief)


def _start_phase2(state: RobotState) -> RobotState:
    """Start phase 2, for the first time or again."""
    return continue_phase2(state, phase2_orbit.aligning(state))


def continue_phase2(state: RobotState, task: Orbital, ranged: bool = False) -> RobotState:
    """Continue phase 2 with the latest anchor range, if `ranged`. Robot b takes ranges while it waits."""
    mission = state.config.mission
    planning = ranged and is_planning_tick(state)
    waiting = isinstance(task, Orbiting) and state.orbit.v == 0.0
    due = planning and (not waiting or inference.is_fit_due(state))
    if due and (scored := inference.own_anchor(state)):
        state = replace(state, belief=inference.with_own(state, scored))
        if isinstance(task, Radial) and abs(phase2_orbit.orientation(state.local_pose)) > OFF_RADIUS:
            return _start_phase2(state)
    if state.orbit.v != 0.0 and mission.max_turn_rate * mission.period >= JOINING_TURN:
        task = task if isinstance(task, Orbiting) else Orbiting()
    task = phase2_orbit.onward(state, task)
    timeout: float = LOST_AFTER * stride(mission)
    if (
        state.orbit.v == 0.0
        and isinstance(task, Radial | Orbiting)
        and _ticks_without_range(state) >= timeout
    ):
        return _return_to_anchor(state)
    if isinstance(task, Orbiting):
        since = task.since or state.tick
        way_out = state.orbit.radius / mission.max_speed
        timeout += (way_out + state.config.rendezvous.bound) / mission.period
        if state.orbit.v != 0.0 and state.tick - since > timeout and not state.in_contact:
            return _begin_again(state, state.start) if state.config.begins_again else _return_to_anchor(state)
        if state.orbit.v != 0.0:
            command = drive.pursuit(state.local_pose, state.orbit, mission)
        elif planning and state.belief.own:
            command = active_sensing.plan_alone(
                inference.anchor_planning_hypotheses(state), mission, state.orbit.radius
            )
        else:
            command = REST if is_planning_tick(state) else task.command or REST
        task = Orbiting(command, since)
    return state.doing(task)


# --- in contact with the peer -------------------------------------------------------------------------


def _continue_phase3(state: RobotState) -> RobotState:
    """Continue phase 3 depending on whether the peer, and for b also its anchor, are in range."""
    ticks = stride(state.config.mission)
    match state.task:
        case Retreating(_, since) if state.tick - since < 2 * ticks:
            return state
        case Retreating():
            if not state.in_contact:
                return _start_phase2(state)
            return state.doing(Surveying("peer", since=state.tick))
        case _ if state.config.role == "b" and _ticks_without_range(state) >= LOST_AFTER_IN_PHASE_3 * ticks:
            return _return_to_anchor(state)
        case Surveying(_, command) | Listening(command) if not state.in_contact:
            return state.doing(Retreating(Controls(0.0 - command.v, 0.0 - command.omega), state.tick))
        case _:
            return state


def decided(state: RobotState, planned: JointManoeuvres) -> RobotState:
    """Return `state`, in contact with a peer that it has not heard of, listening, or with the next plan."""
    if state.peer_state.start is None:
        return state
    if not inference.peer_log_suffices(state):
        return state.doing(Listening())
    return _decide_phase3(state, planned)


def _decide_phase3(state: RobotState, planned: JointManoeuvres) -> RobotState:
    """Evaluate both logs in phase 3: update the hypotheses, then claim a pose or plan the manoeuvres.

    Both robots compute the same pair of manoeuvres from the same logs, and each executes its own.
    """
    mission, role = state.config.mission, state.config.role
    if state.belief.encounter_tick is None:
        state = replace(state, belief=replace(state.belief, encounter_tick=state.tick))
    state = _of_this_attempt(state)
    pair = inference.pair_of(state)
    mutual = int(np.count_nonzero(pair.ranges.mutual))
    if mutual < FEWEST_FOR_CLAIM:
        return _drive_without_hypotheses(state)
    belief, judged, searched = inferred(state, pair)
    if searched:
        belief = replace(belief, ranges_at_last_search=mutual)
    tested, hypotheses = replace(state, belief=belief), inference.pair_planning_hypotheses(belief.pair)
    if searched and len(pair.mutual_places) >= sufficient_mutual_ranges(mission.noise):
        tested = with_consistency_test(tested)
    if tested.verdict is None and belief.blocking_reason is None:
        tested, rival = with_claim(tested, judged)
        if rival is not None:
            hypotheses = (hypotheses[0], rival.hypothesis, *hypotheses[1:])
    if tested.verdict is not None:
        return tested
    if role == "a" and _measures_in_vain(state, pair):
        return _leave(tested)
    if not hypotheses:
        return _drive_without_hypotheses(tested)
    since, objective = _objective(state, "peer", pair.paths)
    manoeuvres = _manoeuvres(state, objective) or planned
    a, b = manoeuvres(hypotheses, inference.m2_of(state.config), state.mutual[-1].range, mission)
    return tested.doing(Surveying("peer", a if role == "a" else b, since))


def _measures_in_vain(state: RobotState, pair: JointMeasurements) -> bool:
    """Return whether this meeting has so many ranges that more will hardly settle the poses."""
    many = MANY_MUTUAL_RANGES * (1 + state.belief.returns)
    return len(pair.mutual_places) >= many and len(state.mutual) - state.belief.earlier_ranges >= many


def _manoeuvres(state: RobotState, objective: Objective) -> JointManoeuvres | None:
    """Return how to plan if the robots are stalled or one of them has claimed its pose; None: as always."""
    resting: Role | None = None
    if isinstance(state.peer_state.verdict, Localised):
        resting = "b" if state.config.role == "a" else "a"
    if objective == CONTINUED and resting is None:
        return None
    return partial(active_sensing.plan_together, objective=objective, resting=resting)


def _drive_without_hypotheses(state: RobotState) -> RobotState:
    """Drive without hypotheses about the poses: b stands, a drives straight on (Section III.C.a)."""
    mission = state.config.mission
    if state.config.role == "b" or not state.mutual:
        return state.doing(Surveying("peer", since=state.tick))
    step = range_seeking.step_length("peer", state.mutual[-1].range, mission)
    return state.doing(Surveying("peer", Controls(step / mission.period, 0.0), state.tick))
