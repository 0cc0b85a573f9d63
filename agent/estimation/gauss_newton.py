"""The loop of a fit: Gauss-Newton steps and weights of ranges and odometry, until both have converged.

The weight of a range is the probability that it is an inlier, and that of a tick that its odometry is no
stray, given the prediction from all other data. Each step descends: where the full step does not, a shorter
one is tried.

Like `smoother`, this is the text of `smoother.c`, to which the kernel is equal to the bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.noise_level import INLIER, noise_level, residual_correlation
from agent.estimation.gaussian.range_weights import (
    Weighing,
    inlier_probabilities,
    outlier_log_density,
    sound_by_errors,
    sound_probabilities,
    weighted_noise,
    weighted_variance,
    weights_by_errors,
)
from agent.estimation.smoother import (
    Array,
    FitStep,
    Measured,
    Singular,
    Vector,
    Walk,
    dot,
    effect_of,
    loosened,
    step,
    walked,
)

FIT_STEPS = 8
"""The maximum number of Gauss-Newton steps."""

LAST_STEP = 3e-3
"""The expected length in sigmas of the next step from which on a step is the last.

Steps of Gauss-Newton decrease by a constant factor, about 0.1 with ranges of a tenth of their length. The
linear model is not computed again after the last step.
"""

LARGEST_STEP = 0.3
"""The largest change of a start position in one step, in units of the longest range."""

SHORTER_STEPS = (1.0, 0.5, 0.25, 0.0625)
"""The fractions of a step that are tried in turn until one descends.

Gauss-Newton with full steps may alternate between two guesses for ever.
"""

DESCENT = 1e-6
"""The increase of the cost, in units of chi-square, that is due to rounding."""

SETTLED_WEIGHT = 1e-2
"""The change of a weight below which the weights have converged."""

WEIGHT_DAMPING = 0.5
"""The factor of all further changes of a weight whenever its change has the other sign than the last one.

With 1, the weight of a range that may as well be an outlier alternates for ever, and the fit with it. With
less, weights come to rest before they are right. The first two changes, of long steps, are whole ones.
"""

RIDGE = 1e-12
"""The fraction of the information that is added to its diagonal, and an absolute part of the same size.

With it, the variance of an unknown that the ranges leave undetermined is large but finite.
"""

GRAIN = 1e-12
"""The least variance of a range, as a fraction of the largest one that the noise of the odometry leaves.

With less, RIDGE would be more than what inaccurate ranges tell beside exact ones: steps would be too short,
and variances too small.
"""

LEAST_VARIANCE = 1e-300
"""The variance of a white error that is 0."""


class Convergence(NamedTuple):
    """The conditions under which a fit has converged."""

    steps: int = FIT_STEPS
    """The maximum number of steps."""
    shortest: float = LAST_STEP
    """A step is the last if the next one is expected to be shorter, in sigmas."""
    decrease: float = 1.0
    """The factor by which the second step is expected to be shorter than the first: below 1 if starts are
    fits to almost the same ranges."""


class Point(NamedTuple):
    """Start poses and errors, with the ranges that they predict."""

    poses: Array
    """start poses in m and rad; (3 n,)"""
    common: Array
    """constant errors of ranges in their sigmas; (c,)"""
    constant: Array
    """constant errors of each robot's odometry in their sigmas; (n, m)"""
    white: Array
    """white errors of v and omega; (n, 2, K)"""
    slow: Array
    """slow errors of ranges in m; (N,)"""
    of_slow: Array
    """the slow errors times their inverse covariance; (N,)"""
    walk: Walk
    own: Array
    """residuals without the constant and slow errors of ranges in m; (N,)"""
    prior_cost: float
    """twice the negative log-density of all errors that have a prior, up to a constant"""

    def cost(self, variance: Vector) -> float:
        """Return twice the negative log-density of all errors; `variance` is that of each range (m^2)."""
        total = self.prior_cost
        for own, spread in zip(self.own.tolist(), variance, strict=True):
            total += own * own / spread
        return total


class Fitted(NamedTuple):
    """The end of the loop of a fit."""

    model: Point
    """the point of the last linear model"""
    final: Point
    """the point after the last step; `model` itself if the steps have not converged"""
    step: FitStep
    """the step from `model`"""
    weights: Array
    """the probability that each range is an inlier; (N,)"""
    variance: Array
    """own variance of each range in m^2; (N,)"""
    sound: Array
    """the probability that the odometry of each tick is no stray; (n, K), or (n, 0) if there are none"""
    last_step: float
    """expected length of the next step in sigmas"""
    level: float
    """estimate of the noise level tau^2"""
    inliers: int
    """number of ranges that are more probably inliers than outliers"""
    outliers: float
    """log-density of the residuals of all others, and half the logarithm of their variances"""


