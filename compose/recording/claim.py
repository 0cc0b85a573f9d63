"""A robot's claim to know its pose, held against where it was when it claimed."""

from __future__ import annotations

import msgspec

from protocol.messages import Localised
from protocol.motion import Covariance, Pose, wrap
from protocol.rounding import TOLERANCE
from world.referee import errors

DEGREES_OF_FREEDOM = 3
"""of a pose: what its NEES is in the mean, where covariances are true"""


class Claim(msgspec.Struct, frozen=True):
    """The first that a robot made, and how far off it was."""

    tick: int
    pose: Pose
    covariance: Covariance | None
    """none where sensors are exact"""
    position_error: float
    """m"""
    heading_error: float
    """rad"""
    nees: float | None
    """the normalised estimation error squared; none where there is no covariance"""


def claim(tick: int, said: Localised, truth: Pose) -> Claim:
    """What was `said` at `tick` by a robot that was at `truth`."""
    position, heading = errors(said.pose, truth)
    squared = nees(said.pose, truth, said.covariance) if said.covariance is not None else None
    return Claim(tick, said.pose, said.covariance, position, heading, squared)


def matrix(covariance: Covariance) -> list[list[float]]:
    """All of it: 3 x 3, of x, y and heading."""
    c = covariance
    return [[c.xx, c.xy, c.xh], [c.xy, c.yy, c.yh], [c.xh, c.yh, c.hh]]


def nees(estimate: Pose, truth: Pose, covariance: Covariance) -> float:
    """e^T P^-1 e, with e = (x, y, wrapped heading) of the error (Bar-Shalom, Li and Kirubarajan 2001, 5.4).

    An eigenvalue of P below the square of 1e-6 (m, rad) counts as that: no claim is held to be surer than
    what sensors that are exact are held to, and a P that is singular still tells what the error is worth.
    """
    import numpy as np  # noqa: PLC0415  # where sensors are exact, nothing is loaded for it

    error = np.array([estimate.x - truth.x, estimate.y - truth.y, wrap(estimate.heading - truth.heading)])
    variances, axes = np.linalg.eigh(np.array(matrix(covariance)))
    return float(((axes.T @ error) ** 2 / np.maximum(variances, TOLERANCE**2)).sum())
