"""The claim of a pose: one ordered tuple of conditions for all poses on which others rely.

Missions, meetings of groups, robots without an anchor and their finders, and estimates of recordings ask the
same conditions. Which of them concern whom, each condition says itself (`Condition.users`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

from agent.estimation.elementary import eigh
from agent.estimation.fit import Fit, deviation
from agent.estimation.gaussian.claim_rivals import WRONG_SIGMAS, Rival, likeliest_rival
from agent.estimation.gaussian.consistency import (
    CLAIM_P_VALUE,
    EARLY_CLAIM_P_VALUE,
    FINISHED,
    HIGHEST_LEVEL,
    Inconsistency,
    chi2_p_value,
    consistency_test,
)
from agent.estimation.gaussian.evidence import mutual_evidence
from agent.estimation.gaussian.inference import (
    PlanningHypothesis,
    localised,
    m2_of,
    pair_planning_hypotheses,
    to_second_order,
)
from agent.estimation.gaussian.joint_claims import (
    DISPLACED_SIGMAS,
    Displacement,
    decisive_ranges,
    open_position,
)
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.noise_level import INLIER
from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.own_sensors import contradiction
from agent.estimation.posterior import Certainty, Hypothesis, Posterior
from protocol.messages import Localised, RobotConfig
from protocol.mission import HEADING_ACCURACY
from protocol.noise import Noise

User = Literal["paper", "assured", "meeting", "finder", "unanchored", "recording"]
"""The kinds of robots that state a pose.

They are a robot of a pair with the planner `paper`, or `assured`, also in a group; one that confirms the pose
of an earlier meeting; a finder that passes its pose on; a robot without an anchor by its finder; a robot of a
recording.
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

EARLY_RANGES = 16
"""The number of mutual ranges below which EARLY_CLAIM_P_VALUE applies.

Few ranges leave room for a wrong hypothesis that fits by chance. With more, only CLAIM_P_VALUE counts. The
bound delays one of a hundred right claims by a few ticks.
"""

ENOUGH_FOR_HEADING = 20
"""The number of mutual ranges from different places after which HEADING_ACCURACY suffices for a claim.

More ranges may not make the heading more accurate: then the robot searches longer at the end of its way.
"""

LARGEST_STRAY_SHARE = 0.15
"""The largest fraction of ranges that may be strays, in addition to the outliers that were told."""

NORMAL_RATIO = -0.5 * WRONG_SIGMAS**2
"""The log-likelihood ratio of a rival where the likelihood is normal."""

MOST_WIDENED = 2.5
"""The largest factor by which a finder multiplies its covariance, to cover the likelihood of its rivals.

In a group whose fit was right, it was 1.6. With less, fewer robots are found in the first sweep; with more,
the ellipse has little to do with the likelihood.
"""

SMALLEST_EIGENVALUE = 1e-12
"""The smallest eigenvalue of a covariance that is accepted, as a fraction of its largest one."""


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


def is_definite(covariance: Array) -> bool:
    """Return whether a covariance, (3, 3), is positive definite, and can be inverted."""
    if not np.all(np.isfinite(covariance)):
        return False
    least, _, most = eigh(covariance)[0].tolist()
    return bool(least > max(SMALLEST_EIGENVALUE * most, SMALLEST_EIGENVALUE**2))


# --- what is judged -----------------------------------------------------------------------------------


