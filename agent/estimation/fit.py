"""A fit to the facts about n robots: their poses at tick 0, and all errors that have a prior.

`gauss_newton` says how it converges. Without a prior, nothing is known of the start poses; the noise level, a
factor of all variances, is integrated out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np

from agent.estimation.elementary import dot
from agent.estimation.gauss_newton import RIDGE, Convergence, Fitted
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.noise_level import INLIER, misfit_log_likelihood
from agent.estimation.gaussian.odometry_noise import Array, Errors, Places
from agent.estimation.gaussian.range_weights import weighted_noise
from agent.estimation.kernel import Kernel
from agent.estimation.problem import Problem
from agent.estimation.smoother import FitStep, Singular, Walk
from agent.estimation.solver import Solution, UnusableSolution


def deviation(variance: float) -> float:
    """Return the standard deviation; infinite if rounding made the variance negative."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


class Start(NamedTuple):
    """The poses and the errors from which a fit begins."""

    poses: Array
    """The pose of each robot at tick 0, relative to the origin; shape (n, 3)."""
    errors: tuple[Errors, ...] = ()
    """The odometry errors of each robot; by default none."""
    weights: Array | None = None
    """The probability that each range is an inlier, shape (N,); by default it follows from the residuals."""


class Fit(NamedTuple):
    """The most probable start poses in the neighbourhood of the initial ones, with their uncertainty.

    Ranges are in the order of the measurements.
    """

    start: Start
    """The poses at tick 0 and the odometry errors."""
    poses: Array
    """The pose of each robot at the end of its path, relative to the origin, in m and rad; shape (n, 3)."""
    covariance: Array
    """The covariance of `poses`; shape (3 n, 3 n)."""
    weight: float
    """The logarithm of the evidence: the likelihood with all unknowns integrated out, up to a constant."""
    residuals: Array
    """The measured minus the predicted ranges (m); shape (N,)."""
    weights: Array
    """The probability that each range is an inlier; shape (N,)."""
    chi2: float
    """The least sum of squares of all errors, each in the sigma that the noise model states."""
    last_step: float
    """The expected length of the next Gauss-Newton step, in sigmas."""
    level: float
    """The estimate of the noise level tau^2."""
    constants: Array
    """The constant errors of ranges, then of each robot's odometry, in their sigmas; shape (c + m n,)."""
    paths: Array
    """The x, y (m, relative to the origin) and heading (rad) of each robot at each tick; (n, K + 1, 3)."""
    problem: Problem
    linear: Linear
    """The last linear model. Covariances are those of the point where it was computed."""

    def __repr__(self) -> str:
        return f"<Fit of {self.poses.tolist()}, log evidence {self.weight!r}>"

    def __hash__(self) -> int:
        """Return the hash of its numbers."""
        return hash((self.weight, self.chi2, self.level, self.last_step))

    def __eq__(self, other: object) -> bool:
        """Return whether `other` is a fit to the same measurements with the same result, to the bit."""
        if self is other or not isinstance(other, Fit):
            return self is other
        return hash(self) == hash(other) and all(
            np.array_equal(one, another)
            for one, another in (
                (self.start.poses, other.start.poses),
                (self.paths, other.paths),
                (self.covariance, other.covariance),
                (self.residuals, other.residuals),
                (self.weights, other.weights),
            )
        )

    def __ne__(self, other: object) -> bool:
        """Return whether `other` is another fit; that of tuples would compare arrays."""
        return not self == other

    @property
    def guess(self) -> Array:
        """The pivots in the robots' frames (m) and the headings (rad) at tick 0 (see `smoother`); (3 n,)."""
        return self.problem.kernel.guess(self.start.poses)

    @property
    def of_start(self) -> Array:
        """The covariance of `guess`; shape (3 n, 3 n)."""
        n3 = self.start.poses.size
        return np.asarray(self.level * self.linear.step.inverse[:n3, :n3], np.float64)

    @property
    def constant_sigmas(self) -> Array:
        """The standard deviations of `constants` in the same unit."""
        return np.sqrt(np.maximum(np.diagonal(self.linear.step.inverse)[self.start.poses.size :], 0.0))

    @property
    def delay(self) -> tuple[float, float]:
        """The delay (s) of all ranges after the odometry, and its standard deviation; 0 without a prior."""
        column, prior = self.problem.measured.delayed, self.problem.noise.priors.range_delay
        if not prior:
            return 0.0, 0.0
        return prior * float(self.constants[column]), prior * float(self.constant_sigmas[column])

    @property
    def ticks(self) -> Places:
        """The tick of each range; shape (N,)."""
        return self.problem.ticks

    @property
    def inliers(self) -> int:
        """The number of ranges that are more probably inliers than outliers."""
        return int(np.count_nonzero(self.weights > INLIER))

    @property
    def freedom(self) -> int:
        """The degrees of freedom of `chi2`, at least 1."""
        return max(self.inliers - self.problem.weighing.free, 1)

    def continued(self, measured: JointMeasurements) -> Fit:
        """Return this fit with longer paths in `measured`, and no further range."""
        if self.problem.lengths == tuple([len(path.v) for path in measured.paths]):
            return self
        problem = Problem.of(measured)
        poses, constant, white, _ = _begin(problem, self.start)
        paths = problem.kernel.walked(poses, constant, white).place
        start = _start_of(problem, poses, constant, white)
        return self._replace(start=start, poses=paths[:, -1], paths=paths, problem=problem)

    def places(self, robot: int, ticks: Places) -> Array:
        """Return the position (m, relative to the origin) of a robot at `ticks`; shape (2, N)."""
        return np.asarray(self.paths[robot, ticks, :2].T, np.float64)


