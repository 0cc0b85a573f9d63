"""Solvers of a user, and planners that have one."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from agent.estimation.fit import fits
from tandem.estimation import JointMeasurements, OdometryErrors, Solution, Start
from tandem.planning import Assured, Report, RobotState

NO_ERRORS = OdometryErrors(np.zeros(0), np.zeros(0), np.zeros(0))


class Smoother:
    """The smoother of Tandem behind the contract of a user's solver."""

    def solve(self, measured: JointMeasurements, start: Start) -> Solution | None:
        """Return the fit from `start`."""
        for fit in fits(replace(measured, solver=None), [start]):
            return Solution(fit.start._replace(weights=fit.weights), fit.covariance, fit.weight)
        return None


class Nothing:
    """A solver that finds no poses."""

    def solve(self, measured: JointMeasurements, start: Start) -> Solution | None:
        """Return None."""
        del measured, start
        return None


class Broken:
    """A solver whose `solution` cannot be used."""

    def __init__(self, solution: str) -> None:
        self._solution = solution

    def solve(  # noqa: C901, PLR0912  # one case each
        self, measured: JointMeasurements, start: Start
    ) -> Solution | None:
        """Return the solution, or raise."""
        match self._solution:
            case "poses":
                return Solution(start._replace(poses=start.poses * math.nan))
            case "shape":
                return Solution(start._replace(poses=np.zeros((5, 3))))
            case "covariance":
                return Solution(start, np.zeros((2, 2)))
            case "evidence":
                return Solution(start, None, math.inf)
            case "texts":
                return Solution(start._replace(poses=start.poses.astype(str)))
            case "complex":
                return Solution(start._replace(poses=start.poses.astype(complex)))
            case "no-errors":
                return Solution(start._replace(errors=None))  # type: ignore[arg-type]
            case "more-robots":
                return Solution(start._replace(errors=(NO_ERRORS,) * 9))
            case "errors":
                return Solution(
                    start._replace(errors=(NO_ERRORS._replace(v=np.zeros(2)),) * len(start.poses))
                )
            case "weights":
                return Solution(start._replace(weights=np.ones(0)))
            case "negative-weights":
                return Solution(start._replace(weights=-np.ones(len(measured.ranges.rho))))
            case "variance":
                return Solution(start, np.zeros((start.poses.size, start.poses.size)))
            case "poses-alone":
                return start  # type: ignore[return-value]
            case "nothing-else":
                return Solution(None)  # type: ignore[arg-type]
            case "exits":
                sys.exit(3)
            case "changes":
                measured.ranges.rho[:] = 1.0
            case "changes-path":
                measured.paths[0].x[0] = 1.0
            case "changes-start":
                np.add(start.poses, 1.0, out=start.poses)
            case "something":
                return "poses"  # type: ignore[return-value]
            case _:
                raise ZeroDivisionError("by the solver")
        return None


class WithSmoother(Assured):
    """The planner `assured` with the smoother as the user's solver."""

    SOLVER = Smoother()


class WithNothing(Assured):
    """A planner whose solver finds nothing."""

    SOLVER = Nothing()


class Exiting(Assured):
    """A planner that ends its process, in `decide` or as soon as it is created."""

    def __init__(self, *, at_once: bool = False) -> None:
        if at_once:
            sys.exit(7)

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """End the process."""
        del state, reports
        sys.exit("no more")


class WithNoSolver(Assured):
    """A planner with a class in place of a solver."""

    SOLVER = Smoother  # type: ignore[assignment]


class WithBroken(Assured):
    """A planner whose solver is broken."""

    def __init__(self, solution: str) -> None:
        self.SOLVER = Broken(solution)
