"""The installed packages: what Tandem requires, and the extras that some commands need."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import metadata
from importlib.util import find_spec
from typing import NamedTuple

from compose.errors import UserError

PACKAGE = "tandem-ranging"

_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)\s*(?P<bounds>[^;]*)(?P<extra>;.*)?")
_BOUND = re.compile(r"(?P<way>>=|<)(?P<version>[0-9.]+)")


class Library(NamedTuple):
    """A package that every install has."""

    name: str
    version: str | None
    """none if it is missing"""
    bounds: str
    """as the package says: ">=" and "<" only"""

    @property
    def fits(self) -> bool:
        """Whether it is there, within the bounds."""
        return self.version is not None and all(
            (_numbers(self.version) >= _numbers(bound["version"])) == (bound["way"] == ">=")
            for bound in _BOUND.finditer(self.bounds)
        )


def version(package: str = PACKAGE) -> str | None:
    """Of a package; none if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def libraries() -> Iterator[Library]:
    """What the base install needs; nothing if Tandem itself is not installed."""
    try:
        required = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return
    for text in required:
        said = _REQUIREMENT.fullmatch(text)
        if said is not None and said["extra"] is None:
            yield Library(said["name"], version(said["name"]), said["bounds"])


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", text)[:3])


def need(*modules: str, extra: str = "lab") -> None:
    """See to it that these are installed. Raises UserError."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise UserError(f"needs {', '.join(missing)}: install `tandem-ranging[{extra}]`")
