"""The agreement of two poses of one robot that it has determined in different meetings."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian import inference
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Projection,
    constant_effects,
    constant_errors,
    is_noisy,
    spread,
    variances,
    wander,
)
from agent.peer.motion_log import MotionLog
from protocol.messages import Localised
from protocol.mission import Mission
from protocol.motion import Covariance, Pose, compose, inverse, wrap


class Difference(NamedTuple):
    """The difference of a pose from the one that follows from an earlier claim and the odometry since."""

    position: float
    """The distance of the positions in m."""
    heading: float
    """The difference of the headings in rad, not negative."""
    p_value: float
    """The probability of a difference that is as improbable, if both claims are right (chi-square test)."""


def difference(
    earlier: Localised, since: int, now: Localised, through: int, log: MotionLog, mission: Mission
) -> Difference:
    """Return the difference of the claim `now`, of tick `through`, from the claim `earlier`, of tick `since`.

    The errors of the two claims and of the odometry between them are taken as independent. Claims share the
    ranges to the robot's own anchor, so they differ by less: the p-value is too large rather than too small.
    """
    assert earlier.covariance is not None
    assert now.covariance is not None
    path = inference.path_of(log, through, mission.period)
    here, there = (
        Pose(float(path.x[tick]), float(path.y[tick]), float(path.heading[tick])) for tick in (since, through)
    )
    frame = compose(earlier.pose, inverse(here))
    expected = compose(frame, there)
    by_claim = np.eye(3)
    by_claim[0, 2], by_claim[1, 2] = earlier.pose.y - expected.y, expected.x - earlier.pose.x
    covariance = by_claim @ _matrix(earlier.covariance) @ by_claim.T + _matrix(now.covariance)
    noise = mission.noise
    if is_noisy(noise):
        still = np.zeros((2, len(path.v)))
        patterns = constant_errors(path.v, path.omega, noise)
        model = wander(path, still, patterns, variances(path.v, path.omega, noise.odometry)).since(since)
        rows = Projection.pose(path, through, frame.heading)
        constant = constant_effects(model, rows)[:-1]
        left, right = spread(model, rows)
        covariance += left.T @ right + constant.T @ constant
    off = np.array(
        (now.pose.x - expected.x, now.pose.y - expected.y, wrap(now.pose.heading - expected.heading))
    )
    chi2 = float(off @ np.linalg.solve(covariance, off))
    return Difference(math.hypot(off[0], off[1]), abs(float(off[2])), _tail(chi2))


def _matrix(covariance: Covariance) -> Array:
    """Return `covariance` as an array, (3, 3)."""
    xx, xy, xh, yy, yh, hh = (getattr(covariance, name) for name in Covariance.__struct_fields__)
    return np.array(((xx, xy, xh), (xy, yy, yh), (xh, yh, hh)))


def _tail(chi2: float) -> float:
    """Return the probability of a chi-square above `chi2` with three degrees of freedom."""
    root = math.sqrt(0.5 * max(chi2, 0.0))
    return math.erfc(root) + 2.0 / math.sqrt(math.pi) * root * math.exp(-root * root)
