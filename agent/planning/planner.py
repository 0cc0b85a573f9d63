"""The state machine of one robot: pure, so that simulation, network, replay and recovery agree to the bit.

One tick has two halves, since two robots in contact tell each other what they have just sensed before
either decides:

    observe(mind, sense)  -> mind       folds in what the sensors say; `report(mind)` is then what to tell
    decide(mind, reports) -> mind       folds in what was heard; `drive(mind)` is then what to do

No I/O, no clock, no randomness. What the robot is doing is one frozen value, `state.mode`.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.exact import Branch, branches, weigh_branches
from agent.peer import false_reports, peer_state
from agent.planning import (
    assured,
    encounter,
    paper,
    phase1_anchor,
    phase2_orbit,
    phase3_last_manoeuvre,
    plausibility,
    precision,
    range_seeking,
    separation,
)
from agent.planning.active_sensing import Retreating, Surveying
from agent.planning.phase1_anchor import ThirdPoint
from agent.planning.phase2_orbit import Aligning, Orbiting, Radial, Tangent
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Returning, Standing, Waiting
from agent.planning.range_seeking import Backing, Circling, Homing, Straight, Turning
from agent.planning.state import Asleep, Done, RobotState
from protocol import messages
from protocol.messages import (
    Command,
    Estimate,
    Inconsistent,
    Localised,
    Observation,
    Ranged,
    Report,
    Undecided,
)
from protocol.mission import RANGE_MARGIN
from protocol.motion import ORIGIN, REST, Controls, Pose, step
from protocol.rounding import SAME

# --- a tick -----------------------------------------------------------------------------------------


def observe(state: RobotState, observation: Observation) -> RobotState:
    """What the robot knows once it has sensed: where it drove, what was in range and what was silent."""
    log, odometry, leg = state.log, state.odometry, state.leg
    if observation.executed is not None:
        v, omega = observation.executed.v, observation.executed.omega
        log = log.drove(v, omega)
        ticks = log.runs[-1].ticks
        if ticks == 1:
            leg = odometry
        odometry = step(leg, v, omega, ticks * state.config.mission.period)
    if observation.anchor_range is not None and not _again(state, observation):
        log = log.ranged(observation.anchor_range)
    mutual, near = state.mutual, False
    for contact in observation.contacts:
        if contact.peer == state.config.peer:
            near = True
            if contact.range is not None:
                mutual = (*mutual, Ranged(observation.tick, contact.range))
    sensed = RobotState(
        state.config,
        state.mode,
        observation.tick,
        odometry,
        log,
        mutual,
        state.belief,
        state.peer_state,
        near,
        leg,
    )
    return _advanced(sensed, observation.anchor_range)


def report(state: RobotState) -> Report:
    """What the peer has not acknowledged yet."""
    since, ranges_since = state.peer_state.acknowledged, state.peer_state.ranges_acknowledged
    log, start = state.log, state.belief.branch.start if state.belief.branch and state.phase > 1 else None
    if (attack := state.config.attack) is not None:
        findings = state.belief
        log = false_reports.told(
            log, attack, findings.phase1_done_tick, findings.encounter_tick, state.config.mission.period
        )
        start = false_reports.start(start, attack) if start is not None else None
    news = log.after(since, ranges_since)
    return Report(
        tick=state.tick,
        robot=state.config.robot,
        phase=state.phase,
        state=state.mode_name,
        start=start,
        since=since,
        through=news.through,
        runs=news.runs,
        ranges_since=ranges_since,
        ranges=news.ranges,
        heard=state.peer_state.peer.through,
        ranges_heard=len(state.peer_state.peer.ranges),
        verdict=state.verdict,
    )


def decide(state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
    """What the robot is set to do once it has heard its peer."""
    if reports:
        state = _heard(state, reports)
        if state.verdict is not None:
            return state
    if not state.in_contact:
        return state
    if _surveys(state):
        return assured.heard(state)
    match state.mode:
        case Aligning() | Radial() | Tangent() | Orbiting() if encounter.meets(state):
            return encounter.met(state)
        case Standing() | Waiting():
            return encounter.considered(state)
        case _:
            return state


def command(state: RobotState) -> Command:
    """What the robot does over the tick to come."""
    controls = _controls(state)
    return Command(
        state.tick,
        state.config.robot,
        controls.v,
        controls.omega,
        state.phase,
        state.mode_name,
        state.verdict,
    )


def estimate(state: RobotState) -> Estimate:
    """What the robot holds possible."""
    left = state.belief.branches
    if not left and state.belief.branch is not None:
        left = (state.belief.branch,)
    elif not left and isinstance(state.mode, ThirdPoint):
        left = state.mode.branches
    if state.belief.poses:
        world: tuple[Pose, ...] = state.belief.poses
    elif isinstance(state.verdict, Localised):
        world = (state.verdict.pose,)
    else:
        world = tuple(state.world_pose(placement) for placement in state.belief.placements)
    return Estimate(
        tick=state.tick,
        robot=state.config.robot,
        local=tuple(phase1_anchor.local(left, state.odometry)),
        world=world,
        localised=isinstance(state.verdict, Localised),
        probabilities=tuple(one.probability for one in state.belief.pair or state.belief.own),
        covariance=state.belief.covariance,
    )


def _heard(state: RobotState, reports: Sequence[Report]) -> RobotState:
    """`state`, with all that `reports` tell; and its verdict, if that cannot be so, or the peer gives up."""
    for told in reports:
        heard = peer_state.hear(state.peer_state, told)
        doubt = (
            plausibility.objection(state.peer_state, heard, told, state.config)
            if state.verdict is None
            else None
        )
        state = replace(state, peer_state=heard)
        if doubt is not None:
            return state.alarmed(doubt)
    if state.verdict is None:
        match state.peer_state.verdict:
            case Undecided(reason):
                return state.undecided(f"{state.config.peer} says: {reason}")
            case Inconsistent(claim):
                return state.undecided(f"{state.config.peer} does not believe it: {claim}")
    return state


# --- what a tick changes ----------------------------------------------------------------------------


def _advanced(state: RobotState, anchor_range: float | None) -> RobotState:
    """`state` in the state that its own senses lead to."""
    if _surveys(state) and not isinstance(state.mode, Asleep):
        return assured.sensed(state, anchor_range)
    match state.mode:
        case Orbiting(None) | Standing() | Waiting() | Done():
            return state
        case Aligning() | Radial() | Tangent() | Orbiting():
            return _on_to_orbit(state, state.mode)
        case Straight(beacon) | Backing(beacon) | Turning(beacon) | Circling(beacon):
            measured = state.in_contact if beacon == "peer" else anchor_range is not None
            mission, planner_name = state.config.mission, state.config.planner_name
            onward = range_seeking.onward(state.mode, state.odometry, measured, mission, planner_name)
            if onward is not None:
                return state if onward is state.mode else replace(state, mode=onward)
            return replace(state, mode=Waiting()) if beacon == "peer" else _second_range(state)
        case ThirdPoint(_, origin):
            return _third_range(state, state.mode) if range_seeking.moved(origin, state.odometry) else state
        case LastManoeuvre(_, origin) | Returning(_, origin) if range_seeking.moved(origin, state.odometry):
            rest = Standing() if state.config.role == "b" else Waiting()
            return replace(
                state,
                mode=phase3_last_manoeuvre.advanced(state.mode, state.odometry, state.in_contact, rest),
            )
        case Asleep():
            return _released(state, anchor_range)
        case _:
            return state


def _surveys(state: RobotState) -> bool:
    """Whether sensors are noisy, and more than one look at them may be taken."""
    return state.config.planner_name == "assured" and not state.config.mission.noise.exact


def _again(state: RobotState, observation: Observation) -> bool:
    """Whether the anchor's range is the last one over again, from where the robot has stood since phase 1."""
    return (
        state.belief.branch is not None
        and observation.executed == REST
        and observation.anchor_range == state.log.ranges[-1].range
        and state.config.mission.noise.exact
    )


