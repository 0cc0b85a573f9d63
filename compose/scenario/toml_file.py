"""A TOML file that a user has written: its text, its table, and what is wrong in it, the field in front."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import NotToml
from protocol import files


def read_text(path: Path) -> str:
    """What the file says. Raises FileNotFoundError, and ValueError, whose text says why it cannot be read."""
    try:
        return files.read_text(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from None
    except ValueError:
        raise ValueError("cannot be read: it is not UTF-8 text") from None


def table_in(text: str, source: str) -> dict[str, Any]:
    """The TOML in `text`, whatever it says. Raises NotToml, whose text begins with `source`."""
    try:
        return msgspec.toml.decode(text, type=dict[str, Any])
    except (ValueError, RecursionError) as error:  # of msgspec, or of the TOML library beneath it
        raise NotToml(f"{source}: not TOML: {error}") from None


def field_first(error: str, choices: Mapping[str, Sequence[str]]) -> str:
    """msgspec's "Expected `float`, got `str` - at `$.mission.period`", with the field in front.

    `choices` are of the fields that take one of a few words.
    """
    match = re.fullmatch(r"(?P<what>.*?)(?: - at `\$\.?(?P<where>.*)`)?", error, re.DOTALL)
    assert match is not None
    what = match["what"].replace("`", "'")
    what = what.replace("Object contains ", "").replace("Object missing required field", "missing field")
    what = what[0].lower() + what[1:]
    field = (match["where"] or "").rpartition(".")[2]
    if what.startswith("invalid enum value") and field in choices:
        what = (
            f"there is no {what.removeprefix('invalid enum value ')}; there are {', '.join(choices[field])}"
        )
    if "matching regex" in what:
        what = "no name: letters, digits, - and _, a letter or digit first"
    return f"{match['where']}: {what}" if match["where"] else what
