"""The installed packages: the dependencies of Tandem, and the extras that some commands need."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import metadata
from importlib.util import find_spec
from typing import NamedTuple

from compose.errors import UserError

PACKAGE = "tandem-ranging"
"""The name of the distribution."""

_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)\s*(?P<bounds>[^;]*)(?P<extra>;.*)?")
_BOUND = re.compile(r"(?P<way>>=|<)(?P<version>[0-9.]+)")


class Library(NamedTuple):
    """One dependency of Tandem."""

    name: str
    """The name of its distribution."""
    version: str | None
    """The installed version; None if it is missing."""
    bounds: str
    """The versions that Tandem requires, such as ">=2.2,<3"; only ">=" and "<" occur."""

    @property
    def fits(self) -> bool:
        """True if it is installed in a version within the bounds."""
        return self.version is not None and all(
            (_numbers(self.version) >= _numbers(bound["version"])) == (bound["way"] == ">=")
            for bound in _BOUND.finditer(self.bounds)
        )


def version(package: str = PACKAGE) -> str | None:
    """Return the installed version of `package`, or None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def libraries() -> Iterator[Library]:
    """Yield the dependencies without extras; none if Tandem itself is not installed."""
    try:
        required = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return
    for text in required:
        requirement = _REQUIREMENT.fullmatch(text)
        if requirement is not None and requirement["extra"] is None:
            yield Library(requirement["name"], version(requirement["name"]), requirement["bounds"])


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", text)[:3])


def need(*modules: str, extra: str = "lab") -> None:
    """Raise UserError, which names `extra`, unless all `modules` are installed."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise UserError(f"needs {', '.join(missing)}: install `tandem-ranging[{extra}]`")
