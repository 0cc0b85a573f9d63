"""The hypotheses about poses in the form that planning and claims need: a mean and a covariance."""

from __future__ import annotations

import math
from functools import lru_cache

import msgspec
import numpy as np

from agent.estimation.compiled import address, library
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
    mean, covariance = hypothesis.poses.copy(), np.array(hypothesis.covariance, order="C")
    bx, by = mean[3] - m2[0], mean[4] - m2[1]
    ax, ay = mean[0] - mean[3], mean[1] - mean[4]
    ranges = [max(math.hypot(x, y), SIGMA_FLOOR) for x, y in ((bx, by), (ax, ay))]
    seen = np.array((bx, by, ranges[0], ranges[0] ** 2, ax, ay, ranges[1], ranges[1] ** 2))
    library().second_order(address(seen), address(mean), address(covariance))
    return PlanningHypothesis(hypothesis.probability, mean, covariance)
