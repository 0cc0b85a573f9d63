"""The scenarios and sweeps that ship with Tandem, and files of one kind in place of the other."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from protocol.spelling import did_you_mean


@cache
def shipped(package: str = "scenario") -> Mapping[str, Path]:
    """Return the shipped scenario files by name; for the package `sweep`, the shipped sweep files."""
    path = Path(__file__).parents[1] / package / "shipped"
    return {file.stem: file for file in sorted(path.glob("*.toml"), key=lambda file: file.stem)}


SHIPPED_KINDS = {"scenario": ("scenario", "run"), "sweep": ("sweep", "sweep")}
"""The kind of file in each package, and the command that runs it."""
REQUIRED_FIELDS = {"scenario": {"mission", "robot"}, "sweep": {"scenario", "trials"}}
"""The required fields of the files in each package that files of the other kind cannot have."""


def unknown(source: str, folder: str) -> str:
    """Return an error message: `source` is neither a file nor a shipped file of the package `folder`."""
    names = {one: shipped(one) for one in SHIPPED_KINDS}
    for other, (kind, command) in SHIPPED_KINDS.items():
        if other != folder and source in names[other]:
            return _other_kind(source, kind, command)
    near = did_you_mean(source, [name for found in names.values() for name in found])
    ships = ", ".join(names[folder])
    return f"{source}: neither a file nor a shipped {SHIPPED_KINDS[folder][0]} ({ships}){near}"


def misplaced(source: str, table: Mapping[str, Any], folder: str) -> str | None:
    """Return an error message if the file `source`, whose content is `table`, is not of the kind in `folder`.

    Return None if `table` has a field that marks the kind of file in `folder`, or no mark at all.
    """
    for other, (kind, command) in SHIPPED_KINDS.items():
        if REQUIRED_FIELDS[folder].isdisjoint(table) and not REQUIRED_FIELDS[other].isdisjoint(table):
            return _other_kind(source, kind, command)
    return None


def _other_kind(source: str, kind: str, command: str) -> str:
    return f"{source} is a {kind}; run it with `tandem {command} {shlex.quote(source)}`"
