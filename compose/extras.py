"""The installed packages: the dependencies of Tandem, and the extras that some commands need."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata
from importlib.util import find_spec
from typing import NamedTuple

from compose.errors import UserError
from protocol import PACKAGE


class Library(NamedTuple):
    """One dependency of Tandem."""

    name: str
    """The name of its distribution."""
    version: str | None
    """The installed version; None if it is missing."""
    bounds: str
    """The versions that Tandem requires, such as "<3,>=2.2"."""

    @property
    def fits(self) -> bool:
        """True if it is installed in a version within the bounds."""
        from packaging.specifiers import SpecifierSet  # noqa: PLC0415  # few commands need it

        return self.version is not None and SpecifierSet(self.bounds).contains(self.version, prereleases=True)


def version(package: str = PACKAGE) -> str | None:
    """Return the installed version of `package`, or None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def libraries() -> Iterator[Library]:
    """Yield the dependencies without extras; none if Tandem itself is not installed."""
    from packaging.requirements import Requirement  # noqa: PLC0415  # few commands need it

    try:
        required = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return
    for requirement in map(Requirement, required):
        if requirement.marker is None:
            yield Library(requirement.name, version(requirement.name), str(requirement.specifier))


def need(*modules: str, extra: str = "lab") -> None:
    """Raise UserError, which names `extra`, unless all `modules` are installed."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise UserError(f"needs {', '.join(missing)}: install `tandem-ranging[{extra}]`")
