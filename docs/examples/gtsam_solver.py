"""A solver of one's own: robots fit their poses with gtsam, in missions and in recordings.

`uv run docs/examples/gtsam_solver.py` runs `noisy` with the planner `WithGtsam`, and then estimates its
recording with `GtsamSolver`. It knows white noise and outliers, and neither biases nor scales.
"""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np

import tandem
from tandem.estimation import JointMeasurements, OdometryErrors, Solution, Start
from tandem.planning import AccuracySeeking

EXACT = 1e-6
"""The least standard deviation (m, rad) of an increment of odometry; gtsam divides by it."""
FREE, HELD = 1e-8, 1e12
"""The least and the largest information (1 / m^2, 1 / rad^2) of a prior."""
PRECISE = gtsam.LevenbergMarquardtParams()
PRECISE.setRelativeErrorTol(1e-9)


class GtsamSolver:
    """Levenberg-Marquardt on the factor graph of all poses, from the start that Tandem has found."""

    def solve(self, measured: JointMeasurements, start: Start) -> Solution | None:
        """Return the optimum of the graph near `start`; None where gtsam finds none."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for robot in range(len(measured.paths)):
            _add_path(graph, values, measured, robot, start)
        _add_ranges(graph, values, measured)
        try:
            found = gtsam.LevenbergMarquardtOptimizer(graph, values, PRECISE).optimize()
            ends = [_pose(robot, len(path.v)) for robot, path in enumerate(measured.paths)]
            local = gtsam.Marginals(graph, found).jointMarginalCovariance(ends).fullMatrix()
        except RuntimeError:  # of gtsam: the ranges do not determine all poses
            return None
        turn = np.zeros(local.shape)  # gtsam's covariance is in the frame of each robot
        for i, key in enumerate(ends):
            turn[3 * i : 3 * i + 2, 3 * i : 3 * i + 2] = found.atPose2(key).rotation().matrix()
            turn[3 * i + 2, 3 * i + 2] = 1.0
        poses = np.array([_listed(found.atPose2(_pose(i, 0))) for i in range(len(measured.paths))])
        errors = tuple([_errors(found, measured, i) for i in range(len(measured.paths))])
        return Solution(Start(poses, errors), turn @ local @ turn.T)


class WithGtsam(AccuracySeeking):
    """The planner `assured` with noisy sensors, whose poses gtsam fits."""

    SOLVER = GtsamSolver()


def _add_path(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    measured: JointMeasurements,
    robot: int,
    start: Start,
) -> None:
    """Add the poses of a robot, with the odometry between them."""
    path, period = measured.paths[robot], measured.period
    pose = gtsam.Pose2(*start.poses[robot])
    values.insert(_pose(robot, 0), pose)
    known = start.errors[robot] if start.errors else OdometryErrors(np.zeros(0), np.zeros(0), np.zeros(0))
    for k, (v, omega) in enumerate(zip(path.v.tolist(), path.omega.tolist(), strict=True)):
        of_v, of_omega = measured.noise.odometry.variances(v, omega)
        sigmas = np.maximum(np.sqrt((of_v, 0.0, of_omega)) * period, EXACT)
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        told = _arc(v * period, omega * period)
        graph.add(gtsam.BetweenFactorPose2(_pose(robot, k), _pose(robot, k + 1), told, noise))
        more = (known.v[k], known.omega[k]) if k < len(known.v) else (0.0, 0.0)
        pose = pose.compose(_arc((v + more[0]) * period, (omega + more[1]) * period))
        values.insert(_pose(robot, k + 1), pose)
    if measured.prior is not None:
        own = slice(3 * robot, 3 * robot + 3)
        information = np.diagonal(measured.prior.information[own, own])
        noise = gtsam.noiseModel.Diagonal.Sigmas(1.0 / np.sqrt(np.clip(information, FREE, HELD)))
        mean = gtsam.Pose2(*measured.prior.mean[robot])
        graph.add(gtsam.PriorFactorPose2(_pose(robot, 0), mean, noise))


def _add_ranges(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, measured: JointMeasurements) -> None:
    """Add the ranges, and the anchors to which some are."""
    ranges, ends = measured.ranges, [len(path.v) for path in measured.paths]
    anchors: dict[tuple[float, ...], int] = {}
    columns = (ranges.rho, ranges.tick, ranges.sigma, ranges.first, ranges.second, ranges.place)
    for rho, tick, sigma, first, second, place in zip(*[one.tolist() for one in columns], strict=True):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        own = _pose(first, min(tick, ends[first]))
        if second >= 0:
            other = _pose(second, min(tick, ends[second]))
            graph.add(gtsam.RangeFactorPose2(own, other, rho, noise))
            continue
        key = anchors.setdefault(tuple(place), int(gtsam.symbol("l", len(anchors))))
        if not values.exists(key):
            values.insert(key, np.array(place))
            graph.add(gtsam.NonlinearEqualityPoint2(key, np.array(place)))
        graph.add(gtsam.RangeFactor2D(own, key, rho, noise))


def _errors(found: gtsam.Values, measured: JointMeasurements, robot: int) -> OdometryErrors:
    """Return the errors of the odometry of a robot in the optimum."""
    path = measured.paths[robot]
    poses = [found.atPose2(_pose(robot, k)) for k in range(len(path.v) + 1)]
    steps = np.array([_listed(begin.between(end)) for begin, end in pairwise(poses)]).reshape(-1, 3)
    told = path.omega * measured.period
    turned = told + np.remainder(steps[:, 2] - told + np.pi, 2.0 * np.pi) - np.pi
    chord = np.cos(0.5 * turned) * steps[:, 0] + np.sin(0.5 * turned) * steps[:, 1]
    driven = chord / np.sinc(0.5 * turned / np.pi)
    constants = 3 * measured.noise.priors.of_odometry
    period = measured.period
    return OdometryErrors(driven / period - path.v, (turned - told) / period, np.zeros(constants))


def _pose(robot: int, tick: int) -> int:
    return int(gtsam.symbol(chr(ord("a") + robot), tick))


def _arc(length: float, angle: float) -> gtsam.Pose2:
    return gtsam.Pose2.Expmap(np.array((length, 0.0, angle)))


def _listed(pose: gtsam.Pose2) -> tuple[float, float, float]:
    return pose.x(), pose.y(), pose.theta()


if __name__ == "__main__":
    run = tandem.run("noisy", planner=WithGtsam)
    print(run)
    print(tandem.estimate(run, accuracy=0.1, solver=GtsamSolver()))