class Linear(NamedTuple):
    """The linear model of a step."""

    kernel: Kernel
    walk: Walk
    """The paths at the point of the model."""
    poses: Array
    """The start poses there; shape (3 n,)."""
    variance: Array
    """The own variance of each range in m^2; shape (N,)."""
    step: FitStep

    def score(self, effect: Array) -> tuple[float, float]:
        """Return how the log-likelihood changes with an unknown that changes the ranges by `effect`, (N,).

        They are its first derivative and the information on it, with all other unknowns estimated beside it.
        """
        moves = self.walk.moves.copy()
        moves[..., 6:] = 0.0  # the errors of the odometry at the point
        still = self.walk._replace(moves=moves, residual=effect)
        told = self._multipliers(still)
        if self.kernel.of.information.any():  # what the prior of the poses tells is no part of it
            told = told - self._multipliers(still._replace(residual=np.zeros(len(effect))))
        return dot(effect, self.step.multipliers), dot(effect, told)

    def _multipliers(self, walk: Walk) -> Array:
        return self.kernel.step(walk, self.poses, self.variance, RIDGE, math.inf).multipliers


TO_THE_END = Convergence()
"""The convergence of fits from which a claim may follow."""


def fits(
    measured: JointMeasurements, starts: Iterable[Start], until: Convergence = TO_THE_END, doubted: int = 0
) -> list[Fit]:
    """Return the fits to all ranges in `measured` that begin at `starts`.

    Fits also begin at the first `doubted` ones without their outliers, unless the fit from there leaves out
    the same ranges. A start from which there is no fit, because a number is too large for a float, is left
    out. A solver of the user converges by its own rule, and `until` does not count.
    """
    problem, starts = Problem.of(measured), list(starts)
    found = [_fits_from(problem, measured, start, until) for start in starts]
    for start, before in zip(_without_outliers(problem, measured, starts[:doubted]), found, strict=False):
        if start is not None and not any(_leaves_out(one, start.weights) for one in before):
            found.append(_fits_from(problem, measured, start, until))
    return [one for each in found for one in each]


def _fits_from(problem: Problem, measured: JointMeasurements, start: Start, until: Convergence) -> list[Fit]:
    """Return the fit from `start`; none if a number is too large for a float."""
    try:
        if measured.solver is not None:
            _lock((measured, start))
            return _solved(problem, measured.solver.solve(measured, start))
        return [_fit(problem, problem.kernel.fitted(*_begin(problem, start), until))]
    except Singular:
        return []


def _leaves_out(fit: Fit, weights: Array | None) -> bool:
    """Return whether the outliers of a fit are those by `weights`."""
    return weights is not None and bool(np.array_equal(fit.weights > INLIER, weights > INLIER))


