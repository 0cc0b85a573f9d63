"""The mission under noise, as `assured` goes through it: measure until poses are known as well as was asked.

The order is the paper's. In phase 1 a robot goes on inside its anchor's range until what it does not know
yet is worth less than moving on; in phase 3 both move, each to where the next ranges should tell most.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.gaussian.consistency import DOUBTFUL, LOOKS, UNBELIEVABLE, WARY
from agent.estimation.gaussian.hypotheses import ScoredHypothesis, follow, search
from agent.planning import active_sensing, inference, phase2_orbit, range_seeking
from agent.planning.active_sensing import Listening, Retreating, Surveying
from agent.planning.phase2_orbit import Aligning, Orbiting, Radial, Tangent
from agent.planning.range_seeking import Backing, Circling, Homing, Straight, Turning
from agent.planning.state import Asleep, Done, RobotState
from protocol.messages import BranchKind, Localised
from protocol.motion import ORIGIN, REST, Controls

LOST = 3
"""strides of silence where there should be a range, before the robot goes back"""

LOST_TOGETHER = 6
"""likewise of b in phase 3, in which it may drive a little outside"""

MISLED = -8.0
"""in log-likelihood: less likely than this, it is not the sensors' chance that a hypothesis has against it"""

CHECKED, CHECKED_WITH_OUTLIERS = 8, 12
"""mutual ranges at the least before a claim"""

FEW = 3
"""mutual ranges; with fewer, hypotheses are too many to be of use"""

OFF_RADIUS = 0.5
"""rad: a robot that turns out to head so far off the radius turns onto it again"""

UNLUCKY = 3.0
"""standard deviations, of the number of drop-outs"""

SEARCHED = frozenset((FEW, *(CHECKED * 2**n for n in range(12))))
"""with so many mutual ranges the whole plane is searched again"""

ENOUGH = 60
"""mutual ranges, after which it is ranges to the anchor that are lacking"""


def sensed(state: RobotState, anchor_range: float | None) -> RobotState:
    """`state` in the state that its own senses lead to."""
    match state.mode:
        case Straight("anchor") | Backing("anchor") | Turning("anchor") | Circling("anchor"):
            mission, planner_name = state.config.mission, state.config.planner_name
            onward = range_seeking.onward(
                state.mode, state.odometry, anchor_range is not None, mission, planner_name
            )
            return _surveyed(state) if onward is None else replace(state, mode=onward)
        case Surveying("anchor"):
            return _surveyed(state) if decides(state) else state
        case Homing():
            if anchor_range is not None:
                return _surveyed(state)
            there = range_seeking.homeward(state.mode, state.odometry, state.config.mission) is None
            return replace(state, mode=Straight("anchor", state.odometry, 0.0)) if there else state
        case Aligning() | Radial() | Tangent() | Orbiting():
            return _under_way(state, anchor_range is not None)
        case Surveying("peer") | Listening() | Retreating():
            return _beside(state)
        case _:
            return state


def decides(state: RobotState) -> bool:
    """Whether this is a tick for a new manoeuvre; the same for both robots, so that they choose together."""
    return state.tick % active_sensing.stride(state.config.mission) == 0


def _surveyed(state: RobotState) -> RobotState:
    """Phase 1: what the ranges to the anchor leave possible, and whether that is enough.

    Where no hypothesis explains in which places the anchor was silent, its ranges mislead: then more of them
    are taken about the place of the last, as at first.
    """
    ranged = state.log.ranges[-1].tick == state.tick
    scored = inference.own_anchor(state)
    if scored:
        state = inference.with_own(state, scored)
    if _silent(state) >= LOST * active_sensing.stride(state.config.mission):
        return _homeward(state)
    if not scored or scored[0].silence < MISLED + _by_drop_outs(state):
        if not ranged:
            return _homeward(state)
        return replace(state, mode=Straight("anchor", state.odometry, state.log.ranges[-1].range))
    mission = state.config.mission
    if inference.settled(scored, mission):
        kind: BranchKind = "circle" if len(state.log.ranges) == 2 else "three-ranges"
        parted = state.tick if state.belief.phase1_done_tick is None else state.belief.phase1_done_tick
        state = replace(state, belief=replace(state.belief, branch_kind=kind, phase1_done_tick=parted))
        return _parted(state)
    command = active_sensing.alone(inference.held_alone(scored), mission)
    return replace(state, mode=Surveying("anchor", command))


def _by_drop_outs(state: RobotState) -> float:
    """In log-likelihood: what as many drop-outs cost as there may be by now."""
    p = state.config.mission.noise.drop_outs
    expected = p * (state.tick + 1)
    return (expected + UNLUCKY * math.sqrt(expected)) * math.log(p) if p else 0.0


def _silent(state: RobotState) -> int:
    """Ticks since the anchor was ranged."""
    return state.tick - state.log.ranges[-1].tick


def _homeward(state: RobotState) -> RobotState:
    """Back to where the anchor was ranged last; all that is held of where it is, is doubted."""
    last = state.log.ranges[-1].tick
    place = state.log.pose(ORIGIN, last, state.config.mission.period)
    findings = replace(state.belief, own=(), encounter_tick=None, pair=(), returns=state.belief.returns + 1)
    return replace(state, mode=Homing(place), belief=findings)


def _parted(state: RobotState) -> RobotState:
    """To the rendezvous, for the first time or again."""
    mu = phase2_orbit.orientation(state.local_pose)
    return _under_way(replace(state, mode=Aligning(state.odometry.heading - mu)), False)


