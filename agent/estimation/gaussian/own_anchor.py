"""The hypotheses of a robot with noisy sensors about its own anchor, and the end of phase 1."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from msgspec.structs import replace

from agent.estimation.elementary import product
from agent.estimation.exact import Branch
from agent.estimation.fit import Fit, deviation
from agent.estimation.gaussian.evidence import anchor_evidence
from agent.estimation.gaussian.mission_measurements import LEAST_RANGES, own_measurements
from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.estimation.gaussian.search import of_anchor
from agent.estimation.knowledge import Knowledge, OwnAnchor
from agent.estimation.posterior import Hypothesis
from protocol.motion import Pose, compose, inverse, relative, wrap


def followed(knowledge: Knowledge) -> OwnAnchor | None:
    """Return what the ranges to the anchor say, with hypotheses; None if there is none."""
    own = own_measurements(knowledge)
    scored = of_anchor(knowledge.own_anchor.hypotheses, own) if len(own.ranges.rho) else ()
    if not scored:
        return None
    branches = tuple([branch_of(knowledge, one) for one in scored])
    fitted = len(knowledge.log.ranges)
    return replace(
        knowledge.own_anchor,
        hypotheses=scored,
        branches=branches,
        branch=branches[0],
        ranges_at_last_fit=fitted,
    )


def is_fit_due(knowledge: Knowledge) -> bool:
    """Return whether a robot that waits for its peer fits its anchor's hypotheses again."""
    hypotheses, before = knowledge.own_anchor.hypotheses, knowledge.own_anchor.ranges_at_last_fit
    if not hypotheses or hypotheses[0].probability < SURE_OF_BRANCH:
        return True
    return len(knowledge.log.ranges) - before >= min(FEW_MORE * before, MANY_MORE)


FEW_MORE, MANY_MORE = 0.25, 5
"""The number of new ranges for such a fit: a fraction of those fitted last, and at the most MANY_MORE.

A further range hardly moves a pose that follows from 20, and each search fits all of them. With more, a robot
whose odometry is noisy strays from its place; with less, the fits take most of the time of phase 2.
"""


def branch_of(knowledge: Knowledge, scored: Hypothesis) -> Branch:
    """Return the trajectory of `scored` as a branch, whose start and odometry lead to the present pose."""
    x, y, _ = scored.fit.start.poses[0].tolist()
    frame = math.atan2(y, x)
    now = relative(Pose(0.0, 0.0, frame), Pose(*scored.fit.poses[0].tolist()))
    start = compose(now, inverse(knowledge.odometry))
    return Branch(wrap(-frame), start)


def anchor_planning_hypotheses(knowledge: Knowledge) -> list[PlanningHypothesis]:
    """Return the hypotheses about the pose relative to the anchor, in the form that planning needs.

    Since their fits, the robot has moved by its odometry.
    """
    hypotheses = []
    for one, branch in zip(knowledge.own_anchor.hypotheses, knowledge.own_anchor.branches, strict=True):
        pose = compose(branch.start, knowledge.odometry)
        now = np.array((pose.x, pose.y, pose.heading))
        hypotheses.append(PlanningHypothesis(one.probability, now, _in_frame(one.fit, branch.alpha)))
    return hypotheses


@lru_cache(maxsize=8)
def _in_frame(fit: Fit, alpha: float) -> Array:
    """Return the covariance of the anchor's position in axes that are turned by `alpha` (rad); (2, 2)."""
    c, s = math.cos(alpha), math.sin(alpha)
    turn = np.array(((c, -s), (s, c)))
    return product(product(turn, fit.of_start[:2, :2]), turn.T)


def is_anchor_known(knowledge: Knowledge) -> bool:
    """Return whether the anchor's position is known well enough to end phase 1."""
    mission, best = knowledge.config.mission, knowledge.own_anchor.hypotheses[0]
    good = int(np.count_nonzero(best.fit.weights > 0.5))
    if good < LEAST_RANGES or best.probability < SURE_OF_BRANCH:
        return False
    share = SEARCHING_SIGMAS if knowledge.config.orbit.v != 0.0 else 1.0
    if _anchor_sigma(best.fit) > share * mission.required_anchor_sigma:
        return False
    if mission.noise.outliers or good >= ANCHOR_RANGES:
        return good >= (ANCHOR_RANGES_WITH_OUTLIERS if mission.noise.outliers else ANCHOR_RANGES)
    return anchor_evidence(best.fit, own_measurements(knowledge)) >= ANCHOR_EVIDENCE


def _anchor_sigma(fit: Fit) -> float:
    """Return the sigma (m) of the anchor's position relative to the start, or to the robot now if it is less.

    With noisy odometry, ranges tell less and less of where a robot started.
    """
    return deviation(float(min(np.trace(one[:2, :2]) for one in (fit.of_start, fit.covariance))))


SURE_OF_BRANCH = 0.999
"""The probability from which on a robot accepts a branch and ends phase 1.

A wrong branch does not lead to a wrong claim: all branches take part in the search of phase 3.
"""

SEARCHING_SIGMAS = 1.5
"""The largest sigma of the anchor's position with which a robot ends phase 1 to search for its peer.

It is in units of `required_anchor_sigma`. On the way out, two or three further ranges follow, which correct
the orbit, and later the mutual ranges correct the pose.
"""

ANCHOR_EVIDENCE = 20.0
"""The evidence against chance that ends phase 1 with fewer than ANCHOR_RANGES, without outliers.

Set on sigmas of 1e-9 to 0.1 m. With 7, three ranges of sigma 0.001 m ended phase 1, and 1 of 12 missions took
an honest peer for inconsistent: few ranges make every later test depend on the error of one. With more,
exact ranges take as many as noisy ones.
"""

ANCHOR_RANGES, ANCHOR_RANGES_WITH_OUTLIERS = 5, 6
"""The numbers of anchor ranges that end phase 1 without such evidence, without and with outliers.

Set on the sweep `noise`. With sigmas of R / 30 and more, ranges give little evidence: it would take twice as
many of them. With fewer, wrong branches reach phase 3, which takes longer; with more, phase 1 takes longer.
"""