def point_at(
    of: Measured,
    poses: Array,
    common: Array,
    constant: Array,
    white: Array,
    slow: Array,
    of_slow: Array,
) -> Point:
    """Return the point with these start poses and errors."""
    walk, cost = walked(of, poses, constant, white, common[max(of.deep, 0) :]), 0.0
    for one in common.tolist():
        cost += one * one
    for one in constant.ravel().tolist():
        cost += one * one
    for one, variance in zip(white.ravel().tolist(), of.white.ravel().tolist(), strict=True):
        cost += one * one / max(variance, LEAST_VARIANCE)
    off = [of.mean[e] - poses[e] for e in range(len(poses))]
    for a in range(len(poses)):
        cost += off[a] * dot(of.information[a].tolist(), off)
    own = []
    for j in range(len(of.rho)):
        cost += slow[j] * of_slow[j]
        left = walk.residual[j]
        for e in range(len(common)):
            left -= effect_of(of, walk, j, e) * common[e]
        own.append(left - slow[j])
    return Point(poses, common, constant, white, slow, of_slow, walk, np.array(own), cost)


def guess(of: Measured, poses: Array) -> Array:
    """Return the pivots in the robots' frames (m) and the headings (rad) of start `poses`; (3 n,) each."""
    found = poses.copy()
    for i in range(of.robots):
        x, y, heading = poses[3 * i : 3 * i + 3].tolist()
        away_x, away_y = of.pivot[i, 0] - x, of.pivot[i, 1] - y
        if math.isnan(away_x):
            away_x, away_y = 0.0, 0.0
        c, s = math.cos(heading), math.sin(heading)
        found[3 * i] = c * away_x + s * away_y
        found[3 * i + 1] = c * away_y - s * away_x
    return found


def moved(of: Measured, poses: Array, change: Array) -> Array:
    """Return start `poses` after a `change` of the pivots in the robots' frames and of the headings.

    All have the shape (3 n,); see `smoother`.
    """
    after = guess(of, poses)
    for i in range(of.robots):
        mx, my, heading = (after[3 * i : 3 * i + 3] + change[3 * i : 3 * i + 3]).tolist()
        x, y = of.pivot[i].tolist()
        if math.isnan(x):
            x, y = poses[3 * i], poses[3 * i + 1]
        c, s = math.cos(heading), math.sin(heading)
        after[3 * i] = x - (c * mx - s * my)
        after[3 * i + 1] = y - (s * mx + c * my)
        after[3 * i + 2] = heading
    return after


def fitted(of: Measured, by: Weighing, begun: Point, weights: Array | None, until: Convergence) -> Fitted:
    """Return the fit that begins at `begun`; without `weights`, they follow from the residuals there.

    Raises Singular.
    """
    told, sound, before = of, sound_by_errors(of, by, begun.white), 0.0
    of, at = _weighed(told, sound, begun)
    loose = loosened(of, at.walk, at.poses, np.square(by.sigma)).tolist()
    least = GRAIN * max(loose, default=0.0) if by.noisy else 0.0
    if weights is None:
        weight, _ = weights_by_errors(at.walk.residual.tolist(), [math.sqrt(one) for one in loose], by)
    else:
        weight = weights.tolist()
    changed, damping = [0.0] * len(weight), [1.0] * len(weight)
    for number in range(until.steps + 1):
        variance = [one + least for one in weighted_variance(by, weight)]
        taken = _step(of, by, at, variance)
        updated, scale = inlier_probabilities(
            taken.multipliers.tolist(), taken.alone.tolist(), taken.explained.tolist(), variance, by
        )
        sounder = sound_probabilities(told, by, sound, taken.shocks, of.white, scale)
        level = noise_level(taken.chi2, _inliers(weight) - by.free, by.degrees)
        length = taken.length / math.sqrt(level)
        if number == 0:
            before = length / until.decrease
        expected = length * length / max(length, before, LAST_STEP)
        if number == until.steps:
            off = _off_model(at, taken, variance, level)
            return _ended(of, by, at, at, taken, weight, variance, sound, off if off > 1.0 else length)
        after = _stepped(of, at, taken, variance)
        still = all(abs(new - old) < SETTLED_WEIGHT for new, old in zip(updated, weight, strict=True))
        still = still and bool(np.all(np.abs(sounder - sound) < SETTLED_WEIGHT))
        # the path is corrected at least once
        still = still and (number > 0 or until.decrease < 1.0 or not by.noisy)
        if still and expected < until.shortest and _off_model(after, taken, variance, level) <= 1.0:
            return _ended(of, by, at, after, taken, weight, variance, sound, expected)
        for j, new in enumerate(updated):
            change = new - weight[j]
            if number > 1 and change * changed[j] < 0.0:
                damping[j] *= WEIGHT_DAMPING
            changed[j] = change
            weight[j] += damping[j] * change
        sound, before = sounder, length
        of, at = _weighed(told, sound, after)
    raise AssertionError("the last step returns")


