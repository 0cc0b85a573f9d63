"""Least squares over all ranges of one robot or of both, with odometry noise along the path.

The unknowns are, for each robot, the position of its anchor in the frame of its odometry and the rotation of
that frame in <W>, and also the odometry errors at every tick. Because there are so many of the latter, the
fit is done in the space of the ranges, where odometry noise becomes a covariance between each two ranges.
Gauss-Newton, with the path corrected at each step, converges to the maximum a posteriori of the whole factor
graph. All fits to the same measurements are computed at once: the first axis of each array is the fit.

With exact odometry there is no such covariance, and the fit has only two or six unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian.linear_model import ErrorSizes, LinearModel, Point, Problem, Start, product
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    OdometryNoiseModel,
    Places,
    Projection,
    Ticks,
    Track,
    constant_effects,
    spread,
    symmetric,
)
from agent.estimation.gaussian.range_covariance import RangeCovariance, inverse_of, range_covariance
from agent.estimation.gaussian.range_model import Ranges, inlier_probability, outliers
from protocol.noise import Noise

STEPS = 8
"""The maximum number of Gauss-Newton steps."""

STILL = 3e-3
"""The expected length in sigmas of the next step from which on a step is the last.

Steps of Gauss-Newton decrease by a constant factor, about 0.1 with ranges of a tenth of their length. The
linear model is not computed again after the last step.
"""

COARSE_STILL = 0.05
"""The value of STILL for fits on which only the robot's way depends.

No claim does: each search fits all ranges again. With STILL, such a fit takes twice as long.
"""

WARM_DECREASE = 0.1
"""The expected decrease of the first step of a fit that begins at the last one, which has one range less."""

SETTLED = 1e-2
"""The change of a weight below which the weights have converged."""

LEAP = 1.0
"""The largest change of an unknown, in m and rad, in one step."""

SHORTER_STEPS = (0.5, 0.25, 0.0625)
"""The fractions of a step that are tried in turn if it does not descend.

Gauss-Newton with full steps may alternate between two guesses for ever.
"""

DESCENT = 1e-6
"""The increase of the cost, in units of chi-square, that is due to rounding."""

RIDGE = 1e-12
"""The fraction of the information that is added to its diagonal, and an absolute part of the same size.

With it, the variance of an unknown that the ranges leave undetermined is large but finite.
"""

FAR = 100.0
"""The standard deviation (m) of a range with the weight 0."""

BLIND = 1e-9
"""The least precision of a range's prediction, as a fraction of that with a known guess."""


class Fit(NamedTuple):
    """The most probable guess in the neighbourhood of the initial one, with its uncertainty."""

    guess: Array
    paths: tuple[Track, ...]
    """The paths with the odometry errors corrected."""
    errors: tuple[Errors, ...]
    """The estimated odometry errors of each path; empty if odometry is exact."""
    log_likelihood: float
    """The log-likelihood of the ranges, with all errors of the odometry and the noise level integrated out.

    With half the log-determinant of `covariance`, it is the evidence for the guess and its neighbourhood.
    """
    residuals: Array
    """The measured minus the predicted ranges (m); shape (N,)."""
    weights: Array
    """The probability that each range is an inlier; shape (N,)."""
    covariance: Array
    """The covariance of the guess: (2, 2) for one robot, whose rotation is not observable, or (6, 6)."""
    information: Array
    """The inverse of the covariance."""
    chi2: float
    """The squared innovations, weighted by their inverse covariance; as told, without `level`."""
    inliers: int
    """The number of ranges that are more probably inliers than outliers."""
    last_step: float
    """The expected length of the next Gauss-Newton step, in sigmas."""
    ticks: Places
    """The tick of each range; shape (N,)."""
    problem: Problem
    system: NormalEquations
    """The last linear model. Directions and covariances are those of the point where it was computed."""
    linear: Point
    """That point, before the last step, among those of other fits."""
    row: int
    """The row of this fit in that."""
    level: float
    """The estimate of the noise level tau^2: the factor by which all variances differ from the told ones."""

    @property
    def directions(self) -> Array:
        """The derivatives of the ranges with respect to the positions; see `Predicted`."""
        return np.asarray(self.linear.predicted.directions[self.row], np.float64)

    @property
    def linear_guess(self) -> Array:
        """The guess of the linear model."""
        return np.asarray(self.linear.guess[self.row], np.float64)

    @property
    def linear_paths(self) -> tuple[Track, ...]:
        """The paths of the linear model."""
        return self.problem.paths(self.linear, self.row)

    def __hash__(self) -> int:
        """Return the hash of this object."""
        return id(self)

    def __eq__(self, other: object) -> bool:
        """Return whether `other` is this fit itself: what follows from one fit is computed once."""
        return self is other

    def drift(self, robot: int) -> OdometryNoiseModel:
        """Return the noise model along the path of a robot; odometry is not exact."""
        return self.problem.drift(self.paths[robot], robot)

    def continued(self, path: Track) -> Fit:
        """Return the fit of one robot with its `path` up to a later tick, without a further range."""
        problem = Problem.of([path], self.problem.ranges, self.problem.noise, self.problem.apart)
        point = problem.begin([Start(self.guess, self.errors)])
        errors = problem.errors(point.sizes.constant[0], point.sizes.white[0])
        return self._replace(paths=problem.paths(point, 0), errors=errors, problem=problem)


