"""From the first range of each other to a verdict: phase 3 as the planner goes through it (Section III.C)."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.exact import PairObservation, weigh_placements
from agent.planning import paper, phase3_last_manoeuvre, precision
from agent.planning.phase2_orbit import Orbiting, off_anchor
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Standing, Waiting
from agent.planning.range_seeking import Straight, stretch
from agent.planning.state import WORDS, Done, RobotState
from protocol.messages import Inconsistent, Localised
from protocol.mission import SHORTEST_STEP

PEER_RESTS = (WORDS[Standing], WORDS[Waiting])
"""what it says then: two that move at once may do so in mirror image, and learn nothing"""


def meets(mind: RobotState) -> bool:
    """Whether phase 3 begins, once in contact: by the letter when both orbit, else as soon as it can."""
    if mind.briefing.variant == "paper":
        return isinstance(mind.state, Orbiting) and (mind.radio.phase == 3 or mind.radio.state == mind.doing)
    return mind.radio.phase == 3 or (mind.radio.start is not None and mind.off_anchor)


def lingers(mind: RobotState) -> bool:
    """Whether the robot stands still so as not to lose a peer with which phase 3 cannot begin yet.

    The peer is in phase 1, or has not been heard; or it is b, and too near its anchor.
    """
    return (
        mind.briefing.variant == "assured"
        and mind.in_contact
        and (mind.radio.start is None or mind.briefing.role == "a")
    )


def met(mind: RobotState) -> RobotState:
    """Phase 3 begins: b stops, a goes straight on (Section III.C.a)."""
    findings = replace(mind.findings, met=mind.tick)
    if mind.briefing.role == "b":
        return replace(mind, state=Standing(), findings=findings)
    rho = mind.mutual[-1].range if mind.mutual else mind.briefing.mission.sensing_range  # a drop-out
    if mind.briefing.mission.safety_distance and not _may_go(mind):
        return mind
    straight = Straight("peer", mind.odometry, rho)
    return replace(mind, state=straight, findings=findings)


def _may_go(mind: RobotState) -> bool:
    """Whether a knows that b stands, and is far enough from it to go straight on."""
    now = bool(mind.mutual) and mind.mutual[-1].tick == mind.tick == mind.radio.peer.through
    return now and stretch("peer", mind.mutual[-1].range, mind.briefing.mission) >= SHORTEST_STEP


def considered(mind: RobotState) -> RobotState:
    """Both logs in hand: weigh the placements; then claim, plan the last manoeuvre, or go on.

    Not before the peer has told of everything up to where this robot stands; and not twice of the same.
    """
    if not mind.briefing.mission.noise.exact:
        return mind if paper.waits(mind) else paper.considered(mind)
    assert isinstance(mind.state, Standing | Waiting)
    last = min(mind.tick, mind.radio.peer.through)
    if last < mind.log.moved() or last == mind.state.through:
        return mind
    return _settled(replace(mind, state=replace(mind.state, through=last)))


def _settled(mind: RobotState) -> RobotState:
    """The same, where sensors are exact.

    The letter looks at the encounter alone; `assured` also at what was ranged, and what was silent, before.
    """
    mission, variant, began = mind.briefing.mission, mind.briefing.variant, mind.findings.met
    assert began is not None
    sightings = mind.sightings(began if variant == "paper" else 0)
    ranged = [at for at in sightings if at.range is not None]
    away = [at for at in ranged if off_anchor(at.b, mind.briefing.rendezvous.b)]
    base = phase3_last_manoeuvre.base(away, precision.drift(mind))
    if base is None:  # yet; or, where a report was missed, b was still driving as a went straight
        again = isinstance(mind.state, Waiting) and mind.radio.state == WORDS[Standing]
        return met(mind) if again and variant == "assured" else mind
    if mind.findings.peer_anchor is None:
        mind = replace(mind, findings=replace(mind.findings, peer_anchor=precision.peer_anchor(mind)))
    off = precision.apart(mind)
    mind = _weighed(mind, sightings, base, off)
    left = mind.findings.placements
    checked = phase3_last_manoeuvre.redundant(ranged, base)
    if not left:
        return mind.alarmed(Inconsistent("a path that no placement brings together with the mutual ranges"))
    if checked and len(left) == 1 and precision.pinned_down(mind, left[0], ranged, off):
        return replace(mind, state=Done(3, Localised(mind.world_pose(left[0]))))
    mover = mind.briefing.role
    alone = variant == "assured" and isinstance(mind.radio.verdict, Localised)  # the peer stands for good
    if not alone and mover != (
        phase3_last_manoeuvre.turn(sightings) if checked and variant == "assured" else "b"
    ):
        return mind
    if variant == "assured" and not alone and mind.radio.state not in PEER_RESTS:
        return mind
    if variant == "paper" and mind.findings.plan is not None:
        failure = "does not settle where they are" if checked else "could not be taken: b left a's range"
        return mind.undecided(f"the third mutual range {failure}")
    a, b = sightings[-1].a, sightings[-1].b
    if checked and len(left) == 1:
        plan = phase3_last_manoeuvre.survey(mover, a, b, left[0], sightings, mission)
    else:
        plan = phase3_last_manoeuvre.last_manoeuvre(mover, a, b, left, mission, variant)
    if plan is None:
        return mind if variant == "assured" else mind.undecided("no manoeuvre keeps the safety distance")
    return replace(
        mind,
        state=LastManoeuvre(plan.drive, mind.odometry),
        findings=replace(mind.findings, plan=plan),
    )


def _weighed(
    mind: RobotState,
    sightings: Sequence[PairObservation],
    base: tuple[PairObservation, PairObservation],
    floor: float,
) -> RobotState:
    """The placements of eq. (7) that every range and every silent tick in `sightings` leave."""
    reach, findings = mind.briefing.mission.sensing_range, mind.findings
    if findings.candidates is None:
        solutions = phase3_last_manoeuvre.solve(mind.briefing.anchor_distance, base)
        silence = [sighting for sighting in sightings if sighting.range is None]
        unheard = weigh_placements(solutions, silence, reach, floor)
        findings = replace(findings, placements=tuple(solutions), candidates=(len(solutions), len(unheard)))
    left = weigh_placements(findings.placements, sightings, reach, floor)
    return replace(mind, findings=replace(findings, placements=left))
