"""Tables for the terminal, as lists of lines."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table

from compose.terminal.text_width import room, wrapped
from protocol.output import UNLIMITED


def console(**options: Any) -> Console:
    """Return a console that prints text literally: `[red]` and `:smile:` are not markup."""
    return Console(markup=False, emoji=False, highlight=False, **options)


def table(left: Sequence[str], right: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table with text in the columns `left`, and numbers, which are never broken, in `right`."""
    made = Table(box=SIMPLE_HEAD, pad_edge=False)
    for heading in left:
        made.add_column(heading, overflow="fold")
    for heading in right:
        made.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    return made


def shown(left: Sequence[str], right: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table; if the terminal breaks a word of it, a list with an entry per row."""
    if as_table := unbroken(left, right, rows):
        return as_table
    headings = [*left, *right][1:]
    return [
        line
        for name, *cells in rows
        for line in (
            *wrapped(name),
            *[
                part
                for pair in zip(headings, cells, strict=True)
                for part in wrapped(f"  {': '.join(pair)}", 4)
            ],
        )
    ]


def unbroken(left: Sequence[str], right: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table as wide as the terminal; none if a word would be broken."""
    found = lines(table(left, right, rows), room())
    whole = {word for line in found for word in line.split()}
    words = {word for cells in (left, right, *rows) for cell in cells for word in cell.split()}
    return found if words <= whole else []


def fits(lines: Iterable[str]) -> bool:
    """Return whether all `lines` fit the width of the terminal."""
    return max(map(cell_len, lines), default=0) <= room()


def lines(made: Table, width: int = UNLIMITED) -> list[str]:
    """Return the lines of a table at most `width` columns wide; longer text is folded within its column."""
    page = console(width=width, file=io.StringIO())
    with page.capture() as capture:
        page.print(made)
    return [line.rstrip() for line in capture.get().splitlines() if line.strip()]