def _lock(value: object) -> None:
    """Make all arrays in `value` read-only: a user's solver gets those that other fits use, too."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif isinstance(value, tuple | msgspec.Struct):
        for part in value if isinstance(value, tuple) else msgspec.structs.astuple(value):
            _lock(part)


def _solved(problem: Problem, solution: Solution | None) -> list[Fit]:
    """Return the fit at the solution of a user's solver, with the smoother's linear model there.

    It is empty if there is no solution. Raises UnusableSolution.
    """
    if solution is None:
        return []
    if not isinstance(solution, Solution):
        raise UnusableSolution(f"solve() returned {type(solution).__name__}, not a Solution or None")
    size, (start, covariance, log_evidence) = 3 * len(problem.lengths), solution
    begun = _begin(problem, _usable(problem, start))
    fit = _fit(problem, problem.kernel.fitted(*begun, AS_IT_IS))._replace(last_step=0.0)
    if covariance is not None:
        covariance = _floats("covariance", covariance, size, size)
        if not np.all(np.diagonal(covariance) > 0.0):
            raise UnusableSolution("solve() returned a covariance whose variances are not all positive")
        fit = fit._replace(covariance=covariance)
    if log_evidence is not None:
        fit = fit._replace(weight=float(_floats("log evidence", log_evidence)))
    return [fit]


def _usable(problem: Problem, start: Start) -> Start:
    """Return the start of a user's solution with its numbers as floats. Raises UnusableSolution."""
    if not isinstance(start, Start):
        raise UnusableSolution(f"solve() returned a Solution of {type(start).__name__}, not of a Start")
    (robots, constants), errors, weights = problem.measured.patterns.shape[:2], start.errors, start.weights
    if not isinstance(errors, tuple) or not all(isinstance(one, Errors) for one in errors):
        raise UnusableSolution("solve() returned errors that are no tuple of OdometryErrors")
    if len(errors) not in (0, robots):
        raise UnusableSolution(f"solve() returned odometry errors of {len(errors)} of {robots} robots")
    usable = []
    for v, omega, constant in errors:
        of_v = _floats("errors v", v, np.size(v))
        of_omega = _floats("errors omega", omega, len(of_v))
        size = constants * (np.size(constant) > 0)
        usable.append(Errors(of_v, of_omega, _floats("errors constant", constant, size)))
    if weights is not None:
        weights = _floats("weights", weights, len(problem.ticks))
        if np.any((weights < 0.0) | (weights > 1.0)):
            raise UnusableSolution("solve() returned weights that are not all from 0 to 1")
    return Start(_floats("poses", start.poses, robots, 3), tuple(usable), weights)


def _floats(what: str, numbers: object, *shape: int) -> Array:
    """Return `numbers` of a user's solution as an array of finite floats. Raises UnusableSolution."""
    try:
        found = np.array(numbers).astype(np.float64, casting="same_kind")
    except (TypeError, ValueError):  # texts, objects, complex numbers, or rows of several lengths
        found = np.array(np.nan)
    if found.shape != shape or not np.isfinite(found).all():
        raise UnusableSolution(f"solve() returned no finite {what}" + (f" of shape {shape}" if shape else ""))
    return found


AS_IT_IS = Convergence(0)
"""The convergence of a fit that stays where it begins."""


LARGER = 1e-3
"""The fraction by which white variances are increased to find their part of a covariance."""


@lru_cache(maxsize=8)
def with_unscaled_priors(fit: Fit) -> Fit:
    """Return `fit` with a covariance of which a noise level below 1 multiplies only the part of white errors.

    Small residuals show that white errors are small, not that biases and slow errors are smaller than their
    priors. With a gain K and white variances R, the part of these is K R K', which is the
    derivative of the covariance by the logarithm of R.
    """
    if not fit.level < 1.0:
        return fit
    (kernel, walk, poses, variance, step), of = fit.linear, fit.linear.kernel.of
    larger = Kernel(of._replace(white=(1.0 + LARGER) * of.white), kernel.by)
    try:
        ends = larger.step(walk, poses, (1.0 + LARGER) * variance, RIDGE, math.inf).ends
    except Singular:
        return fit._replace(covariance=step.ends)
    return fit._replace(covariance=step.ends - (1.0 - fit.level) / LARGER * (ends - step.ends))


class HeldFit(NamedTuple):
    """The result of a fit in which a coordinate is held."""

    log_likelihood: float
    """The log-likelihood of the ranges, without the volume of the start poses."""
    poses: Array
    """The pose of each robot at the end of its path, relative to the origin, in m and rad; shape (n, 3)."""


