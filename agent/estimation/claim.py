"""The claim of a pose: one ordered tuple of conditions for all poses on which others rely.

Missions, meetings of groups, robots without an anchor and their finders, and estimates of recordings ask the
same conditions. Which of them concern whom, each condition says itself (`Condition.users`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import eigh
from agent.estimation.fit import deviation
from agent.estimation.gaussian.claim_parts import disagreement
from agent.estimation.gaussian.claim_rivals import WRONG_SIGMAS
from agent.estimation.gaussian.consistency import (
    CLAIM_P_VALUE,
    EARLY_CLAIM_P_VALUE,
    FINISHED,
    constant_errors_p_value,
)
from agent.estimation.gaussian.evidence import mutual_evidence
from agent.estimation.gaussian.joint_claims import DISPLACED_SIGMAS, open_position
from agent.estimation.gaussian.noise_level import INLIER
from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.own_sensors import contradiction
from agent.estimation.judged import EVERYBODY, FIRST_CLAIMS, Judged, User, sufficient_mutual_ranges

EARLY_RANGES = 16
"""The number of mutual ranges below which EARLY_CLAIM_P_VALUE applies.

Few ranges leave room for a wrong hypothesis that fits by chance. With more, only CLAIM_P_VALUE counts. The
bound delays one of a hundred right claims by a few ticks.
"""

LARGEST_STRAY_SHARE = 0.15
"""The largest fraction of ranges that may be strays, in addition to the stated outliers."""

EARLY_SIGMAS = 3.0
"""The number of standard deviations by which ranges must be early for the odometry to be taken for late."""

NORMAL_RATIO = -0.5 * WRONG_SIGMAS**2
"""The log-likelihood ratio of a rival where the likelihood is normal."""

MORE_TIME = 1.5
"""The factor by which the time must have grown since parts of the ranges disagreed.

The ranges that follow at once repeat the errors of the last ones. Without it, 10 more claims of single robots
of MRCLAM 6 are wrong; with more, a claim takes longer after a disagreement by chance.
"""

MOST_WIDENED = 2.5
"""The largest factor by which a finder multiplies its covariance, to cover the likelihood of its rivals.

In a group whose fit was right, it was 1.6. With less, fewer robots are found when the area is covered for
the first time; with more, the ellipse has little to do with the likelihood.
"""

SMALLEST_EIGENVALUE = 1e-12
"""The smallest eigenvalue of a covariance that is accepted, as a fraction of its largest one."""


def is_definite(covariance: Array) -> bool:
    """Return whether a covariance, (3, 3), is positive definite, and can be inverted."""
    if not np.all(np.isfinite(covariance)):
        return False
    least, _, most = eigh(covariance)[0].tolist()
    return bool(least > max(SMALLEST_EIGENVALUE * most, SMALLEST_EIGENVALUE**2))


class Condition(NamedTuple):
    """A condition for a claim."""

    name: str
    users: frozenset[User]
    """The users whom it concerns."""
    last: bool
    """True if it is asked only when all others hold, after a search of the plane and a test of anchors."""
    blocks: Callable[[Judged], str]
    """Return why the condition is not met; an empty text if it is.

    Its docstring states the condition, with the constants of this module: docs/noise.md has it.
    """


def condition(*users: User, last: bool = False) -> Callable[[Callable[[Judged], str]], Condition]:
    """Return a decorator that makes a function a condition, whose name it has."""
    return lambda blocks: Condition(blocks.__name__.replace("_", " "), frozenset(users), last, blocks)


@condition(*EVERYBODY)
def hypothesis(_: Judged) -> str:
    """A hypothesis explains the ranges."""
    return ""  # without one, there is nothing to judge: see `blocked`


@condition(*EVERYBODY)
def ranges(judged: Judged) -> str:
    """There are enough ranges from different places.

    They are {FEWEST_FOR_CLAIM} for a pair, {MUTUAL_RANGES} for others, and
    {MUTUAL_RANGES_WITH_OUTLIERS} with outliers; {EXACT_RANGES} for an exact team without anchors; for a
    finder that was lost, a few new ones.
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
    return "" if found.p_value >= CLAIM_P_VALUE else f"the fit fails the consistency test: {found.claim}"


@condition("unanchored", "recording", "team")
def strays(judged: Judged) -> str:
    """The ranges that fit no other are at most {LARGEST_STRAY_SHARE:.0%}, and the outliers told."""
    own = judged.fit.weights[judged.measured.ranges.of(judged.robot)]
    total, count = len(own), int(np.count_nonzero(own <= INLIER))
    most = (LARGEST_STRAY_SHARE + judged.measured.noise.outliers) * total
    return "" if count <= most else f"{count} of {total} ranges fit no other"


