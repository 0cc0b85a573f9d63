"""Loading of classes by their name on a command line or in a file, MODULE:CLASS."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from compose.errors import UserError


def name_of(cls: type) -> str:
    """Return the name MODULE:CLASS with which other processes find `cls`.

    A class of a script is in the module that the script's file is. One of an interactive session, such as a
    notebook, is found only by this process. Raises UserError for a class that is not at the top level.
    """
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


def named(name: str, kind: str) -> Any:
    """Return the object named MODULE:CLASS, which is a `kind` such as "a driver".

    Modules are searched in the working directory too. Raises UserError.
    """
    module, _, cls = name.partition(":")
    if not module or not cls.isidentifier():
        raise UserError(f"'{name}' is not {kind}; expected MODULE:CLASS")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last, because it may contain a folder named world
    try:
        return getattr(import_module(module), cls)
    except ModuleNotFoundError as error:
        raise UserError(f"{name}: there is no module '{error.name}'") from None
    except AttributeError:
        raise UserError(f"{name}: there is no '{cls}' in {module}") from None
    except Exception as error:  # noqa: BLE001  # the user's code may raise anything
        raise UserError(f"{name}: {module} cannot be imported: {type(error).__name__}: {error}") from None
