"""What is installed here, against what Tandem asks for."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import metadata
from typing import NamedTuple

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
