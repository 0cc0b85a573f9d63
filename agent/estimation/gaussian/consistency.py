"""Consistency tests: whether the residuals of a fit are compatible with the noise and the known anchors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.least_squares import Fit
from agent.estimation.gaussian.range_model import PairRanges
from protocol.messages import Inconsistent

CLAIM_P_VALUE = 1e-3
"""The p-value below which a robot does not claim a pose, but measures more ranges."""

EARLY_CLAIM_P_VALUE = 1e-2
"""The CLAIM_P_VALUE of a robot with fewer than twice the mutual ranges that a claim requires."""

INCONSISTENT_P_VALUE = 2e-4
"""The p-value below which a search counts towards INCONSISTENT_SEARCHES.

It is so small that chance alone does not cause this many such searches in a row.
"""

INCONSISTENT_SEARCHES = 5
"""The number of consecutive inconsistent searches before a robot ends with `inconsistent`.

Each search covers the whole plane with more ranges than the last, because one search may miss the true
hypothesis.
"""


FINISHED = 0.1
"""The length in sigmas of the last step above which a fit has not reached its minimum."""


class Inconsistency(NamedTuple):
    """The least favourable test of a fit: a description, its sigmas and its p-value."""

    what: str
    sigmas: float
    p_value: float

    @property
    def verdict(self) -> Inconsistent:
        """Return the verdict on the peer for this result."""
        return Inconsistent(self.what, self.sigmas, self.p_value)


def consistency_test(fit: Fit, pair: PairRanges) -> Inconsistency:
    """Return the less probable of two tests: all residuals, and the distance between the anchors.

    The motion of a robot between its anchor and the encounter affects no single range. It is tested only by
    the distance between the anchors that the fit implies, because this distance is known.
    """
    free = max(len(fit.residuals) - 6, 1)
    sigmas = _normal(fit.chi2, free)
    p_residuals = 0.5 * math.erfc(sigmas / math.sqrt(2.0))
    score = abs(_distance_score(fit, pair)) if fit.last_step <= FINISHED else 0.0
    p_distance = math.erfc(score / math.sqrt(2.0))
    if p_distance < p_residuals:
        return Inconsistency("motion that implies another distance between the anchors", score, p_distance)
    what = (
        "measurements and reports that contradict each other: "
        f"chi-square {fit.chi2:.3g} for {free} degrees of freedom"
    )
    return Inconsistency(what, max(sigmas, 0.0), p_residuals)


def _normal(chi2: float, free: int) -> float:
    """Return a chi-square with `free` degrees of freedom as a standard normal variable (Wilson and Hilferty).

    Rounding may make the chi-square of a fit that has not reached its minimum negative (see
    FINISHED).
    """
    spread = 2.0 / (9.0 * free)
    return float(((max(chi2, 0.0) / free) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread))


def _distance_score(fit: Fit, pair: PairRanges) -> float:
    """Return by how many sigmas the ranges favour another distance of the anchors (score test, Rao 1948)."""
    mutual = pair.ranges.rows(2)
    length = math.hypot(*pair.apart)
    c, s = math.cos(fit.guess[2]), math.sin(fit.guess[2])
    ux, uy = fit.directions[0][:, mutual]  # from b to a, in the frame of a's odometry
    by_distance = np.zeros(len(fit.residuals))
    by_distance[mutual] = -((c * ux - s * uy) * pair.apart[0] + (s * ux + c * uy) * pair.apart[1]) / length
    system = fit.system
    weighted = system.covariance.solve(by_distance[:, None])[:, 0]
    explained = system.jacobian.T @ weighted
    information = float(by_distance @ weighted - explained @ system.of_guess @ explained)
    score = float(by_distance @ system.multipliers)
    return score / math.sqrt(information) if information > LEAST else 0.0


LEAST = 1e-3
"""The information (1 / m^2) below which the ranges do not determine the distance, and the score is 0."""
