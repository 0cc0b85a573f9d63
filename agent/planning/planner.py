"""The planner: one robot's state machine as pure functions over frozen values.

A tick has two halves, because two robots in contact exchange their new measurements before either decides:

    observe(state, observation) -> state    adds the sensor data; `report(state)` is the message to the peer
    decide(state, reports)      -> state    adds the peer's reports; `command(state)` is the motion command

`estimate(state)` returns the pose hypotheses for viewers. There is no I/O, no clock and no randomness, so
simulation, network, replay and recovery make decisions that are identical to the bit. The current activity of
the robot is one frozen value, `state.mode`.
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
from protocol.mission import RANGE_MARGIN, Mission, PlannerName
from protocol.motion import ORIGIN, REST, Controls, Pose, step
from protocol.rounding import SAME

# --- one tick -----------------------------------------------------------------------------------------


def observe(state: RobotState, observation: Observation) -> RobotState:
    """Return `state` with the sensor data of one tick: odometry, anchor range, contact and mutual range.

    The mode is also advanced, as far as it depends on the robot's own sensors.
    """
    log, odometry, leg = state.log, state.odometry, state.leg
    if observation.executed is not None:
        v, omega = observation.executed.v, observation.executed.omega
        log = log.drove(v, omega)
        ticks = log.runs[-1].ticks
        if ticks == 1:
            leg = odometry
        odometry = step(leg, v, omega, ticks * state.config.mission.period)
    if observation.anchor_range is not None and not _repeats_last_range(state, observation):
        log = log.ranged(observation.anchor_range)
    mutual, in_contact = state.mutual, False
    for contact in observation.contacts:
        if contact.peer == state.config.peer:
            in_contact = True
            if contact.range is not None:
                mutual = (*mutual, Ranged(observation.tick, contact.range))
    observed = RobotState(
        state.config,
        state.mode,
        observation.tick,
        odometry,
        log,
        mutual,
        state.belief,
        state.peer_state,
        in_contact,
        leg,
    )
    return _advance_mode(observed, observation.anchor_range)


def report(state: RobotState) -> Report:
    """Return the report of this tick: the part of the log that the peer has not acknowledged.

    If the configuration contains an attack, the report holds the falsified log (see `protocol.attack`).
    """
    since, ranges_since = state.peer_state.acknowledged, state.peer_state.ranges_acknowledged
    log, start = state.log, state.belief.branch.start if state.belief.branch and state.phase > 1 else None
    if (attack := state.config.attack) is not None:
        belief = state.belief
        log = false_reports.falsified_log(
            log, attack, belief.phase1_done_tick, belief.encounter_tick, state.config.mission.period
        )
        start = false_reports.start(start, attack) if start is not None else None
    unacknowledged = log.after(since, ranges_since)
    return Report(
        tick=state.tick,
        robot=state.config.robot,
        phase=state.phase,
        state=state.mode_name,
        start=start,
        since=since,
        through=unacknowledged.through,
        runs=unacknowledged.runs,
        ranges_since=ranges_since,
        ranges=unacknowledged.ranges,
        heard=state.peer_state.peer.through,
        ranges_heard=len(state.peer_state.peer.ranges),
        verdict=state.verdict,
    )


def decide(state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
    """Return `state` with the peer's `reports` and with the mode that follows from them."""
    if reports:
        state = _with_reports(state, reports)
        if state.verdict is not None:
            return state
    if not state.in_contact:
        return state
    if uses_active_sensing(state.config.planner_name, state.config.mission):
        return assured.after_reports(state)
    match state.mode:
        case Aligning() | Radial() | Tangent() | Orbiting() if encounter.can_begin_phase3(state):
            return encounter.begin_phase3(state)
        case Standing() | Waiting():
            return encounter.decide_phase3(state)
        case _:
            return state


def command(state: RobotState) -> Command:
    """Return the command for the next tick, with the phase, the mode and the verdict."""
    controls = _safe_controls(state)
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
    """Return all poses that the robot considers possible in its anchor's frame and in <W>."""
    branches_left = state.belief.branches
    if not branches_left and state.belief.branch is not None:
        branches_left = (state.belief.branch,)
    elif not branches_left and isinstance(state.mode, ThirdPoint):
        branches_left = state.mode.branches
    if state.belief.poses:
        world: tuple[Pose, ...] = state.belief.poses
    elif isinstance(state.verdict, Localised):
        world = (state.verdict.pose,)
    else:
        world = tuple(state.world_pose(placement) for placement in state.belief.placements)
    return Estimate(
        tick=state.tick,
        robot=state.config.robot,
        local=tuple(phase1_anchor.local(branches_left, state.odometry)),
        world=world,
        localised=isinstance(state.verdict, Localised),
        probabilities=tuple(one.probability for one in state.belief.pair or state.belief.own),
        covariance=state.belief.covariance,
    )