def _released(state: RobotState, rho0: float | None) -> RobotState:
    if rho0 is None and state.config.mission.noise.drop_outs:
        return state  # and listens
    if rho0 is None:
        return state.undecided("the anchor is out of range at the start")
    if state.config.mission.noise.exact and rho0 <= SAME * precision.drifted(state, state.log, state.tick):
        # it is on its anchor: the heading is radial by definition, and nothing is left to find out
        return _located(
            state, Branch(0.0, ORIGIN), "on-anchor", precision.anchor(state, ORIGIN, state.log).error
        )
    return replace(state, mode=Straight("anchor", state.odometry, rho0))


def _second_range(state: RobotState) -> RobotState:
    """The branches +-alpha, less what silence on the way rules out."""
    if not state.config.mission.noise.exact:
        state, likely = paper.with_branches(state)
        if isinstance(state.mode, Circling) and len(likely) == 1:
            return _located(state, likely[0], "circle")
        return _to_third_point(state, likely, RANGE_MARGIN)
    rho0, rho = state.log.ranges[0].range, state.log.ranges[-1].range
    possible = branches(rho0, state.odometry, rho)
    state = replace(state, belief=replace(state.belief, possible=possible))
    return _weighed(state, possible, "circle" if isinstance(state.mode, Circling) else None)


