"""Solvers of users (see `agent.estimation.solver`) by name, and the errors of their code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from compose.errors import UserError
from compose.launch.class_loader import named, trust

if TYPE_CHECKING:
    from agent.estimation.fit import Start
    from agent.estimation.gaussian.joint_ranges import JointMeasurements
    from agent.estimation.solver import Solution


class GuardedSolver:
    """A solver of a user whose errors are UserErrors."""

    def __init__(self, solver: Any) -> None:
        """Raises UserError if `solver` is no solver."""
        self._name = f"{type(solver).__module__}:{type(solver).__qualname__}"
        if isinstance(solver, type) or not callable(getattr(solver, "solve", None)):
            raise UserError(f"solver: {solver!r} is no solver: an object with the method solve")
        self._solver = solver

    def solve(self, measured: JointMeasurements, start: Start) -> Solution | None:
        """Return the solution of the user's solver."""
        from agent.estimation.solver import Solution  # noqa: PLC0415  # it imports numpy

        try:
            found = self._solver.solve(measured, start)
        except Exception as error:  # noqa: BLE001  # the user's code may raise anything
            raise UserError(f"{self._name}: solve() raised {type(error).__name__}: {error}") from None
        if found is not None and not isinstance(found, Solution):
            raise UserError(f"{self._name}: solve() returned {type(found).__name__}, not a Solution or None")
        return found


def solver_named(name: str) -> GuardedSolver:
    """Return a solver of the class MODULE:CLASS, which the user of this process has named.

    Raises UserError if it cannot be loaded or created.
    """
    trust(name)
    maker = named(name, "solver")
    try:
        return GuardedSolver(maker())
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001  # as above
        raise UserError(f"{name} cannot be created: {type(error).__name__}: {error}") from None
