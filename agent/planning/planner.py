"""The state machine of one robot: pure, so that simulation, network, replay and recovery agree to the bit.

One tick has two halves, since two robots in contact tell each other what they have just sensed before
either decides:

    observe(mind, sense)  -> mind       folds in what the sensors say; `report(mind)` is then what to tell
    decide(mind, reports) -> mind       folds in what was heard; `drive(mind)` is then what to do

No I/O, no clock, no randomness. What the robot is doing is one frozen value, `mind.state`.
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


def observe(mind: RobotState, sense: Observation) -> RobotState:
    """What the robot knows once it has sensed: where it drove, what was in range and what was silent."""
    log, odometry, leg = mind.log, mind.odometry, mind.leg
    if sense.executed is not None:
        v, omega = sense.executed.v, sense.executed.omega
        log = log.drove(v, omega)
        ticks = log.runs[-1].ticks
        if ticks == 1:
            leg = odometry
        odometry = step(leg, v, omega, ticks * mind.briefing.mission.period)
    if sense.anchor_range is not None and not _again(mind, sense):
        log = log.ranged(sense.anchor_range)
    mutual, near = mind.mutual, False
    for contact in sense.contacts:
        if contact.peer == mind.briefing.peer:
            near = True
            if contact.range is not None:
                mutual = (*mutual, Ranged(sense.tick, contact.range))
    sensed = RobotState(
        mind.briefing, mind.state, sense.tick, odometry, log, mutual, mind.findings, mind.radio, near, leg
    )
    return _advanced(sensed, sense.anchor_range)


def report(mind: RobotState) -> Report:
    """What the peer has not acknowledged yet."""
    since, ranges_since = mind.radio.acknowledged, mind.radio.ranges_acknowledged
    log, start = mind.log, mind.findings.branch.start if mind.findings.branch and mind.phase > 1 else None
    if (lie := mind.briefing.lie) is not None:
        findings = mind.findings
        log = false_reports.told(log, lie, findings.parted, findings.met, mind.briefing.mission.period)
        start = false_reports.start(start, lie) if start is not None else None
    news = log.after(since, ranges_since)
    return Report(
        tick=mind.tick,
        robot=mind.briefing.robot,
        phase=mind.phase,
        state=mind.doing,
        start=start,
        since=since,
        through=news.through,
        runs=news.runs,
        ranges_since=ranges_since,
        ranges=news.ranges,
        heard=mind.radio.peer.through,
        ranges_heard=len(mind.radio.peer.ranges),
        verdict=mind.verdict,
    )


def decide(mind: RobotState, reports: Sequence[Report] = ()) -> RobotState:
    """What the robot is set to do once it has heard its peer."""
    if reports:
        mind = _heard(mind, reports)
        if mind.verdict is not None:
            return mind
    if not mind.in_contact:
        return mind
    if _surveys(mind):
        return assured.heard(mind)
    match mind.state:
        case Aligning() | Radial() | Tangent() | Orbiting() if encounter.meets(mind):
            return encounter.met(mind)
        case Standing() | Waiting():
            return encounter.considered(mind)
        case _:
            return mind


def drive(mind: RobotState) -> Command:
    """What the robot does over the tick to come."""
    controls = _controls(mind)
    return Command(
        mind.tick,
        mind.briefing.robot,
        controls.v,
        controls.omega,
        mind.phase,
        mind.doing,
        mind.verdict,
    )


def estimate(mind: RobotState) -> Estimate:
    """What the robot holds possible."""
    left = mind.findings.branches
    if not left and mind.findings.branch is not None:
        left = (mind.findings.branch,)
    elif not left and isinstance(mind.state, ThirdPoint):
        left = mind.state.branches
    if mind.findings.poses:
        world: tuple[Pose, ...] = mind.findings.poses
    elif isinstance(mind.verdict, Localised):
        world = (mind.verdict.pose,)
    else:
        world = tuple(mind.world_pose(placement) for placement in mind.findings.placements)
    return Estimate(
        tick=mind.tick,
        robot=mind.briefing.robot,
        local=tuple(phase1_anchor.local(left, mind.odometry)),
        world=world,
        localised=isinstance(mind.verdict, Localised),
        odds=tuple(one.odds for one in mind.findings.pair or mind.findings.own),
        covariance=mind.findings.covariance,
    )


def _heard(mind: RobotState, reports: Sequence[Report]) -> RobotState:
    """`mind`, with all that `reports` tell; and its verdict, if that cannot be so, or the peer gives up."""
    for told in reports:
        heard = peer_state.hear(mind.radio, told)
        doubt = (
            plausibility.objection(mind.radio, heard, told, mind.briefing) if mind.verdict is None else None
        )
        mind = replace(mind, radio=heard)
        if doubt is not None:
            return mind.alarmed(doubt)
    if mind.verdict is None:
        match mind.radio.verdict:
            case Undecided(reason):
                return mind.undecided(f"{mind.briefing.peer} says: {reason}")
            case Inconsistent(claim):
                return mind.undecided(f"{mind.briefing.peer} does not believe it: {claim}")
    return mind


# --- what a tick changes ----------------------------------------------------------------------------


def _advanced(mind: RobotState, anchor_range: float | None) -> RobotState:
    """`mind` in the state that its own senses lead to."""
    if _surveys(mind) and not isinstance(mind.state, Asleep):
        return assured.sensed(mind, anchor_range)
    match mind.state:
        case Orbiting(None) | Standing() | Waiting() | Done():
            return mind
        case Aligning() | Radial() | Tangent() | Orbiting():
            return _on_to_orbit(mind, mind.state)
        case Straight(beacon) | Backing(beacon) | Turning(beacon) | Circling(beacon):
            measured = mind.in_contact if beacon == "peer" else anchor_range is not None
            mission, variant = mind.briefing.mission, mind.briefing.variant
            onward = range_seeking.onward(mind.state, mind.odometry, measured, mission, variant)
            if onward is not None:
                return mind if onward is mind.state else replace(mind, state=onward)
            return replace(mind, state=Waiting()) if beacon == "peer" else _second_range(mind)
        case ThirdPoint(_, origin):
            return _third_range(mind, mind.state) if range_seeking.moved(origin, mind.odometry) else mind
        case LastManoeuvre(_, origin) | Returning(_, origin) if range_seeking.moved(origin, mind.odometry):
            rest = Standing() if mind.briefing.role == "b" else Waiting()
            return replace(
                mind, state=phase3_last_manoeuvre.advanced(mind.state, mind.odometry, mind.in_contact, rest)
            )
        case Asleep():
            return _released(mind, anchor_range)
        case _:
            return mind


def _surveys(mind: RobotState) -> bool:
    """Whether sensors are noisy, and more than one look at them may be taken."""
    return mind.briefing.variant == "assured" and not mind.briefing.mission.noise.exact


def _again(mind: RobotState, sense: Observation) -> bool:
    """Whether the anchor's range is the last one over again, from where the robot has stood since phase 1."""
    return (
        mind.findings.branch is not None
        and sense.executed == REST
        and sense.anchor_range == mind.log.ranges[-1].range
        and mind.briefing.mission.noise.exact
    )


