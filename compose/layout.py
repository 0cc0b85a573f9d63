"""Tables and footnotes as wide as the terminal that they are printed on."""

from __future__ import annotations

import io
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table

UNLIMITED = 1000
"""columns, of what is not a terminal"""
LEAST = 20
"""columns beside an indent"""


def console(**options: Any) -> Console:
    """A console that takes text as it is: `[red]` and `:smile:` are what somebody said, and no markup."""
    return Console(markup=False, emoji=False, highlight=False, **options)


def room() -> int:
    """The columns that there are."""
    return Console().width if sys.stdout.isatty() else UNLIMITED


def table(left: Sequence[str], right: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table whose columns `left` hold text, and `right` numbers, which are never broken."""
    made = Table(box=SIMPLE_HEAD, pad_edge=False)
    for heading in left:
        made.add_column(heading, overflow="fold")
    for heading in right:
        made.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    return made


def fits(lines: Iterable[str]) -> bool:
    """Whether none of `lines` is broken by the terminal."""
    return max(map(cell_len, lines), default=0) <= room()


def lines(made: Table, width: int = UNLIMITED) -> list[str]:
    """The lines of a table, no wider than `width`: text that is too long is folded within its column."""
    page = console(width=width, file=io.StringIO())
    with page.capture() as capture:
        page.print(made)
    return [line.rstrip() for line in capture.get().splitlines() if line.strip()]


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