def _with_reports(state: RobotState, reports: Sequence[Report]) -> RobotState:
    """Return `state` with the data of `reports`, and with a verdict if a report gives reason for one.

    The verdict is Inconsistent if a report is implausible, and Undecided if the peer has given up.
    """
    for received in reports:
        updated = peer_state.with_report(state.peer_state, received)
        objection = (
            plausibility.objection(state.peer_state, updated, received, state.config)
            if state.verdict is None
            else None
        )
        state = replace(state, peer_state=updated)
        if objection is not None:
            return state.inconsistent(objection)
    if state.verdict is None:
        match state.peer_state.verdict:
            case Undecided(reason):
                return state.undecided(f"{state.config.peer} reports: {reason}")
            case Inconsistent(contradiction):
                return state.undecided(f"{state.config.peer} found a contradiction: {contradiction}")
    return state


# --- mode transitions ---------------------------------------------------------------------------------


def _advance_mode(state: RobotState, anchor_range: float | None) -> RobotState:
    """Return `state` with the mode that follows from the robot's own sensors."""
    config = state.config
    if uses_active_sensing(config.planner_name, config.mission) and not isinstance(state.mode, Asleep):
        return assured.after_observation(state, anchor_range)
    match state.mode:
        case Orbiting(None) | Standing() | Waiting() | Done():
            return state
        case Aligning() | Radial() | Tangent() | Orbiting():
            return _continue_phase2(state, state.mode)
        case Straight(beacon) | Backing(beacon) | Turning(beacon) | Circling(beacon):
            measured = state.in_contact if beacon == "peer" else anchor_range is not None
            mission, planner_name = state.config.mission, state.config.planner_name
            next_mode = range_seeking.onward(state.mode, state.odometry, measured, mission, planner_name)
            if next_mode is not None:
                return state if next_mode is state.mode else replace(state, mode=next_mode)
            return replace(state, mode=Waiting()) if beacon == "peer" else _after_second_range(state)
        case ThirdPoint(_, origin):
            return (
                _after_third_range(state, state.mode)
                if range_seeking.moved(origin, state.odometry)
                else state
            )
        case LastManoeuvre(_, origin) | Returning(_, origin) if range_seeking.moved(origin, state.odometry):
            rest = Standing() if state.config.role == "b" else Waiting()
            return replace(
                state,
                mode=phase3_last_manoeuvre.advanced(state.mode, state.odometry, state.in_contact, rest),
            )
        case Asleep():
            return _start_phase1(state, anchor_range)
        case _:
            return state


def uses_active_sensing(planner_name: PlannerName, mission: Mission) -> bool:
    """Return whether robots choose each manoeuvre by its information: `assured` with noisy sensors."""
    return planner_name == "assured" and not mission.noise.exact


def _repeats_last_range(state: RobotState, observation: Observation) -> bool:
    """Return whether the anchor range only repeats the last one of a robot that has not moved since.

    Such a range tells nothing new with exact sensors. It is dropped from the end of phase 1 on.
    """
    return (
        state.belief.branch is not None
        and observation.executed == REST
        and observation.anchor_range == state.log.ranges[-1].range
        and state.config.mission.noise.exact
    )


def _start_phase1(state: RobotState, rho0: float | None) -> RobotState:
    """Start phase 1 with the first anchor range `rho0` in m; None if the anchor was not detected."""
    if rho0 is None and state.config.mission.noise.drop_outs:
        return state  # the robot waits for its first range
    if rho0 is None:
        return state.undecided("the anchor is out of range at the start")
    if state.config.mission.noise.exact and rho0 <= SAME * precision.range_rounding(
        state, state.log, state.tick
    ):
        # The robot is on its anchor. The heading is radial by definition, so phase 1 has nothing to
        # determine.
        return _end_phase1(
            state, Branch(0.0, ORIGIN), "on-anchor", precision.anchor(state, ORIGIN, state.log).error
        )
    return replace(state, mode=Straight("anchor", state.odometry, rho0))


def _after_second_range(state: RobotState) -> RobotState:
    """Continue phase 1 with the branches +alpha and -alpha that the second range allows (eq. (2))."""
    if not state.config.mission.noise.exact:
        state, likely = paper.with_branches(state)
        if isinstance(state.mode, Circling) and len(likely) == 1:
            return _end_phase1(state, likely[0], "circle")
        return _start_third_point(state, likely, RANGE_MARGIN)
    rho0, rho = state.log.ranges[0].range, state.log.ranges[-1].range
    possible = branches(rho0, state.odometry, rho)
    state = replace(state, belief=replace(state.belief, possible=possible))
    return _select_branches(state, possible, "circle" if isinstance(state.mode, Circling) else None)