def _released(mind: RobotState, rho0: float | None) -> RobotState:
    if rho0 is None and mind.briefing.mission.noise.drop_outs:
        return mind  # and listens
    if rho0 is None:
        return mind.undecided("the anchor is out of range at the start")
    if mind.briefing.mission.noise.exact and rho0 <= SAME * precision.drifted(mind, mind.log, mind.tick):
        # it is on its anchor: the heading is radial by definition, and nothing is left to find out
        return _located(
            mind, Branch(0.0, ORIGIN), "on-anchor", precision.anchor(mind, ORIGIN, mind.log).error
        )
    return replace(mind, state=Straight("anchor", mind.odometry, rho0))


def _second_range(mind: RobotState) -> RobotState:
    """The branches +-alpha, less what silence on the way rules out."""
    if not mind.briefing.mission.noise.exact:
        mind, likely = paper.with_branches(mind)
        if isinstance(mind.state, Circling) and len(likely) == 1:
            return _located(mind, likely[0], "circle")
        return _to_third_point(mind, likely, RANGE_MARGIN)
    rho0, rho = mind.log.ranges[0].range, mind.log.ranges[-1].range
    possible = branches(rho0, mind.odometry, rho)
    mind = replace(mind, findings=replace(mind.findings, possible=possible))
    return _weighed(mind, possible, "circle" if isinstance(mind.state, Circling) else None)


def _third_range(mind: RobotState, state: ThirdPoint) -> RobotState:
    """The branch that explains the third range, or its absence: the virtual measurement."""
    measured = mind.log.ranges[-1].tick == mind.tick
    kind: messages.BranchKind = "three-ranges" if measured else "three-ranges-virtual"
    if not mind.briefing.mission.noise.exact:
        mind, likely = paper.with_branches(mind)
        return _located(mind, likely[0], kind) if likely else _to_third_point(mind, likely, RANGE_MARGIN)
    return _weighed(mind, state.branches, kind)


