"""The rate of strays, which robots learn: the told one is the mean of a beta distribution.

If ten of sixty ranges are strays already, another one tells little. With a fixed rate, a wrong hypothesis
that explains one stray more than the true one would be certain.
"""

from __future__ import annotations

import math

import numpy as np

from agent.estimation.gaussian.odometry_noise import Array
from protocol.noise import Noise

WORTH = 50.0
"""The number of ranges that the told rate is worth: the sum of the parameters of the beta distribution."""


def is_learned(noise: Noise) -> bool:
    """Return whether the rate is learned. It is not if a rate of outliers is told, which explains most."""
    return bool(noise.strays) and not noise.outliers


def expected_rate(weights: Array, noise: Noise) -> Array:
    """Return the expected rate of strays among ranges that are inliers with these probabilities.

    `weights` has the shape (..., N), and the result (..., 1).
    """
    strays = np.add.reduce(1.0 - weights, -1)[..., None]
    rate: Array = (WORTH * noise.strays + strays) / (WORTH + weights.shape[-1])
    return rate


def log_likelihood(strays: int, inliers: int, noise: Noise) -> float:
    """Return the log-likelihood of which ranges are strays, with their rate integrated out."""
    told = (WORTH * noise.strays, WORTH * (1.0 - noise.strays))
    return log_beta(told[0] + strays, told[1] + inliers) - log_beta(*told)


def log_beta(a: float, b: float) -> float:
    """Return the logarithm of the beta function."""
    return -(math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b))


def log_gain(strays: int, inliers: int, noise: Noise) -> float:
    """Return the log-likelihood of which ranges are strays, less that at the told rate."""
    if not is_learned(noise):
        return 0.0
    told = strays * math.log(noise.strays) + inliers * math.log1p(-noise.strays)
    return log_likelihood(strays, inliers, noise) - told
