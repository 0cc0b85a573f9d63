"""The tables of `tandem bench`."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from rich.table import Table


def new_table(title: str) -> Table:
    """Return an empty table with columns for the median, the least and the greatest value, and the unit."""
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for heading in ("median", "from", "to"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    return table


def add_row(table: Table, what: str, values: Sequence[float], unit: str) -> None:
    """Add the row `what` to `table`."""
    table.add_row(what, *[f"{value:.4g}" for value in (median(values), min(values), max(values))], unit)