def _weighed(
    mind: RobotState, candidates: tuple[Branch, ...], kind: messages.BranchKind | None
) -> RobotState:
    """Phase 1 goes on with those of `candidates` that explain all its ticks; it ends if one may be known.

    That takes ranges that fix the anchor as exactly as the claim needs; the letter takes no more of them.
    `kind` is how it ends; None where it goes on for another range in any case.
    """
    mission, as_published = mind.briefing.mission, mind.briefing.variant == "paper"
    floor = precision.drifted(mind, mind.log, mind.tick)
    margin = precision.margin(mission, floor)
    left = weigh_branches(candidates, mind.seen(), mission.sensing_range, floor, margin)
    left = precision.merged(mind, left)
    if kind is not None and len(left) == 1:
        branch, known = precision.fitted(mind, left[0])
        if known.enough or as_published:
            return _located(mind, branch, kind, known.error)
    if len(left) > 1 and as_published and isinstance(mind.state, ThirdPoint):
        return mind.undecided("the third range does not tell +alpha from -alpha")
    return _to_third_point(mind, left, margin)


def _to_third_point(mind: RobotState, left: tuple[Branch, ...], margin: float) -> RobotState:
    if not left:
        return mind.undecided("no pose explains the anchor ranges")
    mission, variant = mind.briefing.mission, mind.briefing.variant
    pinning = variant == "assured" and len(left) == 1 and mission.noise.exact
    places = phase1_anchor.local(left, mind.odometry)
    controls = phase1_anchor.third_point(places, mission, variant, margin=margin, pinning=pinning)
    if controls is None:
        return mind.undecided("eq. (5) leaves no way to a third range")
    return replace(mind, state=ThirdPoint(left, mind.odometry, controls))


def _located(mind: RobotState, branch: Branch, kind: messages.BranchKind, off: float = 0.0) -> RobotState:
    """Phase 1 is done: its pose relative to the anchor is known, and that it may be `off` m elsewhere."""
    findings = replace(mind.findings, branch=branch, branch_kind=kind, parted=mind.tick, own_anchor=off)
    mind = replace(mind, findings=findings)
    mu = phase2_orbit.orientation(mind.local_pose)
    return _on_to_orbit(mind, Aligning(mind.odometry.heading - mu))


def _on_to_orbit(mind: RobotState, state: phase2_orbit.Meeting) -> RobotState:
    onward = phase2_orbit.onward(state, mind.odometry, mind.start, mind.orbit, mind.briefing.mission)
    if isinstance(onward, Orbiting) and not mind.briefing.mission.noise.exact:
        onward = Orbiting(phase2_orbit.pursuit(mind.local_pose, mind.orbit, mind.briefing.mission))
    return mind if onward is mind.state else replace(mind, state=onward)


# --- what a mind implies ----------------------------------------------------------------------------


def _controls(mind: RobotState) -> Controls:
    """What its state has it do; less, where it is in range of a peer of which it knows no more."""
    controls, mission = _intended(mind), mind.briefing.mission
    blind = mind.phase < 3 or isinstance(mind.state, Retreating)
    if not (mission.safety_distance and mind.in_contact and blind):
        return controls
    if not mind.mutual or mind.mutual[-1].tick != mind.tick:  # a drop-out
        return REST
    return separation.slowed(
        controls, separation.BOTH * separation.leeway(mind.mutual[-1].range, mission), mission
    )


def _intended(mind: RobotState) -> Controls:
    match mind.state:
        case Aligning() | Radial() | Tangent() | Orbiting() if encounter.lingers(mind):
            return REST
        case Orbiting(drive):
            return drive or Controls(mind.orbit.v, mind.orbit.omega)
        case Aligning() | Radial() | Tangent():
            return phase2_orbit.controls(
                mind.state, mind.odometry, mind.start, mind.orbit, mind.briefing.mission
            )
        case Straight() | Backing() | Turning() | Circling():
            return range_seeking.controls(mind.state, mind.odometry, mind.briefing.mission)
        case ThirdPoint(drive=controls) | LastManoeuvre(controls) | Returning(controls):
            return controls
        case Surveying(drive=controls) | Retreating(controls):
            return controls
        case Homing():
            return range_seeking.homeward(mind.state, mind.odometry, mind.briefing.mission) or REST
        case _:
            return REST
