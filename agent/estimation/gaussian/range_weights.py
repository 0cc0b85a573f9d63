"""The weights in a fit: the probability that each range is an inlier, and each tick of odometry no stray.

Like `smoother`, this is the text of a part of `smoother.c`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.noise_level import INLIER
from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.range_model import LARGEST_RATIO, mixture
from agent.estimation.smoother import Measured, Vector
from protocol.noise import Noise

FAR = 32.0
"""The standard deviation of a range with the weight 0, in units of the longest range."""

BLIND = 1e-9
"""The least precision of a range's prediction, as a fraction of that with a known guess."""

MEDIAN = 0.6745
"""The median of the absolute value of a standard normal variable."""

SOFT = 0.1
"""The least smoothing of the ends of the outlier density, as a fraction of the least bias."""


class Weighing(NamedTuple):
    """The quantities on which the weights of N ranges depend, besides their residuals."""

    sigma: Array
    """the standard deviation of each range in m; (N,)"""
    holding: Places
    """1 for a range that is no outlier: it has no error but a white one (see `JointRanges.radio`); (N,)"""
    by_radio: Places
    """the ranges, those of each pair of radios together; (N,)"""
    longest: float
    """the longest range in m: the size of the geometry"""
    inlier: float
    """logarithm of the probability of inliers, and of their density at 0, in units of sigma"""
    outlier: float
    """logarithm of the probability of outliers; minus infinity: there are none"""
    stray: float
    """logarithm of the probability of strays, and of their density in units of sigma"""
    astray: float
    """the probability that the odometry of a tick in motion is a stray"""
    astray_ratio: float
    """logarithm of the ratio of that to the probability of no stray; 0 if there are none"""
    least: float
    """the least bias of an outlier in m"""
    most: float
    """its largest bias"""
    degrees: float
    """degrees of freedom of the prior of the noise level; 0: it is 1"""
    free: int
    """number of unknowns of the start poses that only the ranges determine"""
    robust: bool
    """true if a range may be an outlier"""
    noisy: bool
    """true if odometry may differ from the executed motion"""

    @staticmethod
    def of(
        noise: Noise,
        sigma: Array,
        holding: Places,
        by_radio: Places,
        longest: float,
        *,
        free: int,
        noisy: bool,
    ) -> Weighing:
        """Return what the weights depend on, with the shares and densities of `noise`."""
        inlier, outlier, stray, least, most = mixture(noise).tolist()
        astray = noise.odometry_strays
        ratio = math.log(astray / (1.0 - astray)) if astray else 0.0
        return Weighing(
            *(sigma, holding, by_radio, longest, inlier, outlier, stray, astray, ratio, least, most),
            noise.sigma_degrees,
            free,
            bool(noise.outliers or noise.strays),
            noisy,
        )


def weighted_variance(by: Weighing, weights: Vector) -> Vector:
    """Return the variance (m^2) of each range, which is large for a small weight; see FAR."""
    found = []
    for sigma, weight in zip(by.sigma.tolist(), weights, strict=True):
        least = sigma / (FAR * by.longest)
        found.append(sigma * sigma / max(weight, least * least))
    return found


def inlier_probabilities(
    multipliers: Vector, alone: Vector, explained: Vector, variance: Vector, by: Weighing
) -> tuple[Vector, float]:
    """Return the weights and the scale of `weights_by_errors`, given the predictions from all other ranges.

    `multipliers` are the innovations times their inverse covariance, `alone` is the diagonal of that, and
    `explained` the part of it that the unknowns explain. `variance` is the own one of each range (m^2).
    """
    errors, spread = [], []
    for j, sigma in enumerate(by.sigma.tolist()):
        precision = max(alone[j] - explained[j], BLIND * alone[j])
        errors.append(multipliers[j] / precision)
        spread.append(math.sqrt(max(1.0 / precision - variance[j], 0.0) + sigma * sigma))
    return weights_by_errors(errors, spread, by)