class NormalEquations(NamedTuple):
    """One Gauss-Newton step in the space of the ranges."""

    jacobian: Array
    """The derivatives of the ranges with respect to the unknowns; shape (..., N, unknowns)."""
    innovation: Array
    """The difference (m) of the ranges from their prediction with uncorrected odometry; shape (..., N)."""
    covariance: RangeCovariance
    weighted: Array
    """The Jacobian and the innovation, multiplied by the inverse covariance; shape (..., N, unknowns + 1)."""
    information: Array
    of_guess: Array
    """The covariance of the guess, the inverse of the information."""
    change: Array
    """The change of the guess in this step."""
    multipliers: Array
    """The innovation that remains after the change, multiplied by the inverse covariance; shape (..., N)."""

    def one(self, i: int) -> NormalEquations:
        """Return those of the fit with index `i`."""
        jacobian, innovation, covariance, *others = self
        of_one = RangeCovariance(*[part[i] for part in covariance])
        return NormalEquations(jacobian[i], innovation[i], of_one, *[part[i] for part in others])


def fit(
    guess: Array,
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = STEPS,
    begun: Sequence[Errors] = (),
) -> Fit:
    """Return the one fit that begins at `guess`, with the odometry errors `begun`; see `fits`."""
    return fits([Start(guess, tuple(begun))], measured, ranges, noise, apart, steps)[0]


def fits(
    starts: Sequence[Start],
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
    steps: int = STEPS,
    *,
    shortest: float = STILL,
    decrease: float = 1.0,
) -> list[Fit]:
    """Return the Gauss-Newton fits that begin at `starts`, in this order.

    A step is the last if the next one is expected to be shorter than `shortest`. The second step is expected
    to be shorter than the first by the factor `decrease`, which is less than 1 for starts that are fits. A
    step that does not descend is shortened, because Gauss-Newton with full steps may alternate between two
    guesses. The weights of outliers decrease during the iteration. `apart` is M2 - M1 (m) in <W>.
    """
    if not starts:
        return []
    problem = Problem.of(measured, ranges, noise, apart)
    point = problem.begin(starts)
    weights = np.ones(point.residuals.shape)
    ended: dict[int, Fit] = {}  # by the index of the start
    left, before = list(range(len(starts))), np.zeros(len(starts))
    for step in range(steps + 1):
        linear = problem.linearised(point)
        if problem.robust and step == 0:
            weights = _first_weights(problem, starts, point, linear)
        variance = _variance(ranges.sigma, weights)
        covariance = range_covariance(variance, linear.columns, linear.dense)
        system = _solved(point.predicted.jacobian[..., problem.free], linear.innovation, covariance)
        updated = _inlier_probabilities(system, weights, ranges.sigma, noise) if problem.robust else weights
        quality = _quality(system, weights, noise)
        if step == 0:
            before = quality.last_step / decrease
        expected = np.square(quality.last_step) / np.maximum(np.maximum(quality.last_step, before), STILL)
        still = (expected < shortest) & (np.maximum.reduce(np.abs(updated - weights), -1) < SETTLED)
        still &= step > 0 or decrease < 1.0 or not problem.noisy  # the path is corrected at least once
        if step == steps:
            for i in left:
                ended[i] = _fit(problem, i, point, point, weights, system, quality)
            break
        change = system.change
        change = change * np.minimum(1.0, LEAP / np.maximum(np.abs(change).max(-1, keepdims=True), LEAP))
        following = point.guess.copy()
        following[:, problem.free] += change
        left_over = system.weighted[..., -1] - product(system.weighted[..., :-1], change)
        sizes = problem.sizes(point, linear, left_over)
        begun, point = point, _descended(problem, point, following, sizes, variance)
        # fits that have ended go on with the others: to leave them out takes longer
        done, at_end = still.tolist(), quality._replace(last_step=expected)
        for i in left:
            if done[i]:
                ended[i] = _fit(problem, i, point, begun, weights, system, at_end)
        left = [i for i in left if not done[i]]
        if not left:
            break
        weights, before = updated, quality.last_step
    return [ended[i] for i in range(len(starts))]


