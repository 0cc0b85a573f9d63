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


def sensed(mind: RobotState, anchor_range: float | None) -> RobotState:
    """`mind` in the state that its own senses lead to."""
    match mind.state:
        case Straight("anchor") | Backing("anchor") | Turning("anchor") | Circling("anchor"):
            mission, variant = mind.briefing.mission, mind.briefing.variant
            onward = range_seeking.onward(
                mind.state, mind.odometry, anchor_range is not None, mission, variant
            )
            return _surveyed(mind) if onward is None else replace(mind, state=onward)
        case Surveying("anchor"):
            return _surveyed(mind) if decides(mind) else mind
        case Homing():
            if anchor_range is not None:
                return _surveyed(mind)
            there = range_seeking.homeward(mind.state, mind.odometry, mind.briefing.mission) is None
            return replace(mind, state=Straight("anchor", mind.odometry, 0.0)) if there else mind
        case Aligning() | Radial() | Tangent() | Orbiting():
            return _under_way(mind, anchor_range is not None)
        case Surveying("peer") | Listening() | Retreating():
            return _beside(mind)
        case _:
            return mind


def decides(mind: RobotState) -> bool:
    """Whether this is a tick for a new manoeuvre; the same for both robots, so that they choose together."""
    return mind.tick % active_sensing.stride(mind.briefing.mission) == 0


def _surveyed(mind: RobotState) -> RobotState:
    """Phase 1: what the ranges to the anchor leave possible, and whether that is enough.

    Where no hypothesis explains in which places the anchor was silent, its ranges mislead: then more of them
    are taken about the place of the last, as at first.
    """
    ranged = mind.log.ranges[-1].tick == mind.tick
    weighed = inference.own_anchor(mind)
    if weighed:
        mind = inference.with_own(mind, weighed)
    if _silent(mind) >= LOST * active_sensing.stride(mind.briefing.mission):
        return _homeward(mind)
    if not weighed or weighed[0].silence < MISLED + _by_drop_outs(mind):
        if not ranged:
            return _homeward(mind)
        return replace(mind, state=Straight("anchor", mind.odometry, mind.log.ranges[-1].range))
    mission = mind.briefing.mission
    if inference.settled(weighed, mission):
        kind: BranchKind = "circle" if len(mind.log.ranges) == 2 else "three-ranges"
        parted = mind.tick if mind.findings.parted is None else mind.findings.parted
        mind = replace(mind, findings=replace(mind.findings, branch_kind=kind, parted=parted))
        return _parted(mind)
    drive = active_sensing.alone(inference.held_alone(weighed), mission)
    return replace(mind, state=Surveying("anchor", drive))


def _by_drop_outs(mind: RobotState) -> float:
    """In log-likelihood: what as many drop-outs cost as there may be by now."""
    p = mind.briefing.mission.noise.drop_outs
    expected = p * (mind.tick + 1)
    return (expected + UNLUCKY * math.sqrt(expected)) * math.log(p) if p else 0.0


def _silent(mind: RobotState) -> int:
    """Ticks since the anchor was ranged."""
    return mind.tick - mind.log.ranges[-1].tick


def _homeward(mind: RobotState) -> RobotState:
    """Back to where the anchor was ranged last; all that is held of where it is, is doubted."""
    last = mind.log.ranges[-1].tick
    place = mind.log.pose(ORIGIN, last, mind.briefing.mission.period)
    findings = replace(mind.findings, own=(), met=None, pair=(), returns=mind.findings.returns + 1)
    return replace(mind, state=Homing(place), findings=findings)


def _parted(mind: RobotState) -> RobotState:
    """To the rendezvous, for the first time or again."""
    mu = phase2_orbit.orientation(mind.local_pose)
    return _under_way(replace(mind, state=Aligning(mind.odometry.heading - mu)), False)


def _under_way(mind: RobotState, ranged: bool) -> RobotState:
    """Phase 2, with what another range to the anchor adds; b goes on to survey where it waits."""
    mission = mind.briefing.mission
    weighed: Sequence[ScoredHypothesis] = ()
    if ranged and decides(mind) and (weighed := inference.own_anchor(mind)):
        mind = inference.with_own(mind, weighed)
        if isinstance(mind.state, Radial) and abs(phase2_orbit.orientation(mind.local_pose)) > OFF_RADIUS:
            return _parted(mind)
    assert isinstance(mind.state, Aligning | Radial | Tangent | Orbiting)
    state = phase2_orbit.onward(mind.state, mind.odometry, mind.start, mind.orbit, mission)
    patience: float = LOST * active_sensing.stride(mission)
    if mind.orbit.v == 0.0 and isinstance(state, Radial | Orbiting) and _silent(mind) >= patience:
        return _homeward(mind)
    if isinstance(state, Orbiting):
        since = state.since or mind.tick
        patience += mind.briefing.rendezvous.bound / mission.period
        if mind.orbit.v != 0.0 and mind.tick - since > patience and not mind.in_contact:
            return _homeward(mind)
        if mind.orbit.v != 0.0:
            drive = phase2_orbit.pursuit(mind.local_pose, mind.orbit, mission)
        elif weighed:
            drive = active_sensing.alone(inference.held_alone(weighed), mission, mind.orbit.radius)
        else:
            drive = REST if decides(mind) else state.drive or REST
        state = Orbiting(drive, since)
    return replace(mind, state=state)


