"""The estimate of a pose as the conditions for its claim see it: of a pair, or of any number of robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

from agent.estimation.fit import Fit, with_unscaled_priors
from agent.estimation.gaussian.claim_rivals import Rival, likeliest_rival
from agent.estimation.gaussian.consistency import (
    HIGHEST_LEVEL,
    chi2_p_value,
    consistency_test,
    rejecting_p_value,
)
from agent.estimation.gaussian.joint_claims import Displacement, decisive_ranges
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.planning_hypotheses import (
    PlanningHypothesis,
    localised,
    planning_hypothesis,
    to_second_order,
)
from agent.estimation.knowledge import Knowledge
from agent.estimation.posterior import Certainty, Hypothesis, Posterior
from protocol.messages import Inconsistent, Localised
from protocol.mission import HEADING_ACCURACY
from protocol.noise import Noise

User = Literal["paper", "assured", "meeting", "finder", "unanchored", "recording", "team"]
"""The kinds of robots that state a pose.

They are a robot of a pair with the planner `paper`, or `assured`, also in a group; one that confirms the pose
of an earlier meeting; a finder that passes its pose on; a robot without an anchor by its finder; a robot of a
recording; a robot of a team.
"""

EVERYBODY = frozenset(get_args(User))
FIRST_CLAIMS = EVERYBODY - {"meeting", "finder"}
"""The users that state a pose for the first time; the others have claimed one in a meeting before."""

FEWEST_FOR_CLAIM = 3
"""The number of mutual ranges for hypotheses, and before a claim of a pair.

With fewer, there are too many hypotheses, and no range checks them. How many more a claim needs depends on
their evidence.
"""

MUTUAL_RANGES, MUTUAL_RANGES_WITH_OUTLIERS = 8, 12
"""The numbers of mutual ranges from different places with which a claim needs no evidence against chance.

Set on the sweep `noise`, in which 1 of 30 000 missions was wrong. With sigmas of R / 30 and more, evidence
would need 11. With fewer ranges, claims are too often wrong; with more, each mission takes longer.
"""

EXACT_RANGES = 5
"""The number of ranges from different places with which a robot of an exact team without anchors claims.

Three ranges leave a few poses, and two more agree with a false one to 1e-6 m only by chance. With 8 ranges,
two robots take 7 instead of 4 ticks in the median; with 4, no fewer.
"""

ENOUGH_FOR_HEADING = 20
"""The number of mutual ranges from different places after which HEADING_ACCURACY suffices for a claim.

More ranges may not make the heading more accurate: then the robot searches longer at the end of its way.
"""


def required_mutual_ranges(noise: Noise) -> int:
    """Return the minimum number of mutual ranges from different places before a claim of a pair.

    With outliers, that a few ranges agree, one of which is an outlier, is not chance.
    """
    return MUTUAL_RANGES_WITH_OUTLIERS if noise.outliers else FEWEST_FOR_CLAIM


def sufficient_mutual_ranges(noise: Noise) -> int:
    """Return the number of mutual ranges from different places from which on evidence is not required.

    With fewer, no suspicion of the peer counts either: the tests of a few ranges repeat each other.
    """
    return MUTUAL_RANGES_WITH_OUTLIERS if noise.outliers else MUTUAL_RANGES


RECOMPARED = 1.1
"""The factor by which the time must have grown before parts of a robot's ranges are compared again.

