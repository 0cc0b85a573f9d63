"""The hypotheses about poses in the form that planning and claims need: a mean and a covariance."""

from __future__ import annotations

import math
from functools import lru_cache

import msgspec
import numpy as np

from agent.estimation.elementary import product
from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.placement_guesses import STARTS
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.estimation.posterior import Hypothesis
from protocol.messages import Localised
from protocol.motion import Covariance, Pose, wrap


class PlanningHypothesis(msgspec.Struct, frozen=True, eq=False):
    """A hypothesis in the form that planning needs. What follows from one is computed once."""

    probability: float
    poses: Array
    """The poses in m and rad: (3,) of one robot relative to its anchor, or (6,) of a and b relative to M1."""
    covariance: Array
    """The covariance of the anchor's position, (2, 2), or of both poses, (6, 6)."""


@lru_cache(maxsize=STARTS)
def planning_hypothesis(one: Hypothesis) -> PlanningHypothesis:
    """Return a hypothesis about both poses relative to M1, in the form that planning needs."""
    return PlanningHypothesis(one.probability, one.fit.poses.ravel(), one.fit.covariance)


def localised(hypothesis: PlanningHypothesis, robot: int, origin: tuple[float, float]) -> Localised:
    """Return the pose of a robot in <W> and its covariance; `hypothesis` is relative to `origin` (m)."""
    own = slice(3 * robot, 3 * robot + 3)
    x, y, heading = hypothesis.poses[own].tolist()
    return Localised(
        Pose(origin[0] + x, origin[1] + y, wrap(heading)), covariance_of(hypothesis.covariance[own, own])
    )


def covariance_of(matrix: Array) -> Covariance:
    """Return a covariance of x, y (m) and heading (rad), (3, 3), as messages have it."""
    return Covariance(*matrix[TRIANGLE].tolist())


TRIANGLE = np.triu_indices(3)
"""The places of the elements of a covariance, (3, 3), that messages have."""


@lru_cache(maxsize=STARTS)
def to_second_order(hypothesis: PlanningHypothesis, m2: tuple[float, float]) -> PlanningHypothesis:
    """Return `hypothesis` with the mean and covariance of both poses if ranges and bearings are Gaussian.

    These are the range and the bearing of b from M2, and those of a from b.

    Both are computed to second order. If ranges are much more accurate than bearings, the possible positions
    form an arc, which a first-order ellipse does not cover. `m2` is the position of M2 relative to M1.
    """
    mean, covariance = hypothesis.poses.copy(), hypothesis.covariance
    bx, by = mean[3] - m2[0], mean[4] - m2[1]
    ax, ay = mean[0] - mean[3], mean[1] - mean[4]
    # gradients of range and bearing of b, then of a from b, with respect to the poses
    rows = np.zeros((4, 6))
    for k, (x, y), plus, minus in ((0, (bx, by), 3, None), (2, (ax, ay), 0, 3)):
        rho = max(math.hypot(x, y), SIGMA_FLOOR)
        for row, (gx, gy) in ((k, (x / rho, y / rho)), (k + 1, (-y / rho**2, x / rho**2))):
            rows[row, plus : plus + 2] = gx, gy
            if minus is not None:
                rows[row, minus : minus + 2] = -gx, -gy
    polar = product(product(rows, covariance), rows.T)
    polar = _limited(polar)
    second = np.zeros((6, 4, 4))
    for k, (x, y), moved in ((0, (bx, by), (0, 3)), (2, (ax, ay), (0,))):
        rho = max(math.hypot(x, y), SIGMA_FLOOR)
        for i in moved:
            second[i, k + 1, k + 1] = -x
            second[i + 1, k + 1, k + 1] = -y
            second[i, k, k + 1] = second[i, k + 1, k] = -y / rho
            second[i + 1, k, k + 1] = second[i + 1, k + 1, k] = x / rho
    scaled_curvature = product(second, polar)
    mean += 0.5 * np.trace(scaled_curvature, axis1=1, axis2=2)
    covariance = covariance + 0.5 * product(
        scaled_curvature.reshape(6, 16), scaled_curvature.mT.reshape(6, 16).T
    )
    return PlanningHypothesis(hypothesis.probability, mean, covariance)


def _limited(polar: Array) -> Array:
    """Limit the variance of each bearing to 1 rad^2: the expansion holds for small angles only."""
    scale = np.ones(4)
    for k in (1, 3):
        scale[k] = min(1.0, 1.0 / math.sqrt(max(polar[k, k], 1e-300)))
    limited: Array = polar * scale[:, None] * scale
    return limited
