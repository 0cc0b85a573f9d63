"""The weights of ranges in a fit: the probability that each range is an inlier."""

from __future__ import annotations

import numpy as np

from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.range_model import inlier_probability
from protocol.noise import Noise

FAR = 32.0
"""The standard deviation of a range with the weight 0, in units of the longest range."""

BLIND = 1e-9
"""The least precision of a range's prediction, as a fraction of that with a known guess."""


def weighted_variance(sigma: Array, weights: Array, longest: float) -> Array:
    """Return the variance (m^2) of each range, which is large for a small weight; see FAR."""
    variance: Array = np.square(sigma) / np.maximum(weights, np.square(sigma / (FAR * longest)))
    return variance


def inlier_probabilities(
    multipliers: Array, alone: Array, explained: Array, variance: Array, sigma: Array, noise: Noise
) -> Array:
    """Return the probability that each range is an inlier, given the prediction from all other ranges.

    `multipliers` are the innovations times their inverse covariance, `alone` is the diagonal of that, and
    `explained` the part of it that the unknowns explain. `variance` is the own one of each range (m^2).
    """
    precision = np.maximum(alone - explained, BLIND * alone)
    spread = np.maximum(1.0 / precision - variance, 0.0) + np.square(sigma)
    return weights_by_errors(multipliers / precision, np.sqrt(spread), noise)


def weights_by_errors(errors: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier, if `errors` (m) have the scale of their median.

    Far from the minimum, all errors are large, and no range is an outlier because of that. At least about
    half of the ranges are therefore inliers.
    """
    if noise.sigma_degrees:
        ratios = np.abs(errors / sigma)
        middle = ratios.shape[-1] // 2
        median = np.partition(ratios, middle, -1)[..., middle, None]
        sigma = sigma * np.maximum(1.0, median / MEDIAN)
    return inlier_probability(errors, sigma, noise)


MEDIAN = 0.6745
"""The median of the absolute value of a standard normal variable."""