class Judged(NamedTuple):
    """The estimate of a robot's pose, as the conditions for its claim see it."""

    user: User
    robot: int
    """The index in the fit of the robot that claims its pose."""
    fit: Fit
    """The fit of the most probable hypothesis."""
    measured: JointMeasurements
    """The measurements to which it is the fit."""
    origin: tuple[float, float]
    """The point of <W> (m) to which the poses of the fit are relative."""
    hypotheses: int
    """The number of hypotheses that differ in this robot's pose."""
    ranges: int
    """The number of ranges from different places."""
    required: int
    """The number of them that the claim needs."""
    stated: PlanningHypothesis
    """The poses of all robots, with the covariance of the claim and the probability of the robot's pose."""
    inconsistency: Inconsistency | None
    """The consistency test of the fit; None if there are too few ranges."""
    accuracy: float
    """The largest sigma (m) of a position."""
    headings: tuple[tuple[int, str, float], ...]
    """The poses that have to be accurate: index, whose, and the largest sigma (rad) of the heading."""
    confidence: float
    """The least probability of the pose."""
    rivals_of: tuple[int, ...] = ()
    """The robots of which rivals are looked for."""
    displaced: Displacement | None = None
    """The anchor that seems to stand elsewhere than it was surveyed, if one does."""

    @property
    def rival(self) -> Rival:
        """The likeliest rival of the claim."""
        return likeliest_rival(self.fit, self.measured, self.stated, self.rivals_of)

    @property
    def localised(self) -> Localised:
        """The pose and its covariance in <W>."""
        return localised(self.stated, self.robot, self.origin)


def of_pair(
    user: User,
    config: RobotConfig,
    scored: Sequence[Hypothesis],
    pair: JointMeasurements,
) -> Judged | None:
    """Return the estimate of one robot of a pair by the most probable of the hypotheses `scored`, if any."""
    if not scored:
        return None
    mission, role = config.mission, config.role
    robot, ids = (0, (config.robot, config.peer)) if role == "a" else (1, (config.peer, config.robot))
    places = len(pair.mutual_places)
    required = required_mutual_ranges(mission.noise) if user in FIRST_CLAIMS else 0
    own_heading = config.heading_accuracy if places < ENOUGH_FOR_HEADING else HEADING_ACCURACY
    best = scored[0]
    (first,) = pair_planning_hypotheses(scored[:1])
    return Judged(
        user=user,
        robot=robot,
        fit=best.fit,
        measured=pair,
        origin=(config.m1.x, config.m1.y),
        hypotheses=len(scored),
        ranges=places,
        required=required,
        stated=to_second_order(first, m2_of(config)),
        inconsistency=consistency_test(best.fit, pair, robot) if places >= required else None,
        accuracy=mission.accuracy,
        headings=tuple([(i, f"{ids[i]}'s", own_heading if i == robot else HEADING_ACCURACY) for i in (0, 1)]),
        confidence=mission.confidence,
        rivals_of=(robot,),
    )


def of_joint(
    user: User,
    robot: int,
    found: Posterior,
    certainty: Certainty,
    measured: JointMeasurements,
    accuracy: float,
    confidence: float,
) -> Judged:
    """Return the estimate of the robot with the index `robot` among those that the fits `found` have.

    `certainty` is that of its pose; `measured` are the measurements of all these robots.
    """
    fit, free = found.hypotheses[0].fit, found.hypotheses[0].fit.freedom
    return Judged(
        user=user,
        robot=robot,
        fit=fit,
        measured=measured,
        origin=measured.origin,
        hypotheses=certainty.poses,
        ranges=decisive_ranges(robot, measured),
        required=sufficient_mutual_ranges(measured.noise),
        stated=PlanningHypothesis(certainty.probability, fit.poses.ravel(), fit.covariance),
        inconsistency=Inconsistency(
            f"chi-square {fit.chi2:.3g} for {free} degrees of freedom",
            0.0,
            chi2_p_value(fit.chi2 / min(max(fit.level, 1.0), HIGHEST_LEVEL), free),
        ),
        accuracy=accuracy,
        headings=((robot, "the", HEADING_ACCURACY),),
        confidence=confidence,
        rivals_of=(robot,),
    )


# --- the conditions -----------------------------------------------------------------------------------


class Condition(NamedTuple):
    """A condition for a claim."""

    name: str
    users: frozenset[User]
    """The users whom it concerns."""
    blocks: Callable[[Judged], str]
    """Return why the condition is not met; an empty text if it is.

    Its docstring states the condition, with the constants of this module: docs/noise.md has it.
    """


