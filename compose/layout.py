"""Text as wide as the terminal that it is printed on."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Iterable

UNLIMITED = 1000
"""columns, of what is not a terminal"""
LEAST = 20
"""columns beside an indent"""


def room() -> int:
    """The columns that there are."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else UNLIMITED


def notes(wanted: Iterable[tuple[str, str]], columns: Iterable[str]) -> list[str]:
    """The footnotes, each `wanted` for a column, of those columns that are shown."""
    shown = {*columns}
    return wrapped("; ".join([note for column, note in wanted if column in shown]))


def wrapped(text: str, indent: int = 0) -> list[str]:
    """`text`, broken between words where the terminal ends, with all lines but the first indented."""
    if not sys.stdout.isatty():
        return [text]
    width = max(room(), indent + LEAST)
    return textwrap.wrap(text, width, subsequent_indent=indent * " ", break_long_words=False)