Each comparison takes five joint fits. With less, estimates of many robots take a multiple of the time.
"""


class Judged(NamedTuple):
    """The estimate of a robot's pose, as the conditions for its claim see it."""

    user: User
    robot: int
    """The index in the fit of the robot that claims its pose."""
    fit: Fit
    """The fit of the most probable hypothesis."""
    measured: JointMeasurements
    """The measurements to which it is the fit."""
    hypotheses: int
    """The number of hypotheses that differ in this robot's pose."""
    ranges: int
    """The number of ranges from different places."""
    required: int
    """The number of them that the claim needs."""
    stated: PlanningHypothesis
    """The poses of all robots, with the covariance of the claim and the probability of the robot's pose."""
    inconsistency: Inconsistent | None
    """The consistency test of the fit; None if there are too few ranges."""
    accuracy: float
    """The largest sigma (m) of a position."""
    headings: tuple[tuple[int, str, float], ...]
    """The poses that have to be accurate: index, whose, and the largest sigma (rad) of the heading."""
    confidence: float
    """The least probability of the pose."""
    rejected: bool | None = None
    """True if that test of a pair counts against the peer; None if there are too few ranges for that."""
    rivals_of: tuple[int, ...] = ()
    """The robots of which rivals are looked for."""
    displaced: Displacement | None = None
    """The anchor that seems to stand elsewhere than it was surveyed, if one does."""
    disagreed: int = 0
    """The number of ticks at the latest disagreement of parts of the ranges; 0 if there was none."""
    compared: int = 0
    """The number of ticks at the latest comparison of parts of the ranges; 0 before the first."""

    @property
    def ticks(self) -> int:
        """The number of ticks so far."""
        return max([len(path.v) for path in self.measured.paths])

    @property
    def compares(self) -> bool:
        """True if parts of the ranges are to be compared now."""
        return self.ticks >= RECOMPARED * self.compared

    @property
    def rival(self) -> Rival:
        """The likeliest rival of the claim."""
        return likeliest_rival(self.fit, self.measured, self.stated, self.rivals_of)

    @property
    def localised(self) -> Localised:
        """The pose and its covariance in <W>; with exact sensors, without one."""
        found = localised(self.stated, self.robot, self.measured.origin)
        return Localised(found.pose) if self.measured.only_rounding else found


def of_pair(
    user: User, knowledge: Knowledge, scored: Sequence[Hypothesis], pair: JointMeasurements
) -> Judged | None:
    """Return the estimate of one robot of a pair by the most probable of the hypotheses `scored`, if any."""
    if not scored:
        return None
    config, mission = knowledge.config, knowledge.config.mission
    robot, ids = (0, (config.robot, config.peer)) if config.role == "a" else (1, (config.peer, config.robot))
    required = required_mutual_ranges(mission.noise) if user in FIRST_CLAIMS else 0
    enough = sufficient_mutual_ranges(mission.noise)
    places = len(pair.mutual_places)
    own_heading = config.heading_accuracy if places < ENOUGH_FOR_HEADING else HEADING_ACCURACY
    best = scored[0]
    test = consistency_test(best.fit, pair, robot) if places >= required else None
    counting = test if places >= enough else None
    return Judged(
        user=user,
        robot=robot,
        fit=best.fit,
        measured=pair,
        hypotheses=len(scored),
        ranges=places,
        required=required,
        stated=to_second_order(planning_hypothesis(best), knowledge.m2),
        inconsistency=test,
        accuracy=mission.accuracy,
        headings=tuple([(i, f"{ids[i]}'s", own_heading if i == robot else HEADING_ACCURACY) for i in (0, 1)]),
        confidence=mission.confidence,
        rejected=None if counting is None else counting.p_value < rejecting_p_value(mission.noise),
        rivals_of=(robot,),
    )


def misfit(fit: Fit) -> Inconsistent:
    """Return the test of the residuals of a fit, which is that of all its robots."""
    return Inconsistent(
        f"chi-square {fit.chi2:.3g} for {fit.freedom} degrees of freedom",
        0.0,
        chi2_p_value(fit.chi2 / min(max(fit.level, 1.0), HIGHEST_LEVEL), fit.freedom),
    )


def of_joint(
    user: User,
    robot: int,
    found: Posterior,
    certainty: Certainty,
    measured: JointMeasurements,
    accuracy: float,
    confidence: float,
    disagreed: int = 0,
    compared: int = 0,
) -> Judged:
    """Return the estimate of the robot with the index `robot` among those that the fits `found` have.

    `certainty` is that of its pose; `measured` are the measurements of all these robots.
    """
    fit = found.hypotheses[0].fit
    if user == "recording":
        fit = with_unscaled_priors(fit)
    exact = measured.only_rounding and bool(measured.started)
    return Judged(
        user=user,
        robot=robot,
        fit=fit,
        measured=measured,
        hypotheses=certainty.poses,
        ranges=decisive_ranges(robot, measured),
        required=EXACT_RANGES if exact else sufficient_mutual_ranges(measured.noise),
        stated=PlanningHypothesis(certainty.probability, fit.poses.ravel(), fit.covariance),
        inconsistency=misfit(fit),
        accuracy=accuracy,
        headings=((robot, "the", HEADING_ACCURACY),),
        confidence=confidence,
        rivals_of=(robot,),
        disagreed=disagreed,
        compared=compared,
    )
