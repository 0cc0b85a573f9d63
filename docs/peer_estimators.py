"""The estimators that people use today, on the measurements that Tandem's own estimator gets: see peers.py.

Each takes a `Problem` and a generator, and returns the poses of all robots at the end with their covariance.
Nobody knows a start: each draws poses on the circle of a robot's first range to an anchor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam import NonlinearFactorGraph, Pose2, Values
from gtsam.noiseModel import Diagonal, Gaussian, Isotropic, Robust, mEstimator
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.optimize import least_squares  # type: ignore[import-untyped]

from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import Track

Array = NDArray[np.float64]

LEAST = 5e-4
"""The least sigma (m, rad) of the odometry between two ranges: a factor graph divides by it."""
HUBER = 1.345
RESTARTS, SCIPY_STARTS = 8, 12
PARTICLES, WIDE_M, LEAST_M, WIDE_S, ROUGHENING = 50_000, 1.5, 0.1, 5.0, 0.1
"""The number of particles; what is added to the sigma (m) of ranges for them: at first, at last, and the time
(s) in which it falls to 1 / e; and the noise after each resampling as a part of it (m, and rad at 3 m).
Without the second, hardly a particle is left after the first ranges."""
FILTERS, UNLIKELY = 4096, 20.0
"""The number of Kalman filters of a bank, and the log likelihood below the best at which one is dropped."""
GATE = 3.0
"""The number of sigmas beyond which a filter counts a range less, as Huber's loss does."""
NEAR_M = 1.0
"""The distance (m) from the likeliest particle within which particles count as one hypothesis."""


class Solution(NamedTuple):
    """The poses of all robots at the end."""

    poses: Array
    """x, y (m, relative to the origin) and heading (rad) of each robot; shape (n, 3)."""
    covariance: Array
    """The covariance of all poses; shape (3 n, 3 n)."""


class Driven(NamedTuple):
    """The odometry of a robot between the ticks at which it has ranges."""

    ticks: list[int]
    """The ticks: the first, those with a range, and the last; K of them."""
    steps: Array
    """x, y (m) and heading (rad) of each pose in the frame of the one before; shape (K - 1, 3)."""
    covariance: Array
    """The covariance of each step by white noise; shape (K - 1, 3, 3)."""
    poses: Array
    """The poses by dead reckoning in the frame of the first; shape (K, 3)."""


class Problem(NamedTuple):
    """The measurements of one window."""

    measured: JointMeasurements
    end: int
    """The last tick."""
    true_start: Array
    """The true poses at tick 0, relative to the origin, for those that are told them; shape (n, 3)."""

    @property
    def robots(self) -> range:
        """The indices of the robots."""
        return range(len(self.measured.robots))

    def ranges(self) -> Iterator[tuple[float, int, float, int, int, tuple[float, float], int]]:
        """Yield range (m), tick, sigma (m), both robots (-1: an anchor), its place (m), pair of radios."""
        one = self.measured.ranges
        for row in np.lexsort((one.radio, one.tick)).tolist():
            x, y = one.place[row].tolist()
            yield (
                *(float(one.rho[row]), int(one.tick[row]), float(one.sigma[row]), int(one.first[row])),
                *(int(one.second[row]), (x, y), int(one.radio[row])),
            )

    def driven(self) -> list[Driven]:
        """Return the odometry of each robot."""
        ranges = self.measured.ranges
        return [
            _driven(self.measured, path, sorted({0, self.end, *ranges.tick[ranges.of(robot)].tolist()}))
            for robot, path in enumerate(self.measured.paths)
        ]

    def starts(self, draws: Generator, count: int, driven: Sequence[Driven]) -> Array:
        """Return poses at tick 0, by which each first range to an anchor fits; shape (count, n, 3)."""
        found = np.zeros((count, len(self.robots), 3))
        for robot in self.robots:
            rho, tick, _, _, _, place, _ = next(
                one for one in self.ranges() if one[3] == robot and one[4] < 0
            )
            around, heading = draws.uniform(-math.pi, math.pi, (2, count))
            circle = np.stack((place[0] + rho * np.cos(around), place[1] + rho * np.sin(around), heading), -1)
            then = driven[robot].poses[driven[robot].ticks.index(tick)]
            found[:, robot, 2] = heading - then[2]
            found[:, robot, :2] = circle[:, :2] - _turned(then[None, :2], found[:, robot, 2])
        return found