def condition(*users: User) -> Callable[[Callable[[Judged], str]], Condition]:
    """Return a decorator that makes a function a condition, whose name it has."""
    return lambda blocks: Condition(blocks.__name__.replace("_", " "), frozenset(users), blocks)


@condition(*EVERYBODY)
def hypothesis(_: Judged) -> str:
    """A hypothesis explains the ranges."""
    return ""  # without one, there is nothing to judge: see `blocked`


@condition(*EVERYBODY)
def ranges(judged: Judged) -> str:
    """There are enough ranges from different places.

    They are {FEWEST_FOR_CLAIM} for a pair, {MUTUAL_RANGES} for others, and
    {MUTUAL_RANGES_WITH_OUTLIERS} with outliers; for a finder that was lost, a few new ones.
    """
    if judged.ranges >= judged.required:
        return ""
    return f"{judged.ranges} of {judged.required} required ranges from different places"


@condition(*EVERYBODY)
def probability(judged: Judged) -> str:
    """One hypothesis is left: its probability is at least the `confidence`."""
    found, required = judged.stated.probability, judged.confidence
    if found >= required:
        return ""
    many = f"the most probable of {judged.hypotheses} hypotheses"
    return f"{many} has probability {found:.6f}, required {required:g}"


@condition(*EVERYBODY)
def convergence(judged: Judged) -> str:
    """The fit has converged: a further step would be at most {FINISHED:g} sigmas long."""
    last = judged.fit.last_step
    return "" if last <= FINISHED else f"the fit has not converged: its last step is {last:.3g} sigmas"


@condition(*EVERYBODY)
def consistency(judged: Judged) -> str:
    """The residuals agree with the noise: the p-value of the test is at least {CLAIM_P_VALUE:g}."""
    found = judged.inconsistency
    assert found is not None
    return "" if found.p_value >= CLAIM_P_VALUE else f"the fit fails the consistency test: {found.what}"


@condition("unanchored", "recording")
def strays(judged: Judged) -> str:
    """The ranges that fit no other are at most {LARGEST_STRAY_SHARE:.0%}, and the outliers told."""
    own = judged.fit.weights[judged.measured.ranges.of(judged.robot)]
    total, count = len(own), int(np.count_nonzero(own <= INLIER))
    most = (LARGEST_STRAY_SHARE + judged.measured.noise.outliers) * total
    return "" if count <= most else f"{count} of {total} ranges fit no other"


@condition(*EVERYBODY)
def definite_covariance(judged: Judged) -> str:
    """The covariance is positive definite, in spite of rounding."""
    own = slice(3 * judged.robot, 3 * judged.robot + 3)
    definite = is_definite(judged.stated.covariance[own, own])
    return "" if definite else "rounding has made its covariance indefinite"


@condition("recording")
def determined_position(judged: Judged) -> str:
    """The sigma of the position is less than half of the longest range: else, the robot has no pose."""
    return open_position(judged.robot, judged.fit, judged.measured)


@condition(*FIRST_CLAIMS)
def position(judged: Judged) -> str:
    """The sigma of the position is at most the `accuracy`; in a pair, those of both robots."""
    for i, whose, _ in judged.headings:
        own = np.diagonal(judged.stated.covariance)[3 * i : 3 * i + 3]
        sigma = deviation(float(own[0] + own[1]))
        if not sigma <= judged.accuracy:
            return f"the sigma of {whose} position is {sigma:.3g} m, required {judged.accuracy:g}"
    return ""


@condition(*FIRST_CLAIMS)
def heading(judged: Judged) -> str:
    """The sigma of the heading is at most {HEADING_ACCURACY:g} rad, and less before a far visit."""
    for i, whose, required in judged.headings:
        sigma = deviation(float(judged.stated.covariance[3 * i + 2, 3 * i + 2]))
        if not sigma <= required:
            return f"the sigma of {whose} heading is {sigma:.3g} rad, required {required:.3g}"
    return ""


