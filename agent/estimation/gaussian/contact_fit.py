"""The pose of a robot without an anchor, from noisy ranges to one that is localised.

The other robot, the finder, has sent its pose at a reference tick with a covariance, and its odometry from
then on. In one joint fit, the error of that pose is one unknown of three dimensions, with this covariance as
its prior. The other unknowns are the odometry errors of both robots, those of the ranges, and the start of
this robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from agent.estimation.fit import Fit, Start, deviation, fits
from agent.estimation.gaussian.beacon_guesses import beacon_guesses
from agent.estimation.gaussian.claim_rivals import WRONG_SIGMAS
from agent.estimation.gaussian.consistency import CLAIM_P_VALUE, EARLY_CLAIM_P_VALUE, chi2_p_value
from agent.estimation.gaussian.joint_claims import blocking_reason
from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges, PosePrior
from agent.estimation.gaussian.known_anchors import FEWEST_FOR_POSE, AnchoredRobot, scored_fits, start_of
from agent.estimation.gaussian.odometry_noise import Errors, Track
from agent.estimation.gaussian.own_sensors import DOUBTFUL_CLAIM, claim_profiles
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, Ranges
from agent.estimation.posterior import JointHypotheses, JointHypothesis, certainties, with_probability
from protocol.messages import Ranged
from protocol.mission import Mission
from protocol.motion import Covariance, Pose, rotated, wrap

FINDER, OWN = 0, 1
"""The places of the two robots in a fit."""

HOLDING = 1e-3
"""The sigma with which a coordinate of a rival is held, as a fraction of its distance from the claim."""

SMALLEST_EIGENVALUE = 1e-12
"""The smallest eigenvalue of a covariance that is accepted, as a fraction of its largest one."""

SAME_LEVEL = 0.05
"""The relative change of the noise level below which a fit is not repeated with it."""


class ContactRanges(NamedTuple):
    """The measurements of a robot without an anchor and of its finder; tick 0 is the reference."""

    pose: Pose
    """The pose of the finder at the reference tick, as it has estimated it."""
    covariance: Covariance
    """The covariance of the error of `pose`."""
    finder: Track
    """The odometry of the finder, as far as it is known."""
    own: Track
    """The odometry of this robot up to now."""
    ranges: tuple[Ranged, ...]
    """The ranges between the two at ticks that both paths have."""


class ContactEstimate(NamedTuple):
    """The poses of a robot without an anchor that are possible now, the most probable first."""

    poses: tuple[Pose, ...]
    probabilities: tuple[float, ...]
    covariance: Covariance
    """The covariance of the first pose."""
    blocking_reason: str
    """The first condition for a claim that is not met; empty if all are."""
    p_value: float
    """The p-value of the consistency test of the most probable pose."""


def is_definite(covariance: Covariance) -> bool:
    """Return whether the covariance of a report is positive definite, and can be inverted."""
    values = np.array(covariance.matrix)
    if not np.all(np.isfinite(values)):
        return False
    least, _, most = np.linalg.eigvalsh(values).tolist()
    return bool(least > max(SMALLEST_EIGENVALUE * most, SMALLEST_EIGENVALUE**2))


def estimated(contact: ContactRanges, mission: Mission) -> ContactEstimate | None:
    """Return the possible poses of this robot; None if there are too few ranges, or no pose explains them."""
    measured = _measured(contact, mission)
    if len(measured.ranges.rho) < FEWEST_FOR_POSE:
        return None
    found = with_probability(fits(measured, _starts(measured, mission)))
    if not found:
        return None
    level = found[0].fit.level
    if abs(level - 1.0) > SAME_LEVEL:  # the level is that of these measurements, not of the finder's pose
        measured = _with_level(measured, level)
        found = with_probability(fits(measured, [one.fit.start for one in found]))
    estimate = _estimate(found, measured, mission) if found else None
    return estimate if estimate is not None and _is_sendable(estimate) else None


def _is_sendable(estimate: ContactEstimate) -> bool:
    """Return whether the poses and their covariance are within the bounds of messages.

    They may be beyond them if the reported pose or its covariance is at a bound.
    """
    try:
        sent = msgspec.to_builtins((estimate.poses, estimate.covariance))
        msgspec.convert(sent, tuple[tuple[Pose, ...], Covariance])
    except msgspec.ValidationError:
        return False
    return True


def _measured(contact: ContactRanges, mission: Mission) -> JointMeasurements:
    """Return the measurements for a joint fit, relative to the finder's position at the reference tick."""
    noise, ranges = mission.noise, contact.ranges
    count = len(ranges)
    information = np.zeros((6, 6))
    information[:3, :3] = np.linalg.inv(np.array(contact.covariance.matrix))
    mean = np.zeros((2, 3))
    mean[FINDER, 2] = contact.pose.heading
    measured = JointMeasurements(
        ("finder", "own"),
        (),
        (("finder", "own"),),
        (contact.finder, contact.own),
        JointRanges(
            np.array([one.range for one in ranges], np.float64),
            np.array([one.tick for one in ranges], np.intp),
            np.full(count, max(noise.mutual_sigma, SIGMA_FLOOR)),
            np.zeros(count, np.intp),
            np.ones(count, np.intp),
            np.zeros((count, 2)),
            np.zeros(count, np.intp),
        ),
        mission.period,
        (contact.pose.x, contact.pose.y),
        noise,
        PosePrior(mean, information, 3),
    )
    return measured.thinned(mission.sensing_range)


