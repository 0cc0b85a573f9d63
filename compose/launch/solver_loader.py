"""Solvers of users (see `agent.estimation.solver`) by name, and the errors of their code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from compose.errors import UserError, user_code
from compose.launch.class_loader import named, trust

if TYPE_CHECKING:
    from agent.estimation.fit import Start
    from agent.estimation.gaussian.joint_ranges import JointMeasurements
    from agent.estimation.solver import Solution


class GuardedSolver:
    """A solver of a user whose errors are UserErrors."""

    def __init__(self, solver: Any, where: str = "") -> None:
        """Raises UserError, which begins with `where`, if `solver` is no solver."""
        own = solver if isinstance(solver, type) else type(solver)
        self._name = f"{own.__module__}:{own.__qualname__}"
        if solver is own or not callable(getattr(solver, "solve", None)):
            what = "the class " if solver is own else ""
            raise UserError(f"{where}{what}{self._name} is no solver: an object with the method solve")
        self._solver = solver

    def __str__(self) -> str:
        """Return the name of the solver, MODULE:CLASS."""
        return self._name

    def solve(self, measured: JointMeasurements, start: Start) -> Solution | None:
        """Return the solution of the user's solver."""
        with user_code(f"{self._name}: solve() raised"):
            return self._solver.solve(measured, start)  # type: ignore[no-any-return]


def solver_named(name: str) -> GuardedSolver:
    """Return a solver of the class MODULE:CLASS, which the user of this process has named.

    Raises UserError if it cannot be loaded or created.
    """
    trust(name)
    maker = named(name, "solver")
    with user_code(f"{name} cannot be created:"):
        solver = maker()
    return GuardedSolver(solver)