def _first_weights(problem: Problem, starts: Sequence[Start], point: Point, linear: LinearModel) -> Array:
    """Return the weights with which fits begin: those of their starts, or by their residuals."""
    weights = _weights(point.residuals, np.sqrt(problem.loosened(linear)), problem.noise)
    for i, start in enumerate(starts):
        if start.weights is not None:
            weights[i] = start.weights
    return weights


def without_outliers(
    starts: Sequence[Start],
    measured: Sequence[Track],
    ranges: Ranges,
    noise: Noise,
    apart: tuple[float, float] = (0.0, 0.0),
) -> list[Start]:
    """Return the `starts` under which some range is an outlier, with weights that leave these ranges out.

    The weights follow from the residuals and the sigmas of the ranges alone, as if the start were exact.
    Without them, a fit first allows for the uncertainty of the odometry too, which can explain an outlier
    and draw the fit away from the start.
    """
    problem = Problem.of(measured, ranges, noise, apart)
    if not (starts and problem.robust):
        return []
    sigma = np.sqrt(np.square(ranges.sigma) + ranges.loosened(noise.priors))
    weights = _weights(problem.begin(starts).residuals, sigma, noise)
    return [
        start._replace(weights=own) for start, own in zip(starts, weights, strict=True) if own.min() < INLIER
    ]


T = TypeVar("T")


def _of(values: T, some: NDArray[np.bool] | Places) -> T:
    """Return the part of `values`, a tuple of arrays or of such tuples, that belongs to some of the fits."""
    if isinstance(values, tuple):
        parts = [_of(value, some) for value in values]
        return cast("T", type(values)(*parts) if hasattr(values, "_fields") else tuple(parts))
    return cast("T", values[some]) if isinstance(values, np.ndarray) else values


def _put(values: object, some: NDArray[np.bool] | Places, others: object) -> None:
    """Replace the part of `values` that belongs to some of the fits by `others`."""
    if isinstance(values, tuple) and isinstance(others, tuple):
        for value, other in zip(values, others, strict=True):
            _put(value, some, other)
    elif isinstance(values, np.ndarray):
        values[some] = others


def _fit(
    problem: Problem,
    i: int,
    points: Point,
    linear_points: Point,
    all_weights: Array,
    systems: NormalEquations,
    qualities: _Quality,
) -> Fit:
    """Return the fit with index `i`, which has ended at its point, with the linear model of another."""
    residuals, weights, system = points.residuals[i], all_weights[i], systems.one(i)
    chi2, inliers, level = float(qualities.chi2[i]), int(qualities.inliers[i]), float(qualities.level[i])
    if problem.noise.sigma_degrees:
        correlation = residual_correlation(points.own[i], weights, problem.ranges)
        level = noise_level(chi2, inliers - len(system.change), problem.noise, correlation)
    return Fit(
        points.guess[i],
        problem.paths(points, i),
        problem.errors(points.sizes.constant[i], points.sizes.white[i]),
        _log_likelihood(system, chi2, residuals, weights, problem.ranges.sigma, level, problem.noise),
        residuals,
        weights,
        level * system.of_guess,
        system.information / level,
        chi2,
        inliers,
        float(qualities.last_step[i]),
        problem.ranges.tick,
        problem,
        system,
        linear_points,
        i,
        level,
    )


class _Quality(NamedTuple):
    """The agreement of the ranges with a linear model."""

    chi2: Array
    inliers: Array
    level: Array
    last_step: Array


def _descended(problem: Problem, point: Point, guess: Array, sizes: ErrorSizes, variance: Array) -> Point:
    """Return the point after a step to `guess` and `sizes`, or after that fraction of it that descends.

    If none does, the point stays.
    """
    most = point.cost(variance) + DESCENT
    following = problem.point(guess, sizes)
    descends = following.cost(variance) <= most
    if descends.all():
        return following
    climbing = np.flatnonzero(~descends)
    for fraction in SHORTER_STEPS:
        begin, end, ends = _of((point, guess, sizes), climbing)
        shorter = [one + fraction * (other - one) for one, other in zip(begin.sizes, ends, strict=True)]
        nearer = problem.point(begin.guess + fraction * (end - begin.guess), ErrorSizes(*shorter))
        _put(following, climbing, nearer)
        climbing = climbing[~(nearer.cost(variance[climbing]) <= most[climbing])]
        if not len(climbing):
            return following
    _put(following, climbing, _of(point, climbing))
    return following


