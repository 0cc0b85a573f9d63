"""Text wrapped to the width of the terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable

from protocol import output
from protocol.output import UNLIMITED, one_line, say

FEWEST_COLUMNS = 20
"""The minimum number of columns beside an indent."""


def room() -> int:
    """Return the width of standard output in columns."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else UNLIMITED


def notes(wanted: Iterable[tuple[str, str]], columns: Iterable[str]) -> list[str]:
    """Return the lines of the footnotes of `columns`; `wanted` holds pairs of a column and its footnote."""
    shown = {*columns}
    found = [note for column, note in wanted if column in shown]
    return wrapped("; ".join(found)) if found else []


def wrapped(text: str, indent: int = 0) -> list[str]:
    """Return the lines of `text`, wrapped at the terminal's width; all but the first are indented."""
    if not sys.stdout.isatty():
        return [text]
    return output.wrapped(text, max(room(), indent + FEWEST_COLUMNS), indent)


def tell(*texts: str, indent: int = 0) -> None:
    """Print each of `texts`, wrapped at the terminal's width."""
    say(*[line for text in texts for line in wrapped(one_line(text), indent)])
