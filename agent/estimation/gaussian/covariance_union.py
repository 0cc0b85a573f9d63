"""The pose that is right whichever of several estimates is, with a covariance that covers each of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.gaussian.claim_agreement import matrix, minus
from agent.estimation.gaussian.odometry_noise import Array
from protocol.messages import Localised
from protocol.motion import Covariance


def covariance_union(claims: Sequence[Localised]) -> Localised:
    """Return the last of `claims`, of one robot and tick, with a covariance that covers all of them.

    If one of them is right, and nobody knows which, the error of the last one is its own, or that of the
    right one and the difference of the two. So the covariance is at least C_i + d_i d_i^T for each claim i,
    where d_i is its difference from the last one (covariance union; Uhlmann 2003).
    """
    best = claims[-1]
    union = matrix(best)
    for one in claims[:-1]:
        off = minus(one.pose, best.pose)
        union = _larger(union, matrix(one) + np.outer(off, off))
    xx, xy, xh, yy, yh, hh = (float(union[j, k]) for j, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return Localised(best.pose, Covariance(xx, xy, xh, yy, yh, hh))


def _larger(one: Array, other: Array) -> Array:
    """Return the smallest matrix that is at least as large as both, which are positive definite."""
    root = np.linalg.cholesky(one)
    scaled = np.linalg.solve(root, np.linalg.solve(root, other).T)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    turned = root @ vectors
    return np.asarray((turned * np.maximum(values, 1.0)) @ turned.T)