def _turned(vectors: Array, angle: Array) -> Array:
    """Return `vectors`, shape (..., 2), turned by `angle`."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack(
        (c * vectors[..., 0] - s * vectors[..., 1], s * vectors[..., 0] + c * vectors[..., 1]), -1
    )


def then(poses: Array, step: Array) -> Array:
    """Return `poses`, shape (..., 3), after `step` in their own frames."""
    poses, step = np.broadcast_arrays(poses, step)
    turned = (poses[..., 2] + step[..., 2])[..., None]
    return np.concatenate((poses[..., :2] + _turned(step[..., :2], poses[..., 2]), turned), -1)


def _driven(measured: JointMeasurements, path: Track, ticks: list[int]) -> Driven:
    white = measured.noise.odometry
    of_v = np.square(white.v * path.v) + white.v_floor**2
    variances = np.stack((of_v, np.square(white.omega * path.omega) + white.omega_floor**2))
    if path.extra is not None:
        variances = variances + path.extra
    steps, covariances = [], []
    for i, j in pairwise(ticks):
        back = -path.heading[i]
        moved = _turned((path.place[:, j] - path.place[:, i])[None], np.array([back]))[0]
        steps.append((*moved, path.heading[j] - path.heading[i]))
        lever = path.place[:, j][:, None] - 0.5 * (path.place[:, i:j] + path.place[:, i + 1 : j + 1])
        of_omega = path.period * np.stack((-lever[1], lever[0]), -1)
        effects = np.zeros((2, j - i, 3))
        effects[0, :, :2] = _turned(path.shift[:, i:j].T, np.full(j - i, back))
        effects[1, :, :2], effects[1, :, 2] = _turned(of_omega, np.full(j - i, back)), path.period
        covariances.append(
            np.einsum("ak,aki,akj->ij", variances[:, i:j], effects, effects) + LEAST**2 * np.eye(3)
        )
    poses = np.concatenate((path.place.T, path.heading[:, None]), 1)[ticks]
    return Driven(ticks, np.array(steps), np.array(covariances), poses)


# --- factor graphs ------------------------------------------------------------------------------------------


class Graph(NamedTuple):
    """The factor graph of a window. Its factors have no biases: gtsam's ranges have none."""

    problem: Problem
    driven: list[Driven]
    factors: list[tuple[int, Any]]
    """Each factor with its tick."""

    @classmethod
    def of(cls, problem: Problem, *, huber: bool = False, widened: bool = False) -> Graph:
        """Return the graph; with Huber's loss, and with sigmas of ranges that include what biases may be."""
        driven, factors = problem.driven(), list[tuple[int, Any]]()
        for robot, own in enumerate(driven):
            for k, (step, covariance) in enumerate(zip(own.steps, own.covariance, strict=True)):
                factor = gtsam.BetweenFactorPose2(
                    _key(robot, k), _key(robot, k + 1), Pose2(*step), Gaussian.Covariance(covariance)
                )
                factors.append((own.ticks[k + 1], factor))
        loosened = problem.measured.loosened if widened else np.zeros(len(problem.measured.ranges.rho))
        order = np.lexsort((problem.measured.ranges.radio, problem.measured.ranges.tick))
        anchors: dict[tuple[float, float], int] = {}
        for (rho, tick, sigma, first, second, place, _), more in zip(
            problem.ranges(), loosened[order], strict=True
        ):
            noise: Any = Isotropic.Sigma(1, math.sqrt(sigma**2 + more))
            if huber:
                noise = Robust.Create(mEstimator.Huber.Create(HUBER), noise)
            own_key = _key(first, driven[first].ticks.index(tick))
            if second >= 0:
                other = _key(second, driven[second].ticks.index(tick))
                factors.append((tick, gtsam.RangeFactorPose2(own_key, other, rho, noise)))
                continue
            if place not in anchors:
                anchors[place] = int(gtsam.symbol("l", len(anchors)))
                surveyed = gtsam.PriorFactorPoint2(anchors[place], np.array(place), Isotropic.Sigma(2, 1e-4))
                factors.append((tick, surveyed))
            factors.append((tick, gtsam.RangeFactor2D(own_key, anchors[place], rho, noise)))
        return cls(problem, driven, sorted(factors, key=lambda one: one[0]))

    def values(self, start: Array) -> Values:
        """Return all poses by dead reckoning from `start`, and the anchors."""
        found = Values()
        for robot, own in enumerate(self.driven):
            for k, pose in enumerate(then(start[robot], own.poses)):
                found.insert(_key(robot, k), Pose2(*pose))
        for place, key in self.anchors.items():
            found.insert(key, np.array(place))
        return found

    @property
    def anchors(self) -> dict[tuple[float, float], int]:
        """The key of the anchor at each place."""
        priors = [one for _, one in self.factors if isinstance(one, gtsam.PriorFactorPoint2)]
        return {(float(one.prior()[0]), float(one.prior()[1])): one.keys()[0] for one in priors}

    @property
    def whole(self) -> NonlinearFactorGraph:
        """The graph of all factors."""
        graph = NonlinearFactorGraph()
        for _, factor in self.factors:
            graph.add(factor)
        return graph

    def optimum(self, start: Array) -> tuple[float, Values]:
        """Return the optimum of Levenberg-Marquardt from `start`, with its error."""
        graph, parameters = self.whole, gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(100)
        values = gtsam.LevenbergMarquardtOptimizer(graph, self.values(start), parameters).optimize()
        return graph.error(values), values

    def filtered(self, start: Array) -> tuple[float, Values]:
        """Return what iSAM2 has at the end, with its error: one update for each tick with ranges.

        The start has a prior with a sigma of 10 m and 3 rad: without one, the first updates are singular.
        """
        told, guess = gtsam.ISAM2(), self.values(start)
        weak = Diagonal.Sigmas(np.array((10.0, 10.0, 3.0)))
        new, values, known = NonlinearFactorGraph(), Values(), set[int]()
        for robot, pose in enumerate(start):
            new.add(gtsam.PriorFactorPose2(_key(robot, 0), Pose2(*pose), weak))
            values.insert(_key(robot, 0), Pose2(*pose))
            known.add(_key(robot, 0))
        now = 0
        for tick, factor in [*self.factors, (self.problem.end + 1, None)]:
            if tick > now:
                told.update(new, values)
                told.update()
                new, values, now = NonlinearFactorGraph(), Values(), tick
                known_values = told.calculateEstimate()
            if factor is None:
                break
            new.add(factor)
            for key in factor.keys():  # noqa: SIM118  # of gtsam, no dict
                if key not in known:
                    known.add(key)
                    self._insert(key, values, guess, known_values if now else None)
        return self.whole.error(known_values), known_values

    def _insert(self, key: int, values: Values, guess: Values, now: Values | None) -> None:
        """Insert the first value of `key`: the pose before it, as it is known now, and the odometry since."""
        symbol = gtsam.Symbol(key)
        robot, k = symbol.chr() - ord("a"), symbol.index()
        if symbol.chr() == ord("l"):
            values.insert(key, guess.atPoint2(key))
        else:
            before = _key(robot, k - 1)
            pose = now.atPose2(before) if now is not None and now.exists(before) else values.atPose2(before)
            values.insert(key, pose.compose(Pose2(*self.driven[robot].steps[k - 1])))

    def solution(self, values: Values) -> Solution:
        """Return the poses at the end. Raises RuntimeError if the ranges do not determine them."""
        ends = [_key(robot, len(own.steps)) for robot, own in enumerate(self.driven)]
        marginals = gtsam.Marginals(self.whole, values)
        covariance = np.zeros((3 * len(ends), 3 * len(ends)))
        for i, key in enumerate(ends):
            turn = np.eye(3)
            turn[:2, :2] = values.atPose2(key).rotation().matrix()
            own = slice(3 * i, 3 * i + 3)
            covariance[own, own] = turn @ marginals.marginalCovariance(key) @ turn.T
        poses = [values.atPose2(key) for key in ends]
        return Solution(np.array([(one.x(), one.y(), one.theta()) for one in poses]), covariance)


