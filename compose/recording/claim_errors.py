"""A robot's claim to be localised, compared with its true pose."""

from __future__ import annotations

import msgspec

from protocol.messages import Estimate, Localised
from protocol.mission import HEADING_ACCURACY
from protocol.motion import Covariance, Pose, wrap
from protocol.rounding import TOLERANCE
from world.referee import errors

DEGREES_OF_FREEDOM = 3
"""The degrees of freedom of a pose, which is the mean NEES if the covariances are true."""
HELD_WITHIN = 3.0
"""The factor of the required accuracies of position and heading within which a hypothesis is the true one."""
HELD_SIGMAS = 6.0
"""The Mahalanobis distance within which the claimed hypothesis is the true one."""


class Claim(msgspec.Struct, frozen=True):
    """The standing claim of a robot, which it has not withdrawn, with its errors in the tick of the claim."""

    tick: int
    """Tick of the claim."""
    pose: Pose
    """Claimed pose in m and rad."""
    covariance: Covariance | None
    """Claimed covariance; None if sensors are exact."""
    position_error: float
    """Distance in m from the true position."""
    heading_error: float
    """Absolute difference in rad from the true heading."""
    nees: float | None
    """Normalised estimation error squared; None without a covariance."""


def claim(tick: int, verdict: Localised, truth: Pose) -> Claim:
    """Return the claim that `verdict` makes at `tick`, with its errors from the true pose `truth`."""
    position, heading = errors(verdict.pose, truth)
    squared = nees(verdict.pose, truth, verdict.covariance) if verdict.covariance is not None else None
    return Claim(tick, verdict.pose, verdict.covariance, position, heading, squared)


def truth_held(estimate: Estimate, truth: Pose, accuracy: float) -> bool | None:
    """Return whether the true pose `truth` is among the hypotheses of `estimate`; None with exact sensors.

    It is, if a pose differs by at most 3 x `accuracy` in m and 3 x HEADING_ACCURACY in rad. The first pose,
    whose covariance is known, may also differ by up to 6 sigmas.
    """
    if not estimate.probabilities or not estimate.world:
        return None
    if estimate.covariance is not None and (
        nees(estimate.world[0], truth, estimate.covariance) <= HELD_SIGMAS**2
    ):
        return True
    for pose in estimate.world:
        position, heading = errors(pose, truth)
        if position <= HELD_WITHIN * accuracy and heading <= HELD_WITHIN * HEADING_ACCURACY:
            return True
    return False


def nees(estimate: Pose, truth: Pose, covariance: Covariance) -> float:
    """Return the NEES e^T P^-1 e, where e is the error (x, y, wrapped heading) and P the covariance.

    See Bar-Shalom, Li and Kirubarajan 2001, section 5.4. Eigenvalues of P below TOLERANCE^2 are raised to it:
    TOLERANCE is the accuracy required with exact sensors, no claim counts as more certain than that, and a
    singular P has a NEES too.
    """
    import numpy as np  # noqa: PLC0415  # loaded only if there is a covariance

    error = np.array([estimate.x - truth.x, estimate.y - truth.y, wrap(estimate.heading - truth.heading)])
    variances, axes = np.linalg.eigh(np.array(covariance.matrix))
    return float(((axes.T @ error) ** 2 / np.maximum(variances, TOLERANCE**2)).sum())
