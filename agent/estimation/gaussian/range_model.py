"""The likelihood of the residuals of ranges.

Outliers follow a mixture: a range is an inlier, or too long by a uniformly distributed bias.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from agent.estimation.elementary import exp, log, logaddexp
from agent.estimation.gaussian.odometry_noise import Array
from protocol.noise import Noise

SIGMA_FLOOR = 1e-6
"""The least standard deviation (m) that is assumed for a range."""


def log_likelihood(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the log-likelihood of the residuals (m), summed over the last axis."""
    good = inliers(residuals, sigma, noise)
    if not (noise.outliers or noise.strays):
        return np.asarray(np.sum(good, -1))
    return np.asarray(np.sum(logaddexp(good, outliers(residuals, sigma, noise)), -1))


def inlier_probability(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that the range of each residual (m) is an inlier."""
    if not (noise.outliers or noise.strays):
        return np.ones_like(residuals)
    ratio = outliers(residuals, sigma, noise) - inliers(residuals, sigma, noise)
    return np.asarray(1.0 / (1.0 + exp(np.minimum(ratio, LARGEST_RATIO))))


LARGEST_RATIO = 700.0
"""The log-ratio beyond which an exponential would overflow."""


def inliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the joint log-density of each residual and of its being an inlier."""
    density: Array = -0.5 * np.square(residuals / sigma) - log(sigma)
    return density + _log_inlier(noise)


def _log_inlier(noise: Noise) -> float:
    """Return the joint log-density of being an inlier and of a residual of 0, in units of sigma."""
    return math.log1p(-noise.outliers - noise.strays) - 0.5 * math.log(2.0 * math.pi)


@lru_cache(maxsize=8)
def mixture(noise: Noise) -> Array:
    """Return the densities of ranges as `Mixture` of hypotheses.c; shape (5,)."""
    outlier = math.log(noise.outliers) if noise.outliers else -math.inf
    stray = math.log(noise.strays / STRAY_WIDTH) if noise.strays else -math.inf
    return np.array((_log_inlier(noise), outlier, stray, *noise.outlier_bias))


def outliers(residuals: Array, sigma: Array, noise: Noise) -> Array:
    """Return the joint log-density of each residual and of its being an outlier or a stray.

    The bias of an outlier is uniform, and the ends of its density are smoothed by `sigma`. A stray may be
    anywhere (see STRAY_WIDTH).
    """
    stray = None
    if noise.strays:
        stray = np.broadcast_to(math.log(noise.strays / STRAY_WIDTH) - log(sigma), residuals.shape)
        if not noise.outliers:
            return stray
    least, most = noise.outlier_bias
    beyond = np.maximum(np.maximum(least - residuals, residuals - most), 0.0)
    density: Array = -log(np.maximum(most - least, sigma)) - 0.5 * np.square(beyond / sigma)
    density += math.log(noise.outliers)
    return density if stray is None else logaddexp(density, stray)


STRAY_WIDTH = 100.0
"""The width of the uniform density of strays, in sigmas of a range.

With the default rate of strays, a range is more probably a stray than not from 4.6 sigmas on.
"""