def _starts(measured: JointMeasurements, mission: Mission) -> list[Start]:
    """Return the poses from which fits begin: intersections of the circles about the finder's places."""
    ranges, path, prior = measured.ranges, measured.paths[FINDER], measured.prior
    assert prior is not None
    c, s = math.cos(prior.mean[FINDER, 2]), math.sin(prior.mean[FINDER, 2])
    x, y = path.x[ranges.tick], path.y[ranges.tick]
    place = np.stack(rotated(c, s, x, y), 1)
    as_anchors = Ranges(
        ranges.rho, ranges.tick, ranges.sigma, (len(ranges.rho), 0, 0), place, np.zeros(len(x), np.intp)
    )
    robot = AnchoredRobot(measured.paths[OWN], as_anchors, mission.sensing_range, measured.noise)
    starts = []
    for one in scored_fits(robot, list(map(start_of, beacon_guesses(robot)))):
        poses = np.stack((prior.mean[FINDER], one.fit.start.poses[0]))
        nothing = Errors(np.zeros(0), np.zeros(0), np.zeros(0))
        starts.append(Start(poses, (nothing, *one.fit.start.errors)))
    return starts


def _with_level(measured: JointMeasurements, level: float) -> JointMeasurements:
    """Return `measured` with the prior in units of the noise level, by which the result is multiplied."""
    prior = measured.prior
    assert prior is not None
    return replace(measured, prior=prior._replace(information=level * prior.information))


# --- claims -----------------------------------------------------------------------------------------------


def _estimate(
    found: Sequence[JointHypothesis], measured: JointMeasurements, mission: Mission
) -> ContactEstimate:
    best = found[0].fit
    mine = slice(3 * OWN, 3 * OWN + 3)
    covariance = best.covariance[mine, mine]
    poses = [one.fit.poses[OWN].tolist() for one in found]
    p_value = chi2_p_value(best.chi2, best.freedom)
    xx, xy, xh, yy, yh, hh = [float(covariance[i, j]) for i in range(3) for j in range(i, 3)]
    return ContactEstimate(
        tuple([Pose(measured.origin[0] + x, measured.origin[1] + y, wrap(turn)) for x, y, turn in poses]),
        tuple([one.probability for one in found]),
        Covariance(xx, xy, xh, yy, yh, hh),
        _reason(found, measured, mission),
        p_value,
    )


def _reason(found: Sequence[JointHypothesis], measured: JointMeasurements, mission: Mission) -> str:
    """Return the first condition for a claim that is not met: those of pairs and of joint estimates."""
    joint = JointHypotheses((FINDER, OWN), tuple(found))
    own = certainties(joint)[OWN]
    reach, accuracy = mission.sensing_range, mission.accuracy
    reason = blocking_reason(OWN, joint, own, measured, reach, accuracy, mission.confidence)
    if reason:
        return reason
    best = found[0].fit
    least = EARLY_CLAIM_P_VALUE if best.freedom < EARLY_FREEDOM else CLAIM_P_VALUE
    level = max(best.level, 1.0)
    if chi2_p_value(best.chi2 / level, best.freedom) < least:
        return (
            f"the residuals are too large: chi-square {best.chi2:.3g} for {best.freedom} degrees of freedom"
        )
    return _rival(best, measured, mission) or _doubt(best, measured)


EARLY_FREEDOM = 13
"""The degrees of freedom below which EARLY_CLAIM_P_VALUE applies: those of 16 ranges, as in pairs."""


def _rival(best: Fit, measured: JointMeasurements, mission: Mission) -> str:
    """Return why poses that would make a claim wrong are likely, or an empty text; see `claim_rivals`.

    They are fits in which the start of this robot is held, to either side along the longest axis.
    """
    prior, i = measured.prior, 3 * OWN
    assert prior is not None
    variances, axes = np.linalg.eigh(best.covariance[i : i + 2, i : i + 2])
    along, far = axes[:, 1], WRONG_SIGMAS * deviation(float(np.sum(variances)))
    information = prior.information.copy()
    information[i : i + 2, i : i + 2] += np.outer(along, along) / (HOLDING * far) ** 2
    weights: list[float] = []
    for offset in (0.0, far, -far):
        mean = prior.mean.copy()
        mean[OWN, :2] = best.start.poses[OWN, :2] + offset * along
        held = replace(measured, prior=PosePrior(mean, information, prior.rank + 1))
        poses = best.start.poses.copy()
        poses[OWN, :2] = mean[OWN, :2]
        found = fits(held, [Start(poses, best.start.errors)])
        weights += [one.weight for one in found] or [math.inf]
    ratio = max(weights[1:]) - weights[0] if math.isfinite(weights[0]) else math.inf
    most = math.log1p(-mission.confidence)
    if ratio <= most:
        return ""
    return (
        f"poses {WRONG_SIGMAS:g} sigmas away explain the ranges nearly as well: "
        f"their log-likelihood ratio is {ratio:.3g}, allowed {most:.3g}"
    )


def _doubt(best: Fit, measured: JointMeasurements) -> str:
    """Return which profile explains the measurements much better than the given noise, or an empty text."""
    for name, other in claim_profiles(measured.noise):
        found = fits(replace(measured, noise=other), [Start(best.start.poses)])
        if any(again.weight - best.weight > DOUBTFUL_CLAIM for again in found):
            return f"the profile '{name}' explains the ranges and the odometry of both robots better"
    return ""
