"""From the first range of each other to a verdict: phase 3 as the planner goes through it (Section III.C)."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.exact import PairObservation, weigh_placements
from agent.planning import paper, phase3_last_manoeuvre, precision
from agent.planning.phase2_orbit import Orbiting, off_anchor
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Standing, Waiting
from agent.planning.range_seeking import Straight, stretch
from agent.planning.state import MODE_NAMES, Done, RobotState
from protocol.messages import Inconsistent, Localised
from protocol.mission import SHORTEST_STEP

PEER_RESTS = (MODE_NAMES[Standing], MODE_NAMES[Waiting])
"""what it says then: two that move at once may do so in mirror image, and learn nothing"""


def meets(state: RobotState) -> bool:
    """Whether phase 3 begins, once in contact: by the letter when both orbit, else as soon as it can."""
    if state.config.planner_name == "paper":
        return isinstance(state.mode, Orbiting) and (
            state.peer_state.phase == 3 or state.peer_state.state == state.mode_name
        )
    return state.peer_state.phase == 3 or (state.peer_state.start is not None and state.off_anchor)


def lingers(state: RobotState) -> bool:
    """Whether the robot stands still so as not to lose a peer with which phase 3 cannot begin yet.

    The peer is in phase 1, or has not been heard; or it is b, and too near its anchor.
    """
    return (
        state.config.planner_name == "assured"
        and state.in_contact
        and (state.peer_state.start is None or state.config.role == "a")
    )


def met(state: RobotState) -> RobotState:
    """Phase 3 begins: b stops, a goes straight on (Section III.C.a)."""
    findings = replace(state.belief, encounter_tick=state.tick)
    if state.config.role == "b":
        return replace(state, mode=Standing(), belief=findings)
    rho = state.mutual[-1].range if state.mutual else state.config.mission.sensing_range  # a drop-out
    if state.config.mission.safety_distance and not _may_go(state):
        return state
    straight = Straight("peer", state.odometry, rho)
    return replace(state, mode=straight, belief=findings)


def _may_go(state: RobotState) -> bool:
    """Whether a knows that b stands, and is far enough from it to go straight on."""
    now = bool(state.mutual) and state.mutual[-1].tick == state.tick == state.peer_state.peer.through
    return now and stretch("peer", state.mutual[-1].range, state.config.mission) >= SHORTEST_STEP


def considered(state: RobotState) -> RobotState:
    """Both logs in hand: weigh the placements; then claim, plan the last manoeuvre, or go on.

    Not before the peer has told of everything up to where this robot stands; and not twice of the same.
    """
    if not state.config.mission.noise.exact:
        return state if paper.waits(state) else paper.considered(state)
    assert isinstance(state.mode, Standing | Waiting)
    last = min(state.tick, state.peer_state.peer.through)
    if last < state.log.moved() or last == state.mode.through:
        return state
    return _settled(replace(state, mode=replace(state.mode, through=last)))


def _settled(state: RobotState) -> RobotState:
    """The same, where sensors are exact.

    The letter looks at the encounter alone; `assured` also at what was ranged, and what was silent, before.
    """
    mission, planner_name, began = (
        state.config.mission,
        state.config.planner_name,
        state.belief.encounter_tick,
    )
    assert began is not None
    pair_observations = state.pair_observations(began if planner_name == "paper" else 0)
    ranged = [at for at in pair_observations if at.range is not None]
    away = [at for at in ranged if off_anchor(at.b, state.config.rendezvous.b)]
    base = phase3_last_manoeuvre.base(away, precision.drift(state))
    if base is None:  # yet; or, where a report was missed, b was still driving as a went straight
        again = isinstance(state.mode, Waiting) and state.peer_state.state == MODE_NAMES[Standing]
        return met(state) if again and planner_name == "assured" else state
    if state.belief.peer_anchor is None:
        state = replace(state, belief=replace(state.belief, peer_anchor=precision.peer_anchor(state)))
    off = precision.apart(state)
    state = _weighed(state, pair_observations, base, off)
    left = state.belief.placements
    checked = phase3_last_manoeuvre.redundant(ranged, base)
    if not left:
        return state.alarmed(Inconsistent("a path that no placement brings together with the mutual ranges"))
    if checked and len(left) == 1 and precision.pinned_down(state, left[0], ranged, off):
        return replace(state, mode=Done(3, Localised(state.world_pose(left[0]))))
    mover = state.config.role
    alone = planner_name == "assured" and isinstance(
        state.peer_state.verdict, Localised
    )  # the peer stands for good
    if not alone and mover != (
        phase3_last_manoeuvre.turn(pair_observations) if checked and planner_name == "assured" else "b"
    ):
        return state
    if planner_name == "assured" and not alone and state.peer_state.state not in PEER_RESTS:
        return state
    if planner_name == "paper" and state.belief.plan is not None:
        failure = "does not settle where they are" if checked else "could not be taken: b left a's range"
        return state.undecided(f"the third mutual range {failure}")
    a, b = pair_observations[-1].a, pair_observations[-1].b
    if checked and len(left) == 1:
        plan = phase3_last_manoeuvre.survey(mover, a, b, left[0], pair_observations, mission)
    else:
        plan = phase3_last_manoeuvre.last_manoeuvre(mover, a, b, left, mission, planner_name)
    if plan is None:
        return (
            state if planner_name == "assured" else state.undecided("no manoeuvre keeps the safety distance")
        )
    return replace(
        state,
        mode=LastManoeuvre(plan.command, state.odometry),
        belief=replace(state.belief, plan=plan),
    )


def _weighed(
    state: RobotState,
    pair_observations: Sequence[PairObservation],
    base: tuple[PairObservation, PairObservation],
    floor: float,
) -> RobotState:
    """The placements of eq. (7) that every range and every silent tick in `pair_observations` leave."""
    reach, findings = state.config.mission.sensing_range, state.belief
    if findings.candidates is None:
        solutions = phase3_last_manoeuvre.solve(state.config.anchor_distance, base)
        silence = [
            pair_observation for pair_observation in pair_observations if pair_observation.range is None
        ]
        unheard = weigh_placements(solutions, silence, reach, floor)
        findings = replace(findings, placements=tuple(solutions), candidates=(len(solutions), len(unheard)))
    left = weigh_placements(findings.placements, pair_observations, reach, floor)
    return replace(state, belief=replace(findings, placements=left))
