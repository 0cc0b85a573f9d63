"""The poses of the robots at the last tick of a fit, with their covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from agent.estimation.gaussian.fitted import Fit
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Projection,
    Ticks,
    Track,
    constant_effects,
    spread,
)
from protocol.motion import rotated


def deviation(variance: float) -> float:
    """Return the standard deviation; infinite if rounding made the variance negative."""
    return math.sqrt(variance) if variance >= 0.0 else math.inf


def poses(fitted: Fit, apart: tuple[float, float]) -> tuple[Array, Array]:
    """Return the poses at the last tick, relative to M1 along the axes of <W>, in m and rad.

    The result is the mean of x, y, heading of a, then of b, shape (6,), and the covariance, shape (6, 6). It
    includes the surveying errors of the anchors. Of one robot, it is (3,) and (3, 3), relative to its anchor,
    wherever that is. With one anchor, the axes are those of the odometry's frame.
    """
    mean = last_poses(fitted.guess, fitted.paths, apart)
    size = len(mean)
    turn = np.zeros((size, size))
    for robot, path in enumerate(fitted.linear_paths):
        own = slice(3 * robot, 3 * robot + 3)
        c, s = math.cos(fitted.linear_guess[own][2]), math.sin(fitted.linear_guess[own][2])
        wx, wy, _ = _placed(fitted.linear_guess[own], path)
        turn[own, own] = ((-c, s, -wy), (-s, -c, wx), (0.0, 0.0, 1.0))
    system, turn = fitted.system, turn[:, fitted.problem.free]
    to_guess = system.of_guess @ system.weighted[:, :-1].T
    if not fitted.errors:
        return mean, turn @ fitted.covariance @ turn.T + _of_survey(fitted, turn @ to_guess)
    # the difference of large matrices: all of them are those of one point
    prior, cross = np.zeros((size, size)), np.zeros((size, len(system.innovation)))
    for robot, (path, u) in enumerate(zip(fitted.linear_paths, fitted.directions, strict=True)):
        own, model = slice(3 * robot, 3 * robot + 3), fitted.problem.drift(path, robot)
        end = Projection.pose(path, len(path.v), fitted.linear_guess[own][2])
        rows = end.then(Projection.positions(path, Ticks.of(fitted.ticks, len(path.v)), u))
        constant = constant_effects(model, rows)[:-1]
        left, right = spread(model, rows)
        both = left[:, :3].T @ right + constant[:, :3].T @ constant  # no row is later than the end
        prior[own, own], cross[own] = both[:, :3], both[:, 3:]
    gain = system.covariance.solve(cross.T).T
    unexplained = turn - gain @ system.jacobian
    covariance = fitted.level * (prior - gain @ cross.T + unexplained @ system.of_guess @ unexplained.T)
    return mean, covariance + _of_survey(fitted, gain + unexplained @ to_guess)


def _of_survey(fitted: Fit, by_range: Array) -> Array | float:
    """Return the covariance of the poses of both robots that is due to the surveying errors of their anchors.

    `by_range` are the derivatives of the poses with respect to the ranges, shape (6, N). An error across the
    line between the anchors, or common to both, changes no residual. Surveying errors are therefore not
    estimated, but considered (Schmidt-Kalman): the poses keep their mean, and their covariance grows.
    """
    sigma = fitted.problem.noise.priors.survey_error
    if not sigma or len(fitted.paths) == 1:
        return 0.0
    mutual = fitted.problem.ranges.rows(2)
    rotation = fitted.linear_guess[5]
    c, s = math.cos(rotation), math.sin(rotation)
    x, y = fitted.directions[1][:, mutual]  # of b, whose range changes with M2 - M1 as with its position
    along = by_range[:, mutual] @ np.stack(rotated(c, s, x, y), 1)
    by_error = np.concatenate((-along, along), 1)
    by_error[0:2, 0:2] -= np.eye(2)  # the claim is relative to where M1 and M2 should be
    by_error[3:5, 2:4] -= np.eye(2)
    covariance: Array = sigma**2 * by_error @ by_error.T
    return covariance


def last_poses(guess: Array, paths: Sequence[Track], apart: tuple[float, float]) -> Array:
    """Return the poses at the end of `paths` if `guess` is right, relative to M1 along <W>, in m and rad.

    The shape is (3,) for one robot, and (6,) for two.
    """
    placed = [_placed(guess[3 * robot : 3 * robot + 3], path) for robot, path in enumerate(paths)]
    offsets = (0.0, 0.0, 0.0, *apart, 0.0)
    return np.ravel(placed) + offsets[: 3 * len(placed)]


def _placed(guess: Array, path: Track) -> tuple[float, float, float]:
    """Return the last pose on `path`, relative to the anchor along the axes of <W>, in m and rad."""
    c, s = math.cos(guess[2]), math.sin(guess[2])
    x, y = float(path.x[-1]) - guess[0], float(path.y[-1]) - guess[1]
    return *rotated(c, s, x, y), guess[2] + float(path.heading[-1])
