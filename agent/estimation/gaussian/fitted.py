"""The result of a fit: the guess with its uncertainty, and the linear model from which that follows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.linear_model import Point, Problem, Start
from agent.estimation.gaussian.odometry_noise import Array, Errors, OdometryNoiseModel, Places, Track
from agent.estimation.gaussian.range_covariance import RangeCovariance


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
    """The point of that model, before the last step, with those of other fits."""
    row: int
    """The row of this fit in `linear`."""
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

    @property
    def log_volume(self) -> float:
        """Twice the logarithm of the posterior's volume in the unknowns, up to a constant.

        It counts how many guesses share the likelihood of the best one.
        """
        return -float(np.linalg.slogdet(self.information)[1])

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