def _key(robot: int, k: int) -> int:
    return int(gtsam.symbol(chr(ord("a") + robot), k))


def lm_from_truth(problem: Problem, _: Generator) -> Solution:
    """gtsam's Levenberg-Marquardt from the true start."""
    graph = Graph.of(problem)
    return graph.solution(graph.optimum(problem.true_start)[1])


def lm(
    problem: Problem, draws: Generator, *, huber: bool = False, widened: bool = False, starts: int = 1
) -> Solution:
    """gtsam's Levenberg-Marquardt from random starts, of which the best counts."""
    graph = Graph.of(problem, huber=huber, widened=widened)
    return graph.solution(_best(graph.optimum, problem.starts(draws, starts, graph.driven)))


def isam2(problem: Problem, draws: Generator, *, starts: int = 1) -> Solution:
    """gtsam's iSAM2 from random starts, of which the best counts."""
    graph = Graph.of(problem)
    return graph.solution(_best(graph.filtered, problem.starts(draws, starts, graph.driven)))


def _best(solve: Callable[[Array], tuple[float, Values]], starts: Array) -> Values:
    found: list[tuple[float, Values]] = []
    for start in starts:
        try:
            found.append(solve(start))
        except RuntimeError:  # a singular system
            continue
    if not found:
        raise RuntimeError("no start has an optimum")
    return min(found, key=lambda one: one[0])[1]


