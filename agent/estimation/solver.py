"""The contract of a solver of a user, which fits poses in place of the smoother."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from agent.estimation.smoother import Array

if TYPE_CHECKING:
    from agent.estimation.fit import Start
    from agent.estimation.gaussian.joint_ranges import JointMeasurements


class Solution(NamedTuple):
    """The most probable poses that a solver has found in the neighbourhood of a start."""

    start: Start
    """The poses at tick 0 and the errors of the odometry: paths follow from both."""
    covariance: Array | None = None
    """The covariance of the poses at the ends of the paths, in x, y (m) and heading (rad); shape (3 n, 3 n).

    None: that of the smoother's linear model there."""
    log_evidence: float | None = None
    """The log-likelihood of the ranges with all unknowns integrated out, up to a constant that is the same
    for all starts. It determines the probability of the hypothesis. None: that of the smoother."""


class Solver(Protocol):
    """A fit of n robots to their odometry and ranges. Tandem finds the starts, and decides about claims.

    It is pure: equal measurements and starts give equal solutions, to the bit.
    """

    def solve(self, measured: JointMeasurements, start: Start) -> Solution | None:
        """Return the solution near `start`; None if there is none. `measured` and `start` do not change."""


class UnusableSolution(ValueError):
    """A solution of a user's solver is not a number, or has another shape than the measurements."""