def held(of: Measured, by: Weighing, begun: Point, weights: Array, steps: int) -> Fitted:
    """Return the fit after a number of full steps from `begun`, with the `weights` there.

    A range holds a coordinate, and the first step leads to where it holds it. All others are weighed by
    their residuals there. Raises Singular.
    """
    sound, weight = sound_by_errors(of, by, begun.white), weights.tolist()
    of, at = _weighed(of, sound, begun)
    for number in range(steps + 1):
        variance = weighted_variance(by, weight)
        taken = _step(of, by, at, variance)
        if number == steps:
            return _ended(of, by, at, at, taken, weight, variance, sound, taken.length)
        at = _after(of, at, taken, 1.0)
        if number == 0:
            loose = []
            for j, sigma in enumerate(by.sigma.tolist()):
                spread = sigma * sigma
                for e in range(of.common.shape[1]):
                    effect = effect_of(of, at.walk, j, e)
                    spread += effect * effect
                loose.append(math.sqrt(spread))
            weight, _ = weights_by_errors(at.walk.residual.tolist(), loose, by)
        else:
            weight, _ = inlier_probabilities(
                taken.multipliers.tolist(), taken.alone.tolist(), taken.explained.tolist(), variance, by
            )
    raise AssertionError("the last step returns")


def _weighed(told: Measured, sound: Array, at: Point) -> tuple[Measured, Point]:
    """Return the measurements with the noise of the odometry by its weights, and the point under it."""
    if not told.strays:
        return told, at
    of = told._replace(white=weighted_noise(told, sound))
    return of, point_at(of, *at[:6])


def _inliers(weight: Vector) -> int:
    return sum([one > INLIER for one in weight])


def _step(of: Measured, by: Weighing, at: Point, variance: Vector) -> FitStep:
    """Return the step from a point. Raises Singular."""
    found = step(of, at.walk, at.poses, np.array(variance), RIDGE, LARGEST_STEP * by.longest)
    if not math.isfinite(found.chi2):
        raise Singular("an error is too large for a float")
    return found


def _off_model(point: Point, taken: FitStep, variance: Vector, level: float) -> float:
    """Return the sigmas by which the errors at `point` exceed those of the linear model.

    The length of a step tells how far the start poses are from their optimum, but not how far the path is:
    where ranges are exact, the second order of a step of the path can leave residuals of thousands of their
    sigmas. More than one sigma is a step that the path still has to take.
    """
    return math.sqrt(max(point.cost(variance) - taken.chi2, 0.0) / level)


def _stepped(of: Measured, at: Point, taken: FitStep, variance: Vector) -> Point:
    """Return the point after a step, or after that fraction of it that descends; else `at`."""
    most = at.cost(variance) + DESCENT
    for fraction in SHORTER_STEPS:
        after = _after(of, at, taken, fraction)
        if after.cost(variance) <= most:
            return after
    return at


def _after(of: Measured, at: Point, taken: FitStep, fraction: float) -> Point:
    """Return the point after a `fraction` of a step."""
    n3, c = 3 * of.robots, of.common.shape[1]
    common, constant = taken.limited[n3 : n3 + c], taken.limited[n3 + c :].reshape(at.constant.shape)
    pairs = zip(at[1:6], (common, constant, taken.white, taken.slow, taken.own), strict=True)
    errors = [one + fraction * (other - one) if fraction < 1.0 else other for one, other in pairs]
    return point_at(of, moved(of, at.poses, fraction * taken.limited[:n3]), *errors)


def _ended(
    of: Measured,
    by: Weighing,
    model: Point,
    final: Point,
    taken: FitStep,
    weight: Vector,
    variance: Vector,
    sound: Array,
    last_step: float,
) -> Fitted:
    """Return the fit that has ended at `final`, with its noise level and the part of outliers in it."""
    inliers = _inliers(weight)
    level = noise_level(taken.chi2, inliers - by.free, by.degrees)
    if by.degrees:
        rows = by.by_radio.tolist()
        residuals, sigmas, radios = final.own[rows].tolist(), by.sigma[rows].tolist(), of.radio[rows].tolist()
        correlation = residual_correlation(residuals, [weight[j] for j in rows], sigmas, radios, level)
        level = noise_level(taken.chi2, inliers - by.free, by.degrees, correlation)
    outliers = outlier_log_density(final.walk.residual.tolist(), weight, by)
    weights = np.array(weight), np.array(variance), sound
    return Fitted(model, final, taken, *weights, last_step, level, inliers, outliers)