# --- least squares over starts and constant errors ----------------------------------------------------------


class DeadReckoning:
    """Least squares in scipy: the poses at tick 0 and the constant errors that Tandem's profile has, as well.

    White noise of the odometry is none of its unknowns; a slow error of the ranges is added to their sigma.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.ranges = problem, problem.measured.ranges
        self.priors = problem.measured.noise.priors
        self.common = self.ranges.common_errors(self.priors._replace(range_delay=0.0, range_depth=0.0))
        self.sigma = np.sqrt(np.square(self.ranges.sigma) + self.priors.slow_sigma**2)
        self.count = len(problem.robots)

        self.driven = problem.driven()
        self.moving_s = [
            np.diff(np.append(0.0, np.cumsum(path.v != 0.0))[own.ticks]) * path.period
            for path, own in zip(problem.measured.paths, self.driven, strict=True)
        ]
        """The time (s) in motion between two poses."""
        self.first, self.second = (
            np.array([self.driven[robot].ticks.index(tick) if robot >= 0 else 0 for robot, tick in ends])
            for ends in (
                list(zip(which.tolist(), self.ranges.tick.tolist(), strict=True))
                for which in (self.ranges.first, self.ranges.second)
            )
        )
        """The number of the pose of each range's first and second robot."""

    def poses(self, x: Array, robot: int) -> Array:
        """Return the poses of a robot at its ranges, and at the end; shape (K, 3)."""
        own, wheel = self.driven[robot], self.priors.wheel_scale
        scale_v, scale_omega, bias = x[3 * self.count + 3 * robot :][:3]
        x0, y0, heading = x[3 * robot : 3 * robot + 3]
        turns = (
            own.steps[:, 2] * (1.0 + wheel * scale_omega)
            + self.priors.gyro_bias * bias * self.moving_s[robot]
        )
        headings = heading + np.append(0.0, np.cumsum(turns))
        moved = _turned(own.steps[:, :2] * (1.0 + wheel * scale_v), headings[:-1])
        places = np.concatenate((np.zeros((1, 2)), np.cumsum(moved, 0))) + (x0, y0)
        return np.concatenate((places, headings[:, None]), 1)

    def residuals(self, x: Array) -> Array:
        """Return the residuals of all ranges, by a pseudo-Huber loss, and of the priors."""
        poses, one = [self.poses(x, robot)[:, :2] for robot in self.problem.robots], self.ranges
        apart = -np.where(one.second[:, None] < 0, one.place, 0.0)
        for robot, own in enumerate(poses):
            first, second = one.first == robot, one.second == robot
            apart[first] += own[self.first[first]]
            apart[second] -= own[self.second[second]]
        error = (one.rho - np.hypot(*apart.T) - self.common @ x[6 * self.count :]) / self.sigma
        robust = np.sign(error) * np.sqrt(2.0 * GATE**2 * (np.sqrt(1.0 + np.square(error / GATE)) - 1.0))
        return np.concatenate((robust, x[3 * self.count :]))

    def ends(self, x: Array) -> Array:
        """Return the poses at the end; shape (3 n,)."""
        return np.concatenate([self.poses(x, robot)[-1] for robot in self.problem.robots])


def scipy_starts(problem: Problem, draws: Generator, *, starts: int = SCIPY_STARTS) -> Solution:
    """scipy's least squares from random starts, with constant errors, of which the best counts."""
    model = DeadReckoning(problem)
    zero = np.zeros(3 * model.count + model.common.shape[1])
    begun = problem.starts(draws, starts, problem.driven())
    fits = [least_squares(model.residuals, np.append(one.ravel(), zero), max_nfev=60) for one in begun]
    best = min(fits, key=lambda one: float(one.cost))
    covariance = np.linalg.pinv(best.jac.T @ best.jac)
    moved = [(model.ends(best.x + 1e-5 * one) - model.ends(best.x)) / 1e-5 for one in np.eye(len(best.x))]
    lever = np.array(moved).T
    return Solution(model.ends(best.x).reshape(-1, 3), lever @ covariance @ lever.T)