INLIER = 0.5
"""The weight from which on a range counts as an inlier."""


def _quality(system: NormalEquations, weights: Array, noise: Noise) -> _Quality:
    """Return how well the ranges agree with a linear model."""
    change = system.change
    chi2 = np.maximum(np.add.reduce(system.innovation * system.multipliers, -1), 0.0)
    inliers = np.add.reduce(weights > INLIER, -1)
    told = zip(chi2.tolist(), inliers.tolist(), strict=True)
    level = np.array([noise_level(one, count - change.shape[-1], noise) for one, count in told])
    length = np.abs(np.add.reduce(change * product(system.information, change), -1))
    return _Quality(chi2, inliers, level, np.sqrt(length / level))


def noise_level(chi2: float, degrees: int, noise: Noise, correlation: float = 0.0) -> float:
    """Return the posterior mean of the factor tau^2 of all variances (scaled inverse chi-square).

    With the `correlation` r of neighbours, residuals are worth (1 - r) / (1 + r) of their number, for the
    level and for everything else that they tell. The level grows by as much.
    """
    nu, n = noise.sigma_degrees, max(degrees, 0)
    if not nu:
        return 1.0
    worth = (1.0 - correlation) / (1.0 + correlation)
    return (nu + worth * chi2) / (nu + worth * n) / worth


def residual_correlation(residuals: Array, weights: Array, ranges: Ranges) -> float:
    """Return the correlation of each residual with the one before, from 0 to MOST_CORRELATED.

    Both are of the same kind. The correlation is reduced by what chance may cause (see BY_CHANCE), and
    strays count as 0.
    """
    scaled = (weights > INLIER) * (residuals / ranges.sigma)
    power, neighbours = float(scaled @ scaled), float(scaled[1:] @ scaled[:-1])
    first, second, _ = ranges.counts
    for end in {first, first + second}:
        if 0 < end < len(scaled):
            neighbours -= float(scaled[end] * scaled[end - 1])
    if not power > 0.0:
        return 0.0
    found = neighbours / power - BY_CHANCE / math.sqrt(len(scaled))
    return min(max(found, 0.0), MOST_CORRELATED)


BY_CHANCE = 2.0
"""The number of standard deviations 1 / sqrt(N) of the correlation of N white residuals that is disregarded.

With less, noise as told makes missions longer; with more, errors that are correlated over 20 ticks make
claims too confident.
"""

MOST_CORRELATED = 0.8
"""The largest correlation: the noise level grows by a factor of 9 at most."""


def _variance(sigma: Array, weights: Array) -> Array:
    """Return the variance (m^2) of each range, which is large for a small weight."""
    variance: Array = np.square(sigma) / np.maximum(weights, np.square(sigma / FAR))
    return variance


def _solved(jacobian: Array, innovation: Array, covariance: RangeCovariance) -> NormalEquations:
    weighted = covariance.solve(np.concatenate((jacobian, innovation[..., None]), -1))
    products = np.swapaxes(jacobian, -1, -2) @ weighted
    information = products[..., :-1]
    diagonal = np.einsum("...ii->...i", information)
    diagonal += RIDGE + RIDGE * diagonal
    of_guess = inverse_of(information)
    change = product(of_guess, products[..., -1])
    multipliers = weighted[..., -1] - product(weighted[..., :-1], change)
    return NormalEquations(
        jacobian, innovation, covariance, weighted, information, of_guess, change, multipliers
    )


