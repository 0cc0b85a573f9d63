"""Under noise: how well a fit explains the ranges, and with it whether the peer can have told the truth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.least_squares import Fit
from agent.estimation.gaussian.range_model import PairRanges
from protocol.messages import Inconsistent

DOUBTFUL = 1e-3
"""less probable than this, a fit is not what a robot claims by: it takes more ranges"""

WARY = 1e-2
"""the same, while a robot has not got twice as many mutual ranges as a claim takes"""

UNBELIEVABLE = 2e-4
"""less probable than this, and so over again, it is not chance that the peer has against it"""

LOOKS = 5
"""searches of the whole plane, each with more ranges, before an alarm: one may have missed the truth"""


FINISHED = 0.1
"""sigmas: a fit whose last step was longer than this has not found its minimum"""


class Inconsistency(NamedTuple):
    """What speaks most against a fit."""

    what: str
    sigmas: float
    p_value: float

    @property
    def alarm(self) -> Inconsistent:
        """The same, as a verdict on the peer."""
        return Inconsistent(self.what, self.sigmas, self.p_value)


def doubt(fit: Fit, pair: PairRanges) -> Inconsistency:
    """The less probable of two: all residuals as they are, and the distance of the anchors that they imply.

    What a robot drove from its anchor to the encounter stands in no range of its own; it is the distance
    between the anchors, which is known, that it has to fit.
    """
    free = max(len(fit.residuals) - 6, 1)
    sigmas = _normal(fit.chi2, free)
    misfit = 0.5 * math.erfc(sigmas / math.sqrt(2.0))
    stretched = abs(_stretched(fit, pair)) if fit.last_step <= FINISHED else 0.0
    apart = math.erfc(stretched / math.sqrt(2.0))
    if apart < misfit:
        return Inconsistency(
            "a way that puts the anchors at another distance from each other", stretched, apart
        )
    what = f"what fits the ranges badly: chi-square {fit.chi2:.3g} for {free} degrees of freedom"
    return Inconsistency(what, max(sigmas, 0.0), misfit)


def _normal(chi2: float, free: int) -> float:
    """The chi-square of `free` degrees of freedom, as a standard normal variable (Wilson and Hilferty).

    Rounding may leave one below zero to a fit that has not found its minimum (see `inference.finished`).
    """
    spread = 2.0 / (9.0 * free)
    return float(((max(chi2, 0.0) / free) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread))


def _stretched(fit: Fit, pair: PairRanges) -> float:
    """Sigmas by which the ranges would have the anchors at another distance (the score test, Rao 1948)."""
    mutual = pair.ranges.rows(2)
    length = math.hypot(*pair.apart)
    c, s = math.cos(fit.guess[2]), math.sin(fit.guess[2])
    ux, uy = fit.directions[0][:, mutual]  # from b to a, in the frame of a's odometry
    by_distance = np.zeros(len(fit.residuals))
    by_distance[mutual] = -((c * ux - s * uy) * pair.apart[0] + (s * ux + c * uy) * pair.apart[1]) / length
    system = fit.system
    if system.covariance.ndim == 2:
        weighted = np.linalg.solve(system.covariance, by_distance)
    else:
        weighted = by_distance / system.covariance
    explained = system.jacobian.T @ weighted
    information = float(by_distance @ weighted - explained @ system.of_guess @ explained)
    score = float(by_distance @ system.multipliers)
    return score / math.sqrt(information) if information > LEAST else 0.0


LEAST = 1e-3
"""1 / m^2: the ranges then hardly tell the distance, and nothing follows"""