def weights_by_errors(errors: Vector, sigma: Vector, by: Weighing) -> tuple[Vector, float]:
    """Return the probability that each range is an inlier, if `errors` (m) have the scale of their median.

    The second is that scale, in sigmas.

    Far from the minimum, all errors are large, and no range is an outlier because of that. At least about
    half of the ranges are therefore inliers.
    """
    if not by.robust or not errors:
        return [1.0] * len(errors), 1.0
    scale = 1.0
    if by.degrees:
        ratios = sorted([abs(error / spread) for error, spread in zip(errors, sigma, strict=True)])
        scale = max(1.0, ratios[len(ratios) // 2] / MEDIAN)
    weights = [
        1.0 if holds else _inlier_probability(error, scale * spread, by)
        for error, spread, holds in zip(errors, sigma, by.holding.tolist(), strict=True)
    ]
    return weights, scale


def _inlier_probability(error: float, sigma: float, by: Weighing) -> float:
    """Return the probability that a range with this error (m) is an inlier."""
    in_sigmas, width = error / sigma, by.most - by.least
    misfit = 0.5 * in_sigmas * in_sigmas
    beyond = (error - min(max(error, by.least), by.most)) / sigma
    wide = math.log(sigma / max(width, sigma)) + (by.outlier - by.inlier)
    ratio = log_sum(misfit - 0.5 * beyond * beyond + wide, misfit + (by.stray - by.inlier))
    return 1.0 / (1.0 + math.exp(min(ratio, LARGEST_RATIO)))


def log_sum(one: float, other: float) -> float:
    """Return the logarithm of the sum of the exponentials of both, of which one may be minus infinity."""
    larger, smaller = max(one, other), min(one, other)
    return larger + math.log1p(math.exp(smaller - larger))


def outlier_log_density(residuals: Vector, weights: Vector, by: Weighing) -> float:
    """Return the log-density of the residuals (m) of outliers and strays, and half their log-variances.

    The bias of an outlier is uniform, and the ends of its density are smoothed. A stray may be anywhere (see
    STRAY_WIDTH).
    """
    total, soft = 0.0, SOFT * by.least if by.outlier > -math.inf else 0.0
    for j, variance in enumerate(weighted_variance(by, weights)):
        if weights[j] > INLIER:
            continue
        sigma = max(float(by.sigma[j]), soft)
        beyond = max(by.least - residuals[j], residuals[j] - by.most, 0.0) / sigma
        wide = by.outlier - math.log(max(by.most - by.least, sigma))
        total += 0.5 * math.log(variance)
        total += log_sum(wide - 0.5 * beyond * beyond, by.stray - math.log(sigma))
    return total


# --- strays of the odometry -------------------------------------------------------------------------------


def weighted_noise(of: Measured, sound: Array) -> Array:
    """Return the variances of v and omega, (n, 2, K), if each tick is no stray with the probability `sound`.

    They are those of the mixture. With averaged precisions, as of ranges, a stray that two ticks explain
    equally well is none: in fits of two robots with 5 % strays, the NEES is 6.1 instead of 4.0.
    """
    if not of.strays:
        return of.white
    share = sound[:, None]
    return np.asarray(share * of.white + (1.0 - share) * of.stray, np.float64)


def sound_by_errors(of: Measured, by: Weighing, white: Array) -> Array:
    """Return where a fit begins: the probability that each tick with these `white` errors is no stray.

    Without errors, (n, 2, K), it is the prior. They are compared with the noise by which they were found.
    """
    sound = np.ones((of.robots, of.ticks * of.strays))
    for i, k in np.ndindex(sound.shape):
        ratio = by.astray_ratio
        for e in range(2):
            least, most, error = float(of.white[i, e, k]), float(of.stray[i, e, k]), float(white[i, e, k])
            if most > least:
                usual = (1.0 - by.astray) * least + by.astray * most
                ratio += 0.5 * error * error * (1.0 / usual - 1.0 / most)
        sound[i, k] = 1.0 / (1.0 + math.exp(min(ratio, LARGEST_RATIO)))
    return sound


def sound_probabilities(
    of: Measured, by: Weighing, before: Array, shocks: Array, white: Array, scale: float
) -> Array:
    """Return the probability that each tick is no stray, given the prediction from all other data.

    `shocks` are those of a step with the variances `white`; errors have the `scale` of those of ranges. The
    probability is the mean with the one `before`: neighbours, which explain the same ranges, would become
    strays in turn.
    """
    sound = np.ones((of.robots, of.ticks * of.strays))
    for i, k in np.ndindex(sound.shape):
        (v, omega), (most_v, most_omega) = of.white[i, :, k].tolist(), of.stray[i, :, k].tolist()
        if most_v > v or most_omega > omega:
            others = _others(shocks[i, k].tolist(), *white[i, :, k].tolist())
            ratio = (
                by.astray_ratio
                + _evidence(others, most_v, most_omega, scale)
                - _evidence(others, v, omega, scale)
            )
            sound[i, k] = 0.5 * (before[i, k] + 1.0 / (1.0 + math.exp(min(ratio, LARGEST_RATIO))))
    return sound


def _others(shock: Vector, v: float, omega: float) -> Vector:
    """Return what all other data tell of the errors in a tick, if `shock` is with the variances v and omega.

    It is exact for the linear model (P. de Jong and J. Penzer, "Diagnosing shocks in time series", 1998);
    nothing if rounding leaves nothing.
    """
    by_v, by_omega, vv, mixed, both = shock
    left_v, left_omega = 1.0 - vv * v, 1.0 - both * omega
    determinant = left_v * left_omega - mixed * omega * mixed * v
    if not determinant > 0.0:
        return [0.0] * 5
    return [
        (left_omega * by_v + mixed * omega * by_omega) / determinant,
        (mixed * v * by_v + left_v * by_omega) / determinant,
        (left_omega * vv + mixed * omega * mixed) / determinant,
        mixed / determinant,
        (mixed * v * mixed + left_v * both) / determinant,
    ]


def _evidence(others: Vector, v: float, omega: float, scale: float) -> float:
    """Return the log-likelihood of the variances v and omega; 0 if both are 0."""
    by_v, by_omega, vv, mixed, both = others
    a, b, c, d = 1.0 + v * vv, v * mixed, omega * mixed, 1.0 + omega * both
    determinant = a * d - b * c
    of_v, of_omega = d * v * by_v - b * omega * by_omega, a * omega * by_omega - c * v * by_v
    return 0.5 * (by_v * of_v + by_omega * of_omega) / determinant / (scale * scale) - 0.5 * math.log(
        determinant
    )