@condition("assured")
def evidence(judged: Judged) -> str:
    """Fewer ranges than {MUTUAL_RANGES} agree by chance with a probability of 1 - `confidence` at most."""
    if judged.ranges >= sufficient_mutual_ranges(judged.measured.noise):
        return ""
    found, required = mutual_evidence(judged.fit, judged.measured), -math.log1p(-judged.confidence)
    if found >= required:
        return ""
    return (
        f"the mutual ranges may agree by chance: the log evidence against it is {found:.3g}, "
        f"required {required:.3g}"
    )


@condition(*FIRST_CLAIMS)
def early_consistency(judged: Judged) -> str:
    """That p-value is at least {EARLY_CLAIM_P_VALUE:g} with fewer ranges than {EARLY_RANGES}."""
    found = judged.inconsistency
    assert found is not None
    if judged.ranges >= EARLY_RANGES or found.p_value >= EARLY_CLAIM_P_VALUE:
        return ""
    return f"the fit is too improbable for so few ranges: {found.what}"


@condition("recording")
def anchors(judged: Judged) -> str:
    """No anchor seems to stand {DISPLACED_SIGMAS:g} sigmas or more from where it was surveyed."""
    found = judged.displaced
    if found is None or found.sigmas < DISPLACED_SIGMAS:
        return ""
    return f"anchor {found.anchor} seems to stand elsewhere than surveyed: {found.what}"


@condition(*FIRST_CLAIMS)
def profiles(judged: Judged) -> str:
    """No profile of common sensors explains the measurements much better than the assumed noise."""
    found = contradiction(judged.fit, judged.measured)
    if found is None:
        return ""
    return found.reason("--noise {}" if judged.user == "recording" else 'noise = "{}"')


@condition("assured", "finder", "unanchored")
def rivals(judged: Judged) -> str:
    """Poses {WRONG_SIGMAS:g} sigmas away are at most 1 - `confidence` times as likely.

    A finder widens its covariance by up to {MOST_WIDENED:g} instead.
    """
    allowed = NORMAL_RATIO / MOST_WIDENED if judged.user == "finder" else math.log1p(-judged.confidence)
    ratio = judged.rival.log_likelihood_ratio
    if ratio <= allowed:
        return ""
    return (
        f"poses {WRONG_SIGMAS:g} sigmas away explain the ranges nearly as well: "
        f"their log-likelihood ratio is {ratio:.3g}, allowed {allowed:.3g}"
    )


BEFORE_SEARCH = (
    hypothesis,
    ranges,
    probability,
    convergence,
    consistency,
    strays,
    definite_covariance,
    determined_position,
    position,
    heading,
    evidence,
)
"""The conditions that a robot asks in each tick. If they hold, it searches the whole plane, and asks all."""

CONDITIONS = (*BEFORE_SEARCH, early_consistency, anchors, profiles, rivals)
"""All conditions for a claim, cheap ones first."""


class Blocked(NamedTuple):
    """The result of a claim for which a condition is not met."""

    condition: Condition
    reason: str


def blocked(judged: Judged | None, conditions: Sequence[Condition] = CONDITIONS) -> Blocked | None:
    """Return the first of the `conditions` that is not met, with the reason; None if all are.

    `judged` is None if there is no hypothesis.
    """
    if judged is None:
        return Blocked(hypothesis, "no hypothesis explains the ranges")
    for one in conditions:
        if judged.user in one.users and (reason := one.blocks(judged)):
            return Blocked(one, reason)
    return None


def claim(judged: Judged | None) -> Localised | Blocked:
    """Return the claim of a robot's pose in <W>, or the first condition that is not met."""
    if (found := blocked(judged)) is not None:
        return found
    assert judged is not None
    return judged.localised