@condition("recording")
def odometry_on_time(judged: Judged) -> str:
    """The learned delay of ranges is not {EARLY_SIGMAS:g} sigmas or more below 0.

    No range is measured after its stamp: then the odometry is late, and so are all poses.
    """
    delay, sigma = judged.fit.delay
    if delay >= -EARLY_SIGMAS * sigma:
        return ""
    return f"its odometry seems to be {-delay:.2g} s late, or its antenna to be further ahead than told"


@condition(*EVERYBODY)
def definite_covariance(judged: Judged) -> str:
    """The covariance is positive definite, in spite of rounding."""
    own = slice(3 * judged.robot, 3 * judged.robot + 3)
    definite = is_definite(judged.stated.covariance[own, own])
    return "" if definite else "rounding has made its covariance indefinite"


@condition("recording", "team")
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
    """The sigma of the heading is at most {HEADING_ACCURACY:g} rad, and less before a far visit.

    Ranges from one place contain no information about it, whatever rounding makes of that.
    """
    for i, whose, required in judged.headings:
        if not judged.measured.has_moved(i):
            return f"{whose} heading is undetermined: all ranges are from one place"
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


@condition(*FIRST_CLAIMS, last=True)
def early_consistency(judged: Judged) -> str:
    """That p-value is at least {EARLY_CLAIM_P_VALUE:g} with fewer ranges than {EARLY_RANGES}."""
    found = judged.inconsistency
    assert found is not None
    if judged.ranges >= EARLY_RANGES or found.p_value >= EARLY_CLAIM_P_VALUE:
        return ""
    return f"the fit is too improbable for so few ranges: {found.claim}"


@condition("recording", "team", last=True)
def anchors(judged: Judged) -> str:
    """No anchor seems to stand {DISPLACED_SIGMAS:g} sigmas or more from where it was surveyed."""
    found = judged.displaced
    if found is None or found.sigmas < DISPLACED_SIGMAS:
        return ""
    return f"anchor {found.anchor} seems to stand elsewhere than surveyed: {found.what}"


@condition(*FIRST_CLAIMS, last=True)
def profiles(judged: Judged) -> str:
    """No profile of common sensors explains the measurements much better than the assumed noise.

    Of exact sensors, which fit to rounding, a profile that learns a smaller noise would.
    """
    if judged.measured.only_rounding:
        return ""
    recorded = judged.user == "recording"
    found = contradiction(judged.fit, judged.measured, recorded=recorded)
    if found is None:
        return ""
    return found.reason("--noise {}" if recorded else 'noise = "{}"')


@condition(*EVERYBODY, last=True)
def constant_errors(judged: Judged) -> str:
    """The learned constant errors are not too large for what was told: p is at least {CLAIM_P_VALUE:g}.

    A fit explains false ranges by such errors, and its residuals show hardly anything of them.
    """
    p_value = constant_errors_p_value(judged.fit)
    if p_value >= CLAIM_P_VALUE:
        return ""
    return f"the fit needs larger constant errors than were told: p = {p_value:.2g}"


@condition("assured", "finder", "unanchored", "team", last=True)
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


@condition("recording", last=True)
def parts(judged: Judged) -> str:
    """The pose agrees with those without each half and each third of the robot's ranges, in their order.

    Each difference has a p-value of at least {CLAIM_P_VALUE:g}.
    """
    if not judged.compares:
        return ""
    found = disagreement(judged.fit, judged.robot, judged.measured)
    return "" if found.p_value >= CLAIM_P_VALUE else f"parts of the ranges disagree: {found.what}"


@condition("recording", last=True)
def parts_before(judged: Judged) -> str:
    """The time has grown by a factor of {MORE_TIME:g} since parts of the ranges disagreed last."""
    if judged.ticks >= MORE_TIME * judged.disagreed:
        return ""
    since = judged.measured.period * (judged.ticks - judged.disagreed)
    return f"parts of the ranges disagreed {since:.3g} s ago"


CONDITIONS = (
    hypothesis,
    anchors,
    ranges,
    probability,
    convergence,
    consistency,
    strays,
    odometry_on_time,
    definite_covariance,
    determined_position,
    position,
    heading,
    evidence,
    early_consistency,
    profiles,
    constant_errors,
    parts,
    parts_before,
    rivals,
)
"""All conditions for a claim, cheap ones first: which anchor is displaced has been found out before."""

BEFORE_SEARCH = tuple([one for one in CONDITIONS if not one.last])
"""The conditions that a robot asks in each tick. If they hold, it searches the whole plane, and asks all."""

WITHOUT_FITS = tuple([one for one in CONDITIONS if one not in (profiles, parts, rivals)])
"""The conditions that take no fits of their own: enough while something else holds back the claim."""


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