def _after_third_range(state: RobotState, mode: ThirdPoint) -> RobotState:
    """Continue phase 1 after the third range. A missing range is the paper's virtual measurement."""
    measured = state.log.ranges[-1].tick == state.tick
    kind: messages.BranchKind = "three-ranges" if measured else "three-ranges-virtual"
    if not state.config.mission.noise.exact:
        state, likely = paper.with_branches(state)
        return (
            _end_phase1(state, likely[0], kind) if likely else _start_third_point(state, likely, RANGE_MARGIN)
        )
    return _select_branches(state, mode.branches, kind)


def _select_branches(
    state: RobotState, candidates: tuple[Branch, ...], kind: messages.BranchKind | None
) -> RobotState:
    """Select the branches of `candidates` that agree with every tick of phase 1, and end phase 1 if possible.

    Phase 1 ends if one branch is left. `assured` also requires that the ranges determine the anchor's
    position as accurately as a claim needs. `paper` takes no further ranges. `kind` is how phase 1 ends; with
    None, another range is taken in any case.
    """
    mission, as_published = state.config.mission, state.config.planner_name == "paper"
    floor = precision.range_rounding(state, state.log, state.tick)
    margin = precision.margin(mission, floor)
    remaining = weigh_branches(candidates, state.seen(), mission.sensing_range, floor, margin)
    remaining = precision.merged(state, remaining)
    if kind is not None and len(remaining) == 1:
        branch, accuracy = precision.fitted(state, remaining[0])
        if accuracy.enough or as_published:
            return _end_phase1(state, branch, kind, accuracy.error)
    if len(remaining) > 1 and as_published and isinstance(state.mode, ThirdPoint):
        return state.undecided("the third range does not distinguish +alpha from -alpha")
    return _start_third_point(state, remaining, margin)


def _start_third_point(state: RobotState, remaining: tuple[Branch, ...], margin: float) -> RobotState:
    """Plan the manoeuvre to the next measurement point of phase 1 for the `remaining` branches.

    `margin` is the distance inside R, in m, at which a point is certainly in range.
    """
    if not remaining:
        return state.undecided("no pose explains the anchor ranges")
    mission, planner_name = state.config.mission, state.config.planner_name
    pinning = planner_name == "assured" and len(remaining) == 1 and mission.noise.exact
    places = phase1_anchor.local(remaining, state.odometry)
    controls = phase1_anchor.third_point(places, mission, planner_name, margin=margin, pinning=pinning)
    if controls is None:
        return state.undecided("eq. (5) allows no manoeuvre to a third range")
    return replace(state, mode=ThirdPoint(remaining, state.odometry, controls))


def _end_phase1(
    state: RobotState, branch: Branch, kind: messages.BranchKind, anchor_error: float = 0.0
) -> RobotState:
    """End phase 1: store `branch` and its anchor error in m, and start phase 2."""
    belief = replace(
        state.belief, branch=branch, branch_kind=kind, phase1_done_tick=state.tick, own_anchor=anchor_error
    )
    state = replace(state, belief=belief)
    mu = phase2_orbit.orientation(state.local_pose)
    return _continue_phase2(state, Aligning(state.odometry.heading - mu))


def _continue_phase2(state: RobotState, mode: phase2_orbit.Phase2Mode) -> RobotState:
    """Continue phase 2 from `mode`. With noisy sensors, the robot follows its orbit by pure pursuit."""
    next_mode = phase2_orbit.onward(mode, state.odometry, state.start, state.orbit, state.config.mission)
    if isinstance(next_mode, Orbiting) and not state.config.mission.noise.exact:
        next_mode = Orbiting(phase2_orbit.pursuit(state.local_pose, state.orbit, state.config.mission))
    return state if next_mode is state.mode else replace(state, mode=next_mode)


# --- commands -----------------------------------------------------------------------------------------


def _safe_controls(state: RobotState) -> Controls:
    """Return the controls for the next tick, limited so that the safety distance is kept.

    The limit applies in contact while the robot does not plan with the peer's position: before phase 3, and
    on the way back into range.
    """
    controls, mission = _mode_controls(state), state.config.mission
    plans_alone = state.phase < 3 or isinstance(state.mode, Retreating)
    if not (mission.safety_distance and state.in_contact and plans_alone):
        return controls
    if not state.mutual or state.mutual[-1].tick != state.tick:  # the range was not measured
        return REST
    return separation.slowed(
        controls, separation.SHARE_OF_EACH * separation.leeway(state.mutual[-1].range, mission), mission
    )


def _mode_controls(state: RobotState) -> Controls:
    """Return the controls of the current mode."""
    match state.mode:
        case Aligning() | Radial() | Tangent() | Orbiting() if encounter.must_wait(state):
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
            return range_seeking.homing_controls(state.mode, state.odometry, state.config.mission) or REST
        case _:
            return REST
