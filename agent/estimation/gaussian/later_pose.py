"""The pose of a robot by one of its meetings, with what it has measured itself since then."""

from __future__ import annotations

from msgspec.structs import replace

from agent.estimation.gaussian import inference
from agent.estimation.gaussian.consistency import CLAIM_P_VALUE, FINISHED, consistency_test
from agent.estimation.gaussian.contact_fit import is_definite
from agent.estimation.gaussian.hypotheses import follow, search
from agent.estimation.knowledge import Knowledge
from protocol.messages import Localised
from protocol.motion import Pose

MOST_LATER_FITS = 4
"""The most fits: after a long way, the steps of one do not suffice to correct the path."""


def later_pose(met: Knowledge, now: Knowledge) -> Localised | None:
    """Return the present pose by the meeting in which the robot claimed a pose; None if it is not known well.

    `met` is the robot's knowledge at that claim, and `now` has its later odometry and ranges to its anchor.
    Its heading in <W> follows from the meeting alone, but beside its anchor its position hardly depends on
    that. The conditions are those of a claim: after a search of the whole plane, one hypothesis is left, and
    its fit is consistent. Without the search, a fit after a long way was 0.3 m off, with a sigma of 0.02 m.
    """
    config = met.config
    own = 0 if config.role == "a" else 1
    met = replace(met, tick=now.tick, odometry=now.odometry, log=now.log)
    measured = inference.pair_of(met)
    known = tuple([one.hypothesis for one in search(measured, met.belief.pair)])
    for _ in range(MOST_LATER_FITS):
        scored = follow(known, measured)
        if not scored:
            return None
        known = tuple([one.hypothesis for one in scored])
        if scored[0].fit.last_step <= FINISHED:
            break
    best = scored[0]
    if best.hypothesis.probability < config.mission.confidence or best.fit.last_step > FINISHED:
        return None
    if consistency_test(best.fit, measured, own).p_value < CLAIM_P_VALUE:
        return None
    hypothesis = inference.pair_planning_hypotheses(scored[:1])[0]
    pose, covariance = inference.claim(hypothesis, own, measured)
    m1 = config.anchor if config.role == "a" else config.peer_anchor
    if not is_definite(covariance):
        return None
    return Localised(Pose(m1.x + pose.x, m1.y + pose.y, pose.heading), covariance)