# --- with the peer ------------------------------------------------------------------------------------


def _beside(mind: RobotState) -> RobotState:
    """Phase 3, by whether the peer, and for b its anchor, are in range."""
    stride = active_sensing.stride(mind.briefing.mission)
    match mind.state:
        case Retreating(_, since) if mind.tick - since < 2 * stride:
            return mind
        case Retreating():
            return replace(mind, state=Surveying("peer")) if mind.in_contact else _parted(mind)
        case _ if mind.briefing.role == "b" and _silent(mind) >= LOST_TOGETHER * stride:
            return _homeward(mind)
        case Surveying(_, drive) | Listening(drive) if not mind.in_contact:
            return replace(mind, state=Retreating(Controls(0.0 - drive.v, 0.0 - drive.omega), mind.tick))
        case _:
            return mind


def heard(mind: RobotState) -> RobotState:
    """What the robot is set to do once it has heard its peer, in range."""
    match mind.state:
        case Done() | Asleep():
            return mind
        case Surveying("anchor") | Straight() | Backing() | Turning() | Circling() | Homing():
            return mind
        case _ if mind.radio.start is None:
            return mind
        case Retreating():
            return mind
        case Surveying("peer") | Listening() if not decides(mind):
            return mind
        case _ if not inference.answered(mind):
            return replace(mind, state=Listening())
        case _:
            return _considered(mind)


def _considered(mind: RobotState) -> RobotState:
    """Both logs in hand: weigh the hypotheses; then claim, or plan what both do next."""
    mission, role = mind.briefing.mission, mind.briefing.role
    if mind.findings.met is None:
        mind = replace(mind, findings=replace(mind.findings, met=mind.tick))
    pair = inference.pair_of(mind)
    mutual = pair.ranges.counts[2]
    if mutual < FEW:
        return _blindly(mind)
    known = mind.findings.pair
    searched = not known or any(mind.findings.sought < count <= mutual for count in SEARCHED)
    weighed = search(pair) if searched else follow(known, pair)
    if searched:
        mind = replace(mind, findings=replace(mind.findings, sought=mutual))
    checked = CHECKED_WITH_OUTLIERS if mission.noise.outliers else CHECKED
    judged = inference.with_pair(mind, weighed, pair, checked)
    if (judged.findings.missing is None or _against(judged, DOUBTFUL)) and not searched:
        weighed, searched = search(pair), True
        judged = inference.with_pair(mind, weighed, pair, checked)
    judged = inference.finished(judged, weighed)
    if searched:
        judged = _doubted(judged)
    if judged.verdict is not None:
        return judged
    few = len(pair.places) < 2 * checked
    if judged.findings.missing is None and not (few and _against(judged, WARY)):
        return claimed(judged)
    if role == "a" and len(pair.places) >= ENOUGH * (1 + mind.findings.returns):
        return _homeward(judged)
    if not weighed:
        return _blindly(judged)
    a, b = active_sensing.together(
        inference.held_together(weighed, pair), pair.apart, mind.mutual[-1].range, mission
    )
    return replace(judged, state=Surveying("peer", a if role == "a" else b))


def _against(mind: RobotState, bound: float) -> bool:
    """Whether what most speaks against the likeliest hypothesis is less probable than `bound`."""
    against = mind.findings.against
    return against is not None and against.p_value < bound


def _doubted(mind: RobotState) -> RobotState:
    """`mind`, after a search of the whole plane; alarmed, if its peer is beyond belief over and over."""
    findings = mind.findings
    against = findings.against
    if against is None:
        return mind
    least = min(against.p_value, findings.p_value if findings.p_value is not None else 1.0)
    doubts = findings.doubts + 1 if against.p_value < UNBELIEVABLE else 0
    mind = replace(mind, findings=replace(findings, doubts=doubts, p_value=least))
    return mind.alarmed(against.alarm) if doubts >= LOOKS else mind


def _blindly(mind: RobotState) -> RobotState:
    """While nothing is known of how the two lie: b stands, a goes straight on (Section III.C.a)."""
    mission = mind.briefing.mission
    if mind.briefing.role == "b" or not mind.mutual:
        return replace(mind, state=Surveying("peer"))
    step = range_seeking.stretch("peer", mind.mutual[-1].range, mission)
    return replace(mind, state=Surveying("peer", Controls(step / mission.period, 0.0)))


def claimed(mind: RobotState) -> RobotState:
    """The likeliest hypothesis is the one."""
    return replace(mind, state=Done(3, Localised(mind.findings.poses[0], mind.findings.covariance)))
