"""Phase 3 from the first mutual range to the verdict (Section III.C).

With exact sensors, this module evaluates the placements of eq. (7). With noisy sensors, it calls `paper`. The
`assured` planner handles noisy sensors in `assured`.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.exact import PairObservation, weigh_placements
from agent.planning import paper, phase3_last_manoeuvre, precision
from agent.planning.phase2_orbit import Orbiting, off_anchor
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Standing, Waiting
from agent.planning.range_seeking import Straight, step_length
from agent.planning.state import MODE_NAMES, Done, RobotState
from protocol.messages import Inconsistent, Localised
from protocol.mission import SHORTEST_STEP

PEER_RESTS = (MODE_NAMES[Standing], MODE_NAMES[Waiting])
"""The modes of the peer in which this robot may plan a manoeuvre.

If both moved at once, they might do so in mirror image, and the new range would not select a placement.
"""


def can_begin_phase3(state: RobotState) -> bool:
    """Return whether phase 3 begins, once in contact.

    `paper` requires that both robots are on their orbits. `assured` begins as soon as the peer's phase 1 has
    ended and b is far enough from its anchor.
    """
    if state.config.planner_name == "paper":
        return isinstance(state.mode, Orbiting) and (
            state.peer_state.phase == 3 or state.peer_state.state == state.mode_name
        )
    return state.peer_state.phase == 3 or (state.peer_state.start is not None and state.off_anchor)


def must_wait(state: RobotState) -> bool:
    """Return whether the robot stands still, to stay in range of a peer with which phase 3 cannot begin yet.

    The peer is then in phase 1, or none of its reports has been received, or it is b and too near its anchor.
    """
    return (
        state.config.planner_name == "assured"
        and state.in_contact
        and (state.peer_state.start is None or state.config.role == "a")
    )


def begin_phase3(state: RobotState) -> RobotState:
    """Begin phase 3: b stops, a drives straight on (Section III.C.a).

    With a safety distance, a begins only when it knows that b stands far enough away.
    """
    belief = replace(state.belief, encounter_tick=state.tick)
    if state.config.role == "b":
        return replace(state, mode=Standing(), belief=belief)
    # In contact without a range (a drop-out), the peer is only known to be within R.
    rho = state.mutual[-1].range if state.mutual else state.config.mission.sensing_range
    if state.config.mission.safety_distance and not _may_drive_straight(state):
        return state
    straight = Straight("peer", state.odometry, rho)
    return replace(state, mode=straight, belief=belief)


def _may_drive_straight(state: RobotState) -> bool:
    """Return whether a knows that b stands, and is far enough from b to drive straight on."""
    now = bool(state.mutual) and state.mutual[-1].tick == state.tick == state.peer_state.peer.through
    return now and step_length("peer", state.mutual[-1].range, state.config.mission) >= SHORTEST_STEP


def decide_phase3(state: RobotState) -> RobotState:
    """Return `state` after the evaluation of both logs, with a claim, a last manoeuvre, or the same mode.

    The state is unchanged until the peer's log covers every tick up to the one in which this robot stopped,
    and while there is no new tick to evaluate.
    """
    if not state.config.mission.noise.exact:
        return state if paper.awaits_second_range(state) else paper.decide_phase3(state)
    assert isinstance(state.mode, Standing | Waiting)
    last = min(state.tick, state.peer_state.peer.through)
    if last < state.log.moved() or last == state.mode.through:
        return state
    return _decide_exact(replace(state, mode=replace(state.mode, through=last)))


def _decide_exact(state: RobotState) -> RobotState:
    """Return `state` after the evaluation of both logs with exact sensors (see `decide_phase3`).

    `paper` uses the mutual ranges from the encounter on. `assured` also uses earlier ticks, including those
    without detection.
    """
    mission = state.config.mission
    planner_name = state.config.planner_name
    first_tick = state.belief.encounter_tick
    assert first_tick is not None
    pair_observations = state.pair_observations(first_tick if planner_name == "paper" else 0)
    observations_in_range = [at for at in pair_observations if at.range is not None]
    away_from_m2 = [at for at in observations_in_range if off_anchor(at.b, state.config.rendezvous.b)]
    odometry_rounding = precision.odometry_rounding(state, min(state.tick, state.peer_state.peer.through))
    base = phase3_last_manoeuvre.base(away_from_m2, odometry_rounding)
    if base is None:  # There are too few ranges, or b was still driving while a drove straight on.
        b_is_standing = isinstance(state.mode, Waiting) and state.peer_state.state == MODE_NAMES[Standing]
        return begin_phase3(state) if b_is_standing and planner_name == "assured" else state
    if state.belief.peer_anchor is None:
        state = replace(state, belief=replace(state.belief, peer_anchor=precision.peer_anchor(state)))
    error_bound = precision.combined_error(state, odometry_rounding)
    state = _select_placements(state, pair_observations, base, error_bound)
    remaining = state.belief.placements
    checked = phase3_last_manoeuvre.redundant(observations_in_range, base)
    if not remaining:
        return state.inconsistent(
            Inconsistent("a path that contradicts the mutual ranges under every placement")
        )
    if (
        checked
        and len(remaining) == 1
        and precision.pinned_down(state, remaining[0], observations_in_range, error_bound)
    ):
        return replace(state, mode=Done(3, Localised(state.world_pose(remaining[0]))))
    mover = state.config.role
    # A peer that has localised itself does not move again.
    peer_has_ended = planner_name == "assured" and isinstance(state.peer_state.verdict, Localised)
    if not peer_has_ended and mover != (
        phase3_last_manoeuvre.turn(pair_observations) if checked and planner_name == "assured" else "b"
    ):
        return state
    if planner_name == "assured" and not peer_has_ended and state.peer_state.state not in PEER_RESTS:
        return state
    if planner_name == "paper" and state.belief.plan is not None:
        failure = "does not select a placement" if checked else "could not be measured: b left a's range"
        return state.undecided(f"the third mutual range {failure}")
    a, b = pair_observations[-1].a, pair_observations[-1].b
    if checked and len(remaining) == 1:
        plan = phase3_last_manoeuvre.most_informative_manoeuvre(
            mover, a, b, remaining[0], pair_observations, mission
        )
    else:
        plan = phase3_last_manoeuvre.last_manoeuvre(mover, a, b, remaining, mission, planner_name)
    if plan is None:
        return (
            state if planner_name == "assured" else state.undecided("no manoeuvre keeps the safety distance")
        )
    return replace(
        state,
        mode=LastManoeuvre(plan.command, state.odometry),
        belief=replace(state.belief, plan=plan),
    )


def _select_placements(
    state: RobotState,
    pair_observations: Sequence[PairObservation],
    base: tuple[PairObservation, PairObservation],
    floor: float,
) -> RobotState:
    """Return `state` with the solutions of eq. (7) that agree with every tick in `pair_observations`.

    A tick without a mutual range rules out the placements that predict both robots in range. `floor` is the
    bound in m on the error of a predicted range.
    """
    reach, belief = state.config.mission.sensing_range, state.belief
    if belief.candidates is None:
        solutions = phase3_last_manoeuvre.solve(state.config.anchor_distance, base)
        undetected = [
            pair_observation for pair_observation in pair_observations if pair_observation.range is None
        ]
        possible = weigh_placements(solutions, undetected, reach, floor)
        belief = replace(belief, placements=tuple(solutions), candidates=(len(solutions), len(possible)))
    remaining = weigh_placements(belief.placements, pair_observations, reach, floor)
    return replace(state, belief=replace(belief, placements=remaining))
