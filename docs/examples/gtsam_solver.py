"""An estimator of one's own: gtsam fits the poses of robots, in missions and in recordings.

It knows white noise, and neither outliers nor biases.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam import NonlinearFactorGraph, Pose2, Values
from gtsam.noiseModel import Diagonal, Isotropic

import tandem
from tandem.estimation import Array, JointMeasurements, OdometryErrors, Solution, Start
from tandem.planning import Assured

EXACT = 1e-4
"""The least standard deviation (m, rad) of an increment of odometry; gtsam divides by it."""
PRECISE = gtsam.LevenbergMarquardtParams()
PRECISE.setRelativeErrorTol(1e-9)


class GtsamSolver:
    """Levenberg-Marquardt on the factor graph of all poses, from the start that Tandem has found."""

    def solve(self, measured: JointMeasurements, start: Start) -> Solution | None:
        """Return the optimum of the graph near `start`; None where gtsam finds none."""
        graph, values = NonlinearFactorGraph(), Values()
        for robot in range(len(measured.paths)):
            _add_path(graph, values, measured, robot, start)
        _add_ranges(graph, values, measured)
        try:
            found = gtsam.LevenbergMarquardtOptimizer(graph, values, PRECISE).optimize()
            ends = [_pose(robot, len(path.v)) for robot, path in enumerate(measured.paths)]
            local = gtsam.Marginals(graph, found).jointMarginalCovariance(ends).fullMatrix()
        except RuntimeError:  # the ranges do not determine all poses
            return None
        turn = np.zeros(local.shape)  # gtsam's covariance is in the frame of each robot
        for i, key in enumerate(ends):
            turn[3 * i : 3 * i + 2, 3 * i : 3 * i + 2] = found.atPose2(key).rotation().matrix()
            turn[3 * i + 2, 3 * i + 2] = 1.0
        driven = [
            [found.atPose2(_pose(i, k)) for k in range(len(path.v) + 1)]
            for i, path in enumerate(measured.paths)
        ]
        poses = np.array([(own[0].x(), own[0].y(), own[0].theta()) for own in driven])
        errors = tuple([_errors(own, measured, i) for i, own in enumerate(driven)])
        return Solution(Start(poses, errors), turn @ local @ turn.T)


class WithGtsam(Assured):
    """The planner `assured` with noisy sensors, whose poses gtsam fits."""

    SOLVER = GtsamSolver()


def _add_path(
    graph: NonlinearFactorGraph, values: Values, measured: JointMeasurements, robot: int, start: Start
) -> None:
    path, period, pose = measured.paths[robot], measured.period, Pose2(*start.poses[robot])
    values.insert(_pose(robot, 0), pose)
    known = np.zeros((2, len(path.v)))
    if start.errors:
        known[:, : len(start.errors[robot].v)] = start.errors[robot].v, start.errors[robot].omega
    for k, (v, omega) in enumerate(zip(path.v.tolist(), path.omega.tolist(), strict=True)):
        of_v, of_omega = measured.noise.odometry.variances(v, omega)
        noise = Diagonal.Sigmas(np.maximum(np.sqrt((of_v, 0.0, of_omega)) * period, EXACT))
        told = Pose2.Expmap(np.array((v, 0.0, omega)) * period)
        graph.add(gtsam.BetweenFactorPose2(_pose(robot, k), _pose(robot, k + 1), told, noise))
        pose = pose.compose(Pose2.Expmap(np.array((v + known[0, k], 0.0, omega + known[1, k])) * period))
        values.insert(_pose(robot, k + 1), pose)
    if measured.prior is not None:
        information = np.diagonal(measured.prior.information)[3 * robot : 3 * robot + 3]
        noise = Diagonal.Sigmas(1.0 / np.sqrt(np.clip(information, 1e-6, 1e8)))
        graph.add(gtsam.PriorFactorPose2(_pose(robot, 0), Pose2(*measured.prior.mean[robot]), noise))


def _add_ranges(graph: NonlinearFactorGraph, values: Values, measured: JointMeasurements) -> None:
    ranges, anchors = measured.ranges, dict[tuple[float, ...], int]()
    columns = (ranges.rho, ranges.tick, ranges.sigma, ranges.first, ranges.second, ranges.place)
    for rho, tick, sigma, first, second, place in zip(*[one.tolist() for one in columns], strict=True):
        noise, own = Isotropic.Sigma(1, sigma), _pose(first, tick)
        if second >= 0:
            graph.add(gtsam.RangeFactorPose2(own, _pose(second, tick), rho, noise))
            continue
        key = anchors.setdefault(tuple(place), int(gtsam.symbol("l", len(anchors))))
        if not values.exists(key):
            values.insert(key, np.array(place))
            graph.add(gtsam.NonlinearEqualityPoint2(key, np.array(place)))
        graph.add(gtsam.RangeFactor2D(own, key, rho, noise))


def _errors(driven: list[Pose2], measured: JointMeasurements, robot: int) -> OdometryErrors:
    path, period = measured.paths[robot], measured.period
    steps: Array = np.array(
        [(s.x(), s.y(), s.theta()) for s in map(Pose2.between, driven, driven[1:])]
    ).reshape(-1, 3)
    told = path.omega * period
    turned = told + np.remainder(steps[:, 2] - told + np.pi, 2.0 * np.pi) - np.pi
    chord = np.cos(0.5 * turned) * steps[:, 0] + np.sin(0.5 * turned) * steps[:, 1]
    v = chord / np.sinc(0.5 * turned / np.pi) / period
    constants = np.zeros(3 * measured.noise.priors.of_odometry)
    return OdometryErrors(v - path.v, (turned - told) / period, constants)


def _pose(robot: int, tick: int) -> int:
    return int(gtsam.symbol(chr(ord("a") + robot), tick))


def main() -> None:
    """Print a mission whose robots fit with gtsam, and an estimate of its recording."""
    scenario = tandem.Scenario.load("noisy").with_({"mission.noise.outliers": 0.0})
    run = tandem.run(scenario, planner=WithGtsam)
    print(run)
    print(tandem.estimate(run, accuracy=0.1, solver=GtsamSolver()))


if __name__ == "__main__":
    main()
