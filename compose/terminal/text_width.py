"""Text wrapped to the width of the terminal."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Iterable

UNLIMITED = 1000
"""The width in columns of an output that is not a terminal."""
LEAST = 20
"""The minimum number of columns beside an indent."""


def room() -> int:
    """Return the width of standard output in columns."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else UNLIMITED


def notes(wanted: Iterable[tuple[str, str]], columns: Iterable[str]) -> list[str]:
    """Return the lines of the footnotes of `columns`; `wanted` holds pairs of a column and its footnote."""
    shown = {*columns}
    return wrapped("; ".join([note for column, note in wanted if column in shown]))


def wrapped(text: str, indent: int = 0) -> list[str]:
    """Return the lines of `text`, wrapped at the terminal's width; all but the first are indented."""
    if not sys.stdout.isatty():
        return [text]
    width = max(room(), indent + LEAST)
    return textwrap.wrap(text, width, subsequent_indent=indent * " ", break_long_words=False)