def held_fits(measured: JointMeasurements, begun: Fit, held: Sequence[tuple[float, int]]) -> list[HeldFit]:
    """Return the fits from the fit `begun` with one more range, the last one, which holds a coordinate.

    `held` has that range (m) and the number of steps of each fit. A fit in which a number is too large for a
    float has an infinite likelihood, so that it blocks the claim.
    """
    problem, found = Problem.of(measured), []
    poses, constant, white, _ = _begin(problem, begun.start)
    weights = np.append(begun.weights, 1.0)[problem.order]
    for length, steps in held:
        rho = problem.measured.rho.copy()
        rho[problem.back[-1]] = length
        kernel = Kernel(problem.measured._replace(rho=rho), problem.weighing)
        try:
            fitted = kernel.held(poses, constant, white, weights, steps)
        except Singular:
            found.append(HeldFit(math.inf, begun.poses))
            continue
        log_likelihood = _evidence(problem, fitted) - 0.5 * fitted.step.of_start
        found.append(HeldFit(log_likelihood, fitted.final.walk.place[:, -1]))
    return found


def _without_outliers(
    problem: Problem, measured: JointMeasurements, starts: Sequence[Start]
) -> list[Start | None]:
    """Return the `starts` with weights that leave out the ranges that are outliers there; None without any.

    The weights follow from the residuals and the sigmas of the ranges alone, as if the start were exact.
    Without them, a fit first allows for the uncertainty of the odometry too, which can explain an outlier
    and draw the fit away from the start.
    """
    if not (starts and problem.weighing.robust):
        return []
    kernel, found = problem.kernel, list[Start | None]()
    sigma = np.sqrt(np.square(measured.ranges.sigma) + measured.loosened)[problem.order]
    for start in starts:
        poses, constant, white, _ = _begin(problem, start)
        weights = kernel.weights_by_errors(kernel.walked(poses, constant, white).residual, sigma)
        found.append(start._replace(weights=weights[problem.back]) if weights.min() < INLIER else None)
    return found


def _begin(problem: Problem, start: Start) -> tuple[Array, Array, Array, Array | None]:
    """Return the poses, the constant and the white errors of the odometry, and the weights of `start`."""
    of = problem.measured
    constant, white = np.zeros(of.patterns.shape[:2]), np.zeros(of.white.shape)
    for i, one in enumerate(start.errors):
        known = min(len(one.v), problem.lengths[i])
        white[i, 0, :known], white[i, 1, :known] = one.v[:known], one.omega[:known]
        if len(one.constant):
            constant[i] = one.constant
    weights = None if start.weights is None else start.weights[problem.order]
    return np.array(start.poses, np.float64).ravel(), constant, white, weights


def _fit(problem: Problem, found: Fitted) -> Fit:
    """Return the fit that the loop has `found`, with the linear model of its last step."""
    n3, back, step, model = 3 * problem.measured.robots, problem.back, found.step, found.model
    final, level, kernel = found.final, found.level, problem.kernel
    if problem.measured.strays:
        white = weighted_noise(problem.measured, found.sound)
        kernel = Kernel(problem.measured._replace(white=white), problem.weighing)
    return Fit(
        _start_of(problem, final.poses, final.constant, final.white),
        final.walk.place[:, -1],
        level * step.ends,
        _evidence(problem, found),
        final.walk.residual[back],
        found.weights[back],
        step.chi2,
        found.last_step,
        level,
        step.change[n3:],
        final.walk.place,
        problem,
        Linear(kernel, model.walk, model.poses, found.variance, step),
    )


def _start_of(problem: Problem, poses: Array, constant: Array, white: Array) -> Start:
    """Return the poses at tick 0 with the errors of the odometry."""
    errors = [
        Errors(white[i, 0, :ticks], white[i, 1, :ticks], constant[i])
        for i, ticks in enumerate(problem.lengths)
    ]
    return Start(poses.reshape(-1, 3), tuple(errors))


def _evidence(problem: Problem, found: Fitted) -> float:
    """Return the log-likelihood of the ranges, with all unknowns integrated out, up to a constant.

    Outliers count by their bias.
    """
    noise, count = problem.noise, found.inliers
    weight = -0.5 * (found.step.volume - problem.log_information + math.log(2.0 * math.pi) * count)
    weight += misfit_log_likelihood(found.step.chi2, count - problem.weighing.free, noise.sigma_degrees)
    weight += float(np.count_nonzero(found.sound <= INLIER)) * problem.weighing.astray_ratio
    return weight + count * math.log1p(-noise.outliers - noise.strays) + found.outliers