def _third_range(state: RobotState, mode: ThirdPoint) -> RobotState:
    """The branch that explains the third range, or its absence: the virtual measurement."""
    measured = state.log.ranges[-1].tick == state.tick
    kind: messages.BranchKind = "three-ranges" if measured else "three-ranges-virtual"
    if not state.config.mission.noise.exact:
        state, likely = paper.with_branches(state)
        return _located(state, likely[0], kind) if likely else _to_third_point(state, likely, RANGE_MARGIN)
    return _weighed(state, mode.branches, kind)


def _weighed(
    state: RobotState, candidates: tuple[Branch, ...], kind: messages.BranchKind | None
) -> RobotState:
    """Phase 1 goes on with those of `candidates` that explain all its ticks; it ends if one may be known.

    That takes ranges that fix the anchor as exactly as the claim needs; the letter takes no more of them.
    `kind` is how it ends; None where it goes on for another range in any case.
    """
    mission, as_published = state.config.mission, state.config.planner_name == "paper"
    floor = precision.drifted(state, state.log, state.tick)
    margin = precision.margin(mission, floor)
    left = weigh_branches(candidates, state.seen(), mission.sensing_range, floor, margin)
    left = precision.merged(state, left)
    if kind is not None and len(left) == 1:
        branch, known = precision.fitted(state, left[0])
        if known.enough or as_published:
            return _located(state, branch, kind, known.error)
    if len(left) > 1 and as_published and isinstance(state.mode, ThirdPoint):
        return state.undecided("the third range does not tell +alpha from -alpha")
    return _to_third_point(state, left, margin)


def _to_third_point(state: RobotState, left: tuple[Branch, ...], margin: float) -> RobotState:
    if not left:
        return state.undecided("no pose explains the anchor ranges")
    mission, planner_name = state.config.mission, state.config.planner_name
    pinning = planner_name == "assured" and len(left) == 1 and mission.noise.exact
    places = phase1_anchor.local(left, state.odometry)
    controls = phase1_anchor.third_point(places, mission, planner_name, margin=margin, pinning=pinning)
    if controls is None:
        return state.undecided("eq. (5) leaves no way to a third range")
    return replace(state, mode=ThirdPoint(left, state.odometry, controls))


def _located(state: RobotState, branch: Branch, kind: messages.BranchKind, off: float = 0.0) -> RobotState:
    """Phase 1 is done: its pose relative to the anchor is known, and that it may be `off` m elsewhere."""
    findings = replace(
        state.belief, branch=branch, branch_kind=kind, phase1_done_tick=state.tick, own_anchor=off
    )
    state = replace(state, belief=findings)
    mu = phase2_orbit.orientation(state.local_pose)
    return _on_to_orbit(state, Aligning(state.odometry.heading - mu))


def _on_to_orbit(state: RobotState, mode: phase2_orbit.Meeting) -> RobotState:
    onward = phase2_orbit.onward(mode, state.odometry, state.start, state.orbit, state.config.mission)
    if isinstance(onward, Orbiting) and not state.config.mission.noise.exact:
        onward = Orbiting(phase2_orbit.pursuit(state.local_pose, state.orbit, state.config.mission))
    return state if onward is state.mode else replace(state, mode=onward)


# --- what a mind implies ----------------------------------------------------------------------------


def _controls(state: RobotState) -> Controls:
    """What its state has it do; less, where it is in range of a peer of which it knows no more."""
    controls, mission = _intended(state), state.config.mission
    blind = state.phase < 3 or isinstance(state.mode, Retreating)
    if not (mission.safety_distance and state.in_contact and blind):
        return controls
    if not state.mutual or state.mutual[-1].tick != state.tick:  # a drop-out
        return REST
    return separation.slowed(
        controls, separation.BOTH * separation.leeway(state.mutual[-1].range, mission), mission
    )


def _intended(state: RobotState) -> Controls:
    match state.mode:
        case Aligning() | Radial() | Tangent() | Orbiting() if encounter.lingers(state):
            return REST
        case Orbiting(command):
            return command or Controls(state.orbit.v, state.orbit.omega)
        case Aligning() | Radial() | Tangent():
            return phase2_orbit.controls(
                state.mode, state.odometry, state.start, state.orbit, state.config.mission
            )
        case Straight() | Backing() | Turning() | Circling():
            return range_seeking.controls(state.mode, state.odometry, state.config.mission)
        case ThirdPoint(command=controls) | LastManoeuvre(controls) | Returning(controls):
            return controls
        case Surveying(command=controls) | Retreating(controls):
            return controls
        case Homing():
            return range_seeking.homeward(state.mode, state.odometry, state.config.mission) or REST
        case _:
            return REST