def deviation(variance: float) -> float:
    """Return the standard deviation; infinite if rounding made the variance negative."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def _inlier_probabilities(system: NormalEquations, weights: Array, sigma: Array, noise: Noise) -> Array:
    """Return the probability that each range is an inlier, given the prediction from all other ranges."""
    alone = system.covariance.precisions
    weighted = system.weighted[..., :-1]
    explained = np.add.reduce((weighted @ system.of_guess) * weighted, -1)
    precision = np.maximum(alone - explained, BLIND * alone)
    error = system.multipliers / precision
    variance = np.maximum(1.0 / precision - _variance(sigma, weights), 0.0) + np.square(sigma)
    return _weights(error, np.sqrt(variance), noise)


def _weights(errors: Array, sigma: Array, noise: Noise) -> Array:
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


def _log_likelihood(
    system: NormalEquations,
    chi2: float,
    residuals: Array,
    weights: Array,
    sigma: Array,
    level: float,
    noise: Noise,
) -> float:
    """Return the log-likelihood of the inliers by their covariance, and of the outliers by their bias."""
    good = weights > INLIER
    volume, count = float(system.covariance.log_determinant), int(np.count_nonzero(good))
    if count < len(good):
        volume -= float(np.sum(np.log(_variance(sigma, weights)[~good])))
    log_likelihood = -0.5 * (volume + math.log(2.0 * math.pi) * count)
    log_likelihood += _misfit_log_likelihood(chi2, count - len(system.change), noise)
    log_likelihood -= 0.5 * len(system.change) * math.log(level)  # of the covariance of the guess
    if count == len(good):
        return log_likelihood + count * math.log1p(-noise.outliers - noise.strays)
    if noise.outliers or noise.strays:
        log_likelihood += count * math.log1p(-noise.outliers - noise.strays)
        soft = SOFT * noise.outlier_bias[0] if noise.outliers else 0.0
        log_likelihood += float(np.sum(outliers(residuals[~good], np.maximum(sigma[~good], soft), noise)))
    return log_likelihood


def _misfit_log_likelihood(chi2: float, degrees: int, noise: Noise) -> float:
    """Return the log-likelihood of a chi-square, with the noise level integrated out (Student's t)."""
    nu, n = noise.sigma_degrees, max(degrees, 0)
    if not nu:
        return -0.5 * chi2
    scale = math.lgamma(0.5 * (nu + n)) - math.lgamma(0.5 * nu) - 0.5 * n * math.log(0.5 * nu)
    return scale - 0.5 * (nu + n) * math.log1p(chi2 / nu)


SOFT = 0.1
"""The least smoothing of the ends of the outlier density, as a fraction of the least bias."""


def poses(fitted: Fit, apart: tuple[float, float]) -> tuple[Array, Array]:
    """Return the poses at the last tick, relative to M1 along the axes of <W>, in m and rad.

    The result is the mean of x, y, heading of a, then of b, shape (6,), and the covariance, shape (6, 6). Of
    one robot it is (3,) and (3, 3). With one anchor, the axes are those of the odometry's frame.
    """
    size = 3 * len(fitted.paths)
    mean, turn = np.empty(size), np.zeros((size, size))
    for robot, path in enumerate(fitted.paths):
        wx, wy, heading = _placed(fitted.guess[3 * robot : 3 * robot + 3], path)
        mean[3 * robot : 3 * robot + 3] = wx + robot * apart[0], wy + robot * apart[1], heading
    for robot, path in enumerate(fitted.linear_paths):
        own = slice(3 * robot, 3 * robot + 3)
        c, s = math.cos(fitted.linear_guess[own][2]), math.sin(fitted.linear_guess[own][2])
        wx, wy, _ = _placed(fitted.linear_guess[own], path)
        turn[own, own] = ((-c, s, -wy), (-s, -c, wx), (0.0, 0.0, 1.0))
    system, turn = fitted.system, turn[:, fitted.problem.free]
    if not fitted.errors:
        return mean, turn @ fitted.covariance @ turn.T
    # the difference of large matrices: all of them are those of one point
    prior, cross = np.zeros((size, size)), np.zeros((size, len(system.innovation)))
    for robot, (path, u) in enumerate(zip(fitted.linear_paths, fitted.directions, strict=True)):
        own, model = slice(3 * robot, 3 * robot + 3), fitted.problem.drift(path, robot)
        end = Projection.pose(path, len(path.v), fitted.linear_guess[own][2])
        rows = end.then(Projection.positions(path, Ticks.of(fitted.ticks, len(path.v)), u))
        constant = constant_effects(model, rows)[:-1]
        both = symmetric(*spread(model, rows), rows.ticks) + constant.T @ constant
        prior[own, own], cross[own] = both[:3, :3], both[:3, 3:]
    gain = system.covariance.solve(cross.T).T
    left = turn - gain @ system.jacobian
    return mean, fitted.level * (prior - gain @ cross.T + left @ system.of_guess @ left.T)


def _placed(guess: Array, path: Track) -> tuple[float, float, float]:
    """Return the last pose on `path`, relative to the anchor along the axes of <W>, in m and rad."""
    c, s = math.cos(guess[2]), math.sin(guess[2])
    x, y = float(path.x[-1]) - guess[0], float(path.y[-1]) - guess[1]
    return c * x - s * y, s * x + c * y, guess[2] + float(path.heading[-1])