# --- filters ------------------------------------------------------------------------------------------------


class Filter:
    """The common part of both filters: states of all robots and biases, and ranges in the order of time."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.driven = problem, problem.driven()
        self.priors, self.n = problem.measured.noise.priors, len(problem.robots)
        self.at = [0] * self.n
        """The pose of each robot, by its number, that the states have."""
        self.firsts = {
            robot: next(k for k, one in enumerate(problem.ranges()) if one[3] == robot and one[4] < 0)
            for robot in problem.robots
        }
        """The range of each robot that its start fits: it does not count again."""

    @cached_property
    def bias_sigmas(self) -> Array:
        """The priors of a bias of all ranges, of a scale, and of a bias of each pair of radios."""
        pairs = len(self.problem.measured.radios)
        return np.array((self.priors.range_bias, self.priors.range_scale, *[self.priors.pair_bias] * pairs))

    def run(self, predict: Callable[[int, int], None], update: Callable[..., None]) -> None:
        """Call `predict(robot, step)` and `update(range...)` in the order of time."""
        for k, one in enumerate(self.problem.ranges()):
            _, tick, _, first, second, _, _ = one
            for robot in (first, second) if second >= 0 else (first,):
                self._advance(robot, tick, predict)
            if k not in self.firsts.values():
                update(*one)
        for robot in self.problem.robots:
            self._advance(robot, self.problem.end, predict)

    def _advance(self, robot: int, tick: int, predict: Callable[[int, int], None]) -> None:
        own = self.driven[robot]
        while own.ticks[self.at[robot]] < tick:
            predict(robot, self.at[robot])
            self.at[robot] += 1


def particle_filter(problem: Problem, draws: Generator, *, count: int = PARTICLES) -> Solution:
    """A particle filter over the poses of all robots and the biases, with systematic resampling."""
    filter_ = Filter(problem)
    poses = problem.starts(draws, count, filter_.driven)
    biases = filter_.bias_sigmas * draws.standard_normal((count, len(filter_.bias_sigmas)))
    logs = np.zeros(count)
    outliers = max(problem.measured.noise.strays, 1e-3)

    def predict(robot: int, step: int) -> None:
        own = filter_.driven[robot]
        noise = draws.standard_normal((count, 3)) @ np.linalg.cholesky(own.covariance[step]).T
        poses[:, robot] = then(poses[:, robot], own.steps[step] + noise)

    def update(
        rho: float, tick: int, sigma: float, first: int, second: int, place: object, radio: int
    ) -> None:
        nonlocal poses, biases, logs
        wide = max(LEAST_M, WIDE_M * math.exp(-tick * problem.measured.period / WIDE_S))
        other = np.array(place) if second < 0 else poses[:, second, :2]
        told = np.hypot(*(poses[:, first, :2] - other).T)
        told = told + biases[:, 0] + biases[:, 1] * rho + biases[:, 2 + radio]
        variance = sigma**2 + filter_.priors.slow_sigma**2 + wide**2
        logs = logs + np.log(np.exp(-0.5 * np.square(rho - told) / variance) + outliers)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        if 1.0 / np.square(weights).sum() < 0.5 * count:
            chosen = np.searchsorted(np.cumsum(weights), (np.arange(count) + draws.random()) / count)
            chosen = np.minimum(chosen, count - 1)
            poses, biases, logs = poses[chosen], biases[chosen], np.zeros(count)
            poses += ROUGHENING * wide * draws.standard_normal(poses.shape) * (1.0, 1.0, 1.0 / 3.0)
            biases += 0.02 * filter_.bias_sigmas * draws.standard_normal(biases.shape)

    filter_.run(predict, update)
    weights = np.exp(logs - logs.max())
    crowd = _crowded(poses, weights)
    near = np.all(np.hypot(*np.moveaxis(poses[..., :2] - poses[crowd, :, :2], -1, 0)) < NEAR_M, 1)
    kept, weights = poses[near].copy(), weights[near] / weights[near].sum()
    kept[..., 2] = (
        poses[crowd, :, 2] + np.remainder(kept[..., 2] - poses[crowd, :, 2] + np.pi, 2.0 * np.pi) - np.pi
    )
    flat = kept.reshape(len(kept), -1)
    mean = weights @ flat
    return Solution(mean.reshape(-1, 3), (flat - mean).T @ ((flat - mean) * weights[:, None]))


def _crowded(poses: Array, weights: Array) -> int:
    """Return the particle of 200 that has the most weight within NEAR_M of it."""
    some = np.argsort(-weights)[:: max(len(weights) // 200, 1)]
    masses = [
        weights[np.all(np.hypot(*np.moveaxis(poses[..., :2] - poses[one, :, :2], -1, 0)) < NEAR_M, 1)].sum()
        for one in some
    ]
    return int(some[int(np.argmax(masses))])


def kalman_filters(problem: Problem, draws: Generator, *, count: int = FILTERS) -> Solution:
    """Extended Kalman filters from random starts; the likeliest counts, and unlikely ones are dropped."""
    filter_ = Filter(problem)
    n = 3 * filter_.n
    states = np.concatenate(
        (
            problem.starts(draws, count, filter_.driven).reshape(count, n),
            np.zeros((count, len(filter_.bias_sigmas))),
        ),
        1,
    )
    spacing = 2.0 * math.pi * count ** (-0.5 / filter_.n)  # of bearings and headings
    covariances = np.zeros((count, states.shape[1], states.shape[1]))
    covariances[:, range(n, states.shape[1]), range(n, states.shape[1])] = np.square(filter_.bias_sigmas)
    for robot in problem.robots:
        rho, _, sigma, _, _, _, _ = list(problem.ranges())[filter_.firsts[robot]]
        side = sigma**2 + filter_.priors.range_bias**2 + (0.5 * spacing * rho) ** 2 / 2.0
        for k, variance in enumerate((side, side, (0.5 * spacing) ** 2)):
            covariances[:, 3 * robot + k, 3 * robot + k] = variance
    logs = np.zeros(count)

    def predict(robot: int, step: int) -> None:
        own, part = filter_.driven[robot], slice(3 * robot, 3 * robot + 3)
        before = states[:, part].copy()
        states[:, part] = then(before, own.steps[step])
        moved = states[:, part] - before
        jacobian = np.broadcast_to(np.eye(states.shape[1]), covariances.shape).copy()
        jacobian[:, 3 * robot, 3 * robot + 2], jacobian[:, 3 * robot + 1, 3 * robot + 2] = (
            -moved[:, 1],
            moved[:, 0],
        )
        covariances[:] = jacobian @ covariances @ np.swapaxes(jacobian, 1, 2)
        turn = np.zeros((len(states), 3, 3))
        c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
        covariances[:, part, part] += turn @ own.covariance[step] @ np.swapaxes(turn, 1, 2)

    def update(rho: float, _: int, sigma: float, first: int, second: int, place: object, radio: int) -> None:
        nonlocal states, covariances, logs
        other = np.array(place) if second < 0 else states[:, 3 * second : 3 * second + 2]
        apart = states[:, 3 * first : 3 * first + 2] - other
        distance = np.maximum(np.hypot(*apart.T), 1e-6)
        row = np.zeros(states.shape)
        row[:, 3 * first : 3 * first + 2] = apart / distance[:, None]
        if second >= 0:
            row[:, 3 * second : 3 * second + 2] = -apart / distance[:, None]
        row[:, n], row[:, n + 1], row[:, n + 2 + radio] = 1.0, rho, 1.0
        innovation = rho - distance - (row[:, n:] * states[:, n:]).sum(1)
        across = np.einsum("mij,mj->mi", covariances, row)
        own = sigma**2 + filter_.priors.slow_sigma**2
        variance = (row * across).sum(1) + own
        off = np.abs(innovation) / np.sqrt(variance)
        variance += np.where(off > GATE, (off / GATE - 1.0) * variance, 0.0)
        gain = across / variance[:, None]
        states = states + gain * innovation[:, None]
        covariances = covariances - gain[:, :, None] * across[:, None, :]
        logs = logs - 0.5 * (np.square(innovation) / variance + np.log(variance))
        likely = logs > logs.max() - UNLIKELY
        states, covariances, logs = states[likely], covariances[likely], logs[likely]

    filter_.run(predict, update)
    best = int(np.argmax(logs))
    return Solution(states[best, :n].reshape(-1, 3), covariances[best, :n, :n])
