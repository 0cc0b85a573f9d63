"""Reading of TOML files written by users, and error messages that begin with the field."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import NotToml
from protocol import files


def read_text(path: Path) -> str:
    """Return the text of the file.

    Raises FileNotFoundError, and ValueError whose text says why the file cannot be read.
    """
    try:
        return files.read_text(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from None
    except ValueError:
        raise ValueError("cannot be read: it is not UTF-8 text") from None


def table_in(text: str, source: str) -> dict[str, Any]:
    """Return the table of the TOML in `text`, without validation.

    Raises NotToml, whose text begins with `source`.
    """
    try:
        return msgspec.toml.decode(text, type=dict[str, Any])
    except (ValueError, RecursionError) as error:  # from msgspec or from its TOML parser
        raise NotToml(f"{source}: not TOML: {error}") from None


def field_first(error: str, choices: Mapping[str, Sequence[str]]) -> str:
    """Return msgspec's `error` with the field in front: "mission.period: expected 'float', got 'str'".

    `choices` are the permitted values of each field that takes one of a few words.
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
        what = "invalid name: use letters, digits, - and _, and begin with a letter or digit"
    return f"{match['where']}: {what}" if match["where"] else what
