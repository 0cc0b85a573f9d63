"""Tables for the terminal, as lists of lines."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table

from compose.terminal.text_width import room, wrapped
from protocol.output import UNLIMITED

Texts = Mapping[str, str]
"""The texts of a row by the headings of its columns."""


def console(**options: Any) -> Console:
    """Return a console that prints text literally: `[red]` and `:smile:` are not markup."""
    return Console(markup=False, emoji=False, highlight=False, **options)


def table(left: Sequence[str], right: Sequence[str], rows: Iterable[Sequence[str | None]]) -> Table:
    """Return a table with text in the columns `left`, and numbers, which are never broken, in `right`."""
    made = Table(box=SIMPLE_HEAD, pad_edge=False)
    for heading in left:
        made.add_column(heading, overflow="fold")
    for heading in right:
        made.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    return made


def widest(
    left: Sequence[str], choices: Sequence[Sequence[str]], rows: Sequence[tuple[Sequence[str], Texts]]
) -> tuple[list[str], Sequence[str]]:
    """Return the lines of a table with the first of the `choices` of right columns that fits the terminal.

    The second value is that choice. If none fits, the lines are a list with the first one, an entry for each
    row. A row has the cells of the columns `left`, and the texts of the others by their headings.
    """
    for columns in choices:
        found = lines(table(left, columns, [(*cells, *map(texts.get, columns)) for cells, texts in rows]))
        if max(map(cell_len, found), default=0) <= room():
            return found, columns
    listed: list[str] = []
    for cells, texts in rows:
        name = ", ".join([" ".join(one) for one in zip(left, cells, strict=True)])
        listed += wrapped(f"{name}: {'; '.join([f'{one} {texts[one]}' for one in choices[0]])}", 2)
    return listed, choices[0]


def shown(left: Sequence[str], right: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table, or of a list if the terminal is too narrow. All headings differ."""
    first = len(left)
    found = [(row[:first], dict(zip(right, row[first:], strict=True))) for row in rows]
    return widest(left, [right], found)[0]


def lines(made: Table, width: int = UNLIMITED) -> list[str]:
    """Return the lines of a table at most `width` columns wide; longer text is folded within its column."""
    page = console(width=width, file=io.StringIO())
    with page.capture() as capture:
        page.print(made)
    return [line.rstrip() for line in capture.get().splitlines() if line.strip()]