def _under_way(state: RobotState, ranged: bool) -> RobotState:
    """Phase 2, with what another range to the anchor adds; b goes on to survey where it waits."""
    mission = state.config.mission
    scored: Sequence[ScoredHypothesis] = ()
    if ranged and decides(state) and (scored := inference.own_anchor(state)):
        state = inference.with_own(state, scored)
        if isinstance(state.mode, Radial) and abs(phase2_orbit.orientation(state.local_pose)) > OFF_RADIUS:
            return _parted(state)
    assert isinstance(state.mode, Aligning | Radial | Tangent | Orbiting)
    mode = phase2_orbit.onward(state.mode, state.odometry, state.start, state.orbit, mission)
    timeout: float = LOST * active_sensing.stride(mission)
    if state.orbit.v == 0.0 and isinstance(mode, Radial | Orbiting) and _silent(state) >= timeout:
        return _homeward(state)
    if isinstance(mode, Orbiting):
        since = mode.since or state.tick
        timeout += state.config.rendezvous.bound / mission.period
        if state.orbit.v != 0.0 and state.tick - since > timeout and not state.in_contact:
            return _homeward(state)
        if state.orbit.v != 0.0:
            command = phase2_orbit.pursuit(state.local_pose, state.orbit, mission)
        elif scored:
            command = active_sensing.alone(inference.held_alone(scored), mission, state.orbit.radius)
        else:
            command = REST if decides(state) else mode.command or REST
        mode = Orbiting(command, since)
    return replace(state, mode=mode)


# --- with the peer ------------------------------------------------------------------------------------


def _beside(state: RobotState) -> RobotState:
    """Phase 3, by whether the peer, and for b its anchor, are in range."""
    stride = active_sensing.stride(state.config.mission)
    match state.mode:
        case Retreating(_, since) if state.tick - since < 2 * stride:
            return state
        case Retreating():
            return replace(state, mode=Surveying("peer")) if state.in_contact else _parted(state)
        case _ if state.config.role == "b" and _silent(state) >= LOST_TOGETHER * stride:
            return _homeward(state)
        case Surveying(_, command) | Listening(command) if not state.in_contact:
            return replace(state, mode=Retreating(Controls(0.0 - command.v, 0.0 - command.omega), state.tick))
        case _:
            return state


def heard(state: RobotState) -> RobotState:
    """What the robot is set to do once it has heard its peer, in range."""
    match state.mode:
        case Done() | Asleep():
            return state
        case Surveying("anchor") | Straight() | Backing() | Turning() | Circling() | Homing():
            return state
        case _ if state.peer_state.start is None:
            return state
        case Retreating():
            return state
        case Surveying("peer") | Listening() if not decides(state):
            return state
        case _ if not inference.answered(state):
            return replace(state, mode=Listening())
        case _:
            return _considered(state)


def _considered(state: RobotState) -> RobotState:
    """Both logs in hand: weigh the hypotheses; then claim, or plan what both do next."""
    mission, role = state.config.mission, state.config.role
    if state.belief.encounter_tick is None:
        state = replace(state, belief=replace(state.belief, encounter_tick=state.tick))
    pair = inference.pair_of(state)
    mutual = pair.ranges.counts[2]
    if mutual < FEW:
        return _blindly(state)
    known = state.belief.pair
    searched = not known or any(state.belief.ranges_at_last_search < count <= mutual for count in SEARCHED)
    scored = search(pair) if searched else follow(known, pair)
    if searched:
        state = replace(state, belief=replace(state.belief, ranges_at_last_search=mutual))
    checked = CHECKED_WITH_OUTLIERS if mission.noise.outliers else CHECKED
    judged = inference.with_pair(state, scored, pair, checked)
    if (judged.belief.blocking_reason is None or _against(judged, DOUBTFUL)) and not searched:
        scored, searched = search(pair), True
        judged = inference.with_pair(state, scored, pair, checked)
    judged = inference.finished(judged, scored)
    if searched:
        judged = _doubted(judged)
    if judged.verdict is not None:
        return judged
    few = len(pair.places) < 2 * checked
    if judged.belief.blocking_reason is None and not (few and _against(judged, WARY)):
        return claimed(judged)
    if role == "a" and len(pair.places) >= ENOUGH * (1 + state.belief.returns):
        return _homeward(judged)
    if not scored:
        return _blindly(judged)
    a, b = active_sensing.together(
        inference.held_together(scored, pair), pair.apart, state.mutual[-1].range, mission
    )
    return replace(judged, mode=Surveying("peer", a if role == "a" else b))


def _against(state: RobotState, bound: float) -> bool:
    """Whether what most speaks against the likeliest hypothesis is less probable than `bound`."""
    against = state.belief.against
    return against is not None and against.p_value < bound


def _doubted(state: RobotState) -> RobotState:
    """`state`, after a search of the whole plane; alarmed, if its peer is beyond belief over and over."""
    findings = state.belief
    against = findings.against
    if against is None:
        return state
    least = min(against.p_value, findings.p_value if findings.p_value is not None else 1.0)
    doubts = findings.doubts + 1 if against.p_value < UNBELIEVABLE else 0
    state = replace(state, belief=replace(findings, doubts=doubts, p_value=least))
    return state.alarmed(against.alarm) if doubts >= LOOKS else state


def _blindly(state: RobotState) -> RobotState:
    """While nothing is known of how the two lie: b stands, a goes straight on (Section III.C.a)."""
    mission = state.config.mission
    if state.config.role == "b" or not state.mutual:
        return replace(state, mode=Surveying("peer"))
    step = range_seeking.stretch("peer", state.mutual[-1].range, mission)
    return replace(state, mode=Surveying("peer", Controls(step / mission.period, 0.0)))


def claimed(state: RobotState) -> RobotState:
    """The likeliest hypothesis is the one."""
    return replace(state, mode=Done(3, Localised(state.belief.poses[0], state.belief.covariance)))
