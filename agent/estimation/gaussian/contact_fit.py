"""The pose of a robot without an anchor, from noisy ranges to one that is localised.

The other robot, the finder, has sent its pose at a reference tick with a covariance, and its odometry from
then on. In one joint fit, the error of that pose is one unknown of three dimensions, with this covariance as
its prior. The other unknowns are the odometry errors of both robots, those of the ranges, and the start of
this robot.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from agent.estimation.claim import blocked
from agent.estimation.elementary import inverted
from agent.estimation.fit import TO_THE_END
from agent.estimation.gaussian.beacon_guesses import FEWEST_FOR_POSE
from agent.estimation.gaussian.consistency import chi2_p_value
from agent.estimation.gaussian.joint_ranges import JointMeasurements, PosePrior
from agent.estimation.gaussian.measured_rows import Listed, near_anchors
from agent.estimation.gaussian.odometry_noise import Track
from agent.estimation.gaussian.planning_hypotheses import localised, planning_hypothesis
from agent.estimation.gaussian.search import extended
from agent.estimation.judged import of_joint
from agent.estimation.posterior import NO_HYPOTHESES, Posterior, certainties, follow
from protocol.mission import Mission
from protocol.motion import Covariance, Pose

FINDER, OWN = 0, 1
"""The places of the two robots in a fit."""

SAME_LEVEL = 0.05
"""The relative change of the noise level below which a fit is not repeated with it."""


class ContactEstimate(NamedTuple):
    """The hypotheses about the pose of a robot without an anchor, the most probable first."""

    poses: tuple[Pose, ...]
    probabilities: tuple[float, ...]
    covariance: Covariance
    """The covariance of the first pose."""
    blocking_reason: str
    """The first condition for a claim that is not met; empty if all are."""
    p_value: float
    """The p-value of the consistency test of the most probable pose."""


def contact_measurements(
    pose: Pose, covariance: Covariance, paths: tuple[Track, Track], ranges: Listed, mission: Mission
) -> JointMeasurements:
    """Return the measurements of a finder and of a robot without an anchor; tick 0 is the reference.

    The finder has estimated its `pose` there, with this `covariance`; positions are relative to it. `paths`
    are the odometry of both, as far as this robot knows it, and `ranges` those between the two.
    """
    mean, information = np.zeros((2, 3)), np.zeros((6, 6))
    mean[FINDER, 2], information[:3, :3] = pose.heading, inverted(np.array(covariance.matrix))
    reach = mission.sensing_range
    measured = near_anchors(paths, ((), ()), ((0.0, 0.0), (0.0, 0.0)), mission.noise, reach, ranges)
    prior = PosePrior(mean, information, 3)
    return replace(measured, origin=(pose.x, pose.y), prior=prior).thinned(reach)


def estimated(measured: JointMeasurements, mission: Mission) -> ContactEstimate | None:
    """Return the hypotheses of this robot; None if there are too few ranges, or no pose explains them."""
    if len(measured.ranges.rho) < FEWEST_FOR_POSE:
        return None
    found = extended(NO_HYPOTHESES, measured)
    if OWN not in found.located:
        return None
    level = found.hypotheses[0].fit.level
    if abs(level - 1.0) > SAME_LEVEL:  # the prior in units of the level, which is not that of its covariance
        prior = measured.prior
        assert prior is not None
        measured = replace(measured, prior=prior._replace(information=level * prior.information))
        found = follow(found, measured, TO_THE_END)
    estimate = _estimate(found, measured, mission) if found.hypotheses else None
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


def _estimate(found: Posterior, measured: JointMeasurements, mission: Mission) -> ContactEstimate:
    best, certainty = found.hypotheses[0].fit, certainties(found)[OWN]
    claims = [localised(planning_hypothesis(one), OWN, measured.origin) for one in found.hypotheses]
    assert claims[0].covariance is not None
    blocking = blocked(
        of_joint("unanchored", OWN, found, certainty, measured, mission.accuracy, mission.confidence)
    )
    return ContactEstimate(
        tuple([one.pose for one in claims]),
        tuple([one.probability for one in found.hypotheses]),
        claims[0].covariance,
        blocking.reason if blocking is not None else "",
        chi2_p_value(best.chi2, best.freedom),
    )
