"""Loading of classes by name: MODULE:CLASS, or the name of an entry point of an installed package.

A name decides which code runs, so a process loads only classes that its user has named: by a flag, in a
scenario or sweep file of the user, or through the Python API. `trust` records these names. A name from
anywhere else, such as a recording, a folder of results or a message, loads nothing but one of these classes.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from compose.errors import UserError, user_code

if TYPE_CHECKING:
    from agent.estimation.fit import Start
    from agent.estimation.gaussian.joint_ranges import JointMeasurements
    from agent.estimation.solver import Solution

Kind = Literal["planner", "model", "driver", "solver"]
"""The kind of a class, and the flag without -- that names it."""

_trusted: set[str] = set()
"""The names that the user of this process has given."""


class Untrusted(UserError):
    """A class is named by a recording, a folder or a message, and not by the user of this process."""


def trust(name: str) -> None:
    """Permit this process to load the class `name`, which its user has given."""
    _trusted.add(name)


def trusted() -> frozenset[str]:
    """Return the names that the user of this process has given."""
    return frozenset(_trusted)


def entry_points(group: str) -> dict[str, Any]:
    """Return the entry points of installed packages in `group`, by name. None of them is loaded."""
    from importlib import metadata  # noqa: PLC0415  # slow to import

    return {one.name: one for one in metadata.entry_points(group=group)}


def name_of(cls: object) -> str:
    """Return the name MODULE:CLASS with which other processes find `cls`.

    A class of a script is in the module that the script's file is. One of an interactive session, such as a
    notebook, is found only by this process. Raises UserError for a class that is not at the top level, and
    for what is no class.
    """
    if not isinstance(cls, type):
        raise UserError(f"{cls!r:.60}: expected a class, or its name")
    module, name = cls.__module__, cls.__qualname__
    if not name.isidentifier():
        raise UserError(f"{name}: not at the top level of a module, so other processes cannot find it")
    if module == "__main__":
        main = sys.modules["__main__"]
        spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
        if spec is not None:
            module = spec.name
        elif file is not None:
            module = Path(file).stem
            sys.modules.setdefault(module, main)
    return f"{module}:{name}"


def need_module(name: str) -> None:
    """Raise UserError if only this process finds the class with that name."""
    if name.startswith("__main__:"):
        raise UserError(f"{name}: defined in an interactive session; other processes need it in a module")


def named(name: str, kind: Kind, group: str | None = None) -> Any:
    """Return the object named MODULE:CLASS, or the one of that entry point in `group`, which is a `kind`.

    Modules are searched in the working directory too. Raises Untrusted if the user has not named it, KeyError
    if `group` has no such entry point, and UserError if it cannot be loaded.
    """
    point = entry_points(group)[name] if group is not None and ":" not in name else None
    if name not in _trusted:
        raise Untrusted(f"the {kind} is {name}; to run its code, add --{kind} {name}")
    if point is not None:
        with user_code(f"{name}: {point.value} cannot be loaded:"):
            return point.load()
    module, _, cls = name.partition(":")
    if module.endswith(".py") or not all(map(str.isidentifier, (*module.split("."), cls))):
        raise UserError(f"'{name}' is not a {kind}; expected MODULE:CLASS, such as mine:Own")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last, because it may contain a folder named world
    try:
        return getattr(import_module(module), cls)
    except ModuleNotFoundError as error:
        raise UserError(f"{name}: there is no module '{error.name}'") from None
    except AttributeError:
        raise UserError(f"{name}: there is no '{cls}' in {module}") from None
    except (Exception, SystemExit) as error:  # noqa: BLE001  # the user's code may raise anything
        raise UserError(f"{name}: {module} cannot be imported: {type(error).__name__}: {error}") from None


# --- solvers (see `agent.estimation.solver`) ---------------------------------------------------------------


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
