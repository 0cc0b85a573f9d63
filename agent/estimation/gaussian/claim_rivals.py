"""The rivals of a claim: the likeliest poses that are so far from it that it would be wrong.

The covariance of a fit describes the likelihood near its maximum. Where the poses that fit lie along a bent
valley, or where an outlier passes as an inlier because the fit has moved towards it, poses many sigmas away
may be nearly as likely as the claimed ones. They are found by fits in which one coordinate of a robot is held
there and everything else is free, the weights of the ranges included (a profile likelihood).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.estimation.elementary import eigh
from agent.estimation.fit import Fit, deviation, held_fits
from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges
from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis

WRONG_SIGMAS = 5.0
"""The number of claimed sigmas from which on the referee calls a claim wrong."""

HELD_STEPS = 5
"""The Gauss-Newton steps of a fit with a held coordinate.

The first one leads to the held place, and the weights of the ranges follow within two or three.
"""

FAR_ANCHOR = 1e3
"""The distance of an anchor to which a range holds a coordinate, in R: it measures along one direction."""

HOLDING_SIGMA = 1e-3
"""The sigma of that range, as a fraction of the distance from the claim at which it holds a coordinate."""


class Rival(NamedTuple):
    """The likeliest poses that would make a claim wrong."""

    robot: int
    """The robot whose claim they would make wrong: 0 or 1."""
    log_likelihood_ratio: float
    """The log-likelihood of all ranges under these poses, less that under the claimed ones."""
    hypothesis: PlanningHypothesis
    """The poses of both robots, for planning, with the covariance of the claimed ones.

    The probability is the likelihood ratio, and at most 1.
    """


@lru_cache(maxsize=2)
def likeliest_rival(
    fitted: Fit,
    measured: JointMeasurements,
    stated: PlanningHypothesis,
    robots: tuple[int, ...],
) -> Rival:
    """Return the likeliest rival of the claims of `robots` (indices) by the fit to what was `measured`.

    `stated` has the covariance of the claims. The coordinate that is held
    is that along the longest axis of the ellipse of a robot's position.
    """
    covariance, rivals = stated.covariance, []
    for robot in robots:
        i = 3 * robot
        variances, axes = eigh(covariance[i : i + 2, i : i + 2])
        along, far = axes[:, 1], WRONG_SIGMAS * deviation(float(np.sum(variances)))
        place, away, held = fitted.poses[robot, :2], FAR_ANCHOR * measured.reach, HOLDING_SIGMA * far
        lengths = ((away, 0), (away + far, HELD_STEPS), (away - far, HELD_STEPS))
        here, *there = held_fits(_holding(measured, robot, place - away * along, away, held), fitted, lengths)
        best = max(there, key=lambda one: one.log_likelihood)
        ratio = math.inf  # a claim whose own likelihood is not known may have any rival
        if math.isfinite(here.log_likelihood):
            ratio = best.log_likelihood - here.log_likelihood
        probability = math.exp(min(ratio, 0.0))
        poses = PlanningHypothesis(probability, best.poses.ravel(), fitted.covariance)
        rivals.append(Rival(robot, ratio, poses))
    return max(rivals, key=lambda one: one.log_likelihood_ratio)


def _holding(
    measured: JointMeasurements, robot: int, anchor: Array, rho: float, sigma: float
) -> JointMeasurements:
    """Return what was `measured` with one more range, which holds a coordinate of a robot.

    It is one of the last tick to an `anchor` (m) far away: the distance is `rho` (m), within `sigma` (m). No
    error that ranges have in common affects it.
    """
    more = JointRanges(
        np.array([rho]),
        np.array([len(measured.paths[robot].v)]),
        np.array([sigma]),
        np.array([robot]),
        np.array([-1]),
        anchor[None],
        np.array([-1]),
        np.array([False]),
    )
    return replace(measured, ranges=measured.ranges.then(more))
