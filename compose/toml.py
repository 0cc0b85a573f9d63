"""A TOML file that a user has written: its text, its table, and what is wrong in it, the field in front."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

import msgspec

from compose.kill import DRAWN, POINTS
from compose.status import UserError
from protocol.lie import Kind, Part
from protocol.mission import Variant

CHOICES: dict[str, tuple[str, ...]] = {
    "variant": get_args(Variant),
    "kind": get_args(Kind),
    "part": get_args(Part),
    "point": (*POINTS, DRAWN),
}
"""of the fields that take one of a few words"""


class BadFile(UserError):
    """The file is not TOML; the text names it, and where."""


def read_text(path: Path) -> str:
    """What the file says. Raises FileNotFoundError, and ValueError, whose text says why it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from None
    except ValueError:
        raise ValueError("cannot be read: it is not UTF-8 text") from None


def table_in(text: str, source: str) -> dict[str, Any]:
    """The TOML in `text`, whatever it says. Raises BadFile, whose text begins with `source`."""
    try:
        return msgspec.toml.decode(text, type=dict[str, Any])
    except (ValueError, RecursionError) as error:  # of msgspec, or of the TOML library beneath it
        raise BadFile(f"{source}: not TOML: {error}") from None


def field_first(error: str) -> str:
    """msgspec's "Expected `float`, got `str` - at `$.mission.period`", with the field in front."""
    match = re.fullmatch(r"(?P<what>.*?)(?: - at `\$\.?(?P<where>.*)`)?", error, re.DOTALL)
    assert match is not None
    what = match["what"].replace("`", "'")
    what = what.replace("Object contains ", "").replace("Object missing required field", "missing field")
    what = what[0].lower() + what[1:]
    field = (match["where"] or "").rpartition(".")[2]
    if what.startswith("invalid enum value") and field in CHOICES:
        what = (
            f"there is no {what.removeprefix('invalid enum value ')}; there are {', '.join(CHOICES[field])}"
        )
    if "matching regex" in what:
        what = "no name: letters, digits, - and _, a letter or digit first"
    return f"{match['where']}: {what}" if match["where"] else what
