"""The check that Python finds Tandem's packages under their names, and not a user's modules."""

from __future__ import annotations

import os.path
import sys
from importlib.machinery import PathFinder

PACKAGES = ("protocol", "world", "agent", "compose")
"""The import names of Tandem's packages beside this one."""
PACKAGE_ROOT = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
"""The folder that contains all packages of Tandem."""


class ModuleClash(ImportError):
    """A module of the user has the name of a package of Tandem; the text is a line that says where it is."""


def check() -> None:
    """Raise ModuleClash if one of PACKAGES is another module, which would be imported instead."""
    for name in PACKAGES:
        found = _found(name)
        if found is None:
            raise ModuleClash(
                f"the package '{name}' of Tandem is missing in {PACKAGE_ROOT}; install Tandem again",
                name=name,
            )
        if os.path.realpath(found) != os.path.join(PACKAGE_ROOT, name, "__init__.py"):
            raise ModuleClash(
                f"the module '{name}' is {found}, but Tandem has a package of that name; rename yours, or "
                f"remove {_folder(found)} from PYTHONPATH (or from the folder of your script)",
                name=name,
                path=found,
            )


def _found(name: str) -> str | None:
    """Return the file of the module that `import name` gives, or its folder; None if there is none."""
    loaded = sys.modules.get(name)
    if loaded is not None:
        places = [getattr(loaded, "__file__", None), *getattr(loaded, "__path__", [])]
    elif (spec := PathFinder.find_spec(name)) is not None:
        places = [spec.origin, *(spec.submodule_search_locations or [])]
    else:
        return None
    return next((place for place in places if place is not None), f"a module '{name}' without a file")


def _folder(module: str) -> str:
    """Return the folder in which Python finds a module with this file."""
    folder, file = os.path.split(module)
    return os.path.dirname(folder) if file == "__init__.py" else folder
