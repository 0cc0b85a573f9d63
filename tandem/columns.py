"""Tables as columns: numpy arrays of equal length, which convert to Arrow, pandas and polars."""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator, Mapping
from types import UnionType
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from compose.extras import need
from protocol.spelling import did_you_mean

SHOWN_ROWS = 10
"""The number of rows that a notebook shows."""
EXTRA = "tables"
"""The extra with the libraries that tables convert to."""

Column = NDArray[Any]


class Table:
    """Columns by name, each a read-only numpy array with one element per row.

    Numbers that are missing are NaN, and missing texts None. `dict(table)` has the arrays by name. Libraries
    that read Arrow's C stream, such as polars and DuckDB, take a table as it is.

    >>> import tandem
    >>> truth = tandem.run("paper-1").truth
    >>> truth.columns
    ('tick', 'time_s', 'robot', 'x', 'y', 'heading')
    >>> a = truth.where(robot="a")
    >>> len(a), a["tick"][-1].item()
    (49, 48)
    """

    def __init__(self, columns: Mapping[str, Column]) -> None:
        """`columns` are arrays of shape (rows,)."""
        self._columns = dict(columns)
        for column in self._columns.values():
            column.setflags(write=False)

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns, in order."""
        return tuple(self._columns)

    def keys(self) -> Iterable[str]:
        """Return the names of the columns."""
        return self._columns.keys()

    def __getitem__(self, name: str) -> Column:
        """Return a column. Raises KeyError, whose text has the names of all columns."""
        if name not in self._columns:
            known = f"{', '.join(self._columns)}{did_you_mean(name, self._columns)}"
            raise KeyError(f"there is no column '{name}'; there are {known}")
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(next(iter(self._columns.values()), ()))

    def where(self, **values: object) -> Table:
        """Return the rows whose columns have these values. Raises KeyError if there is no such column."""
        chosen = np.ones(len(self), bool)
        for name, value in values.items():
            chosen &= self[name] == value
        return Table({name: column[chosen] for name, column in self._columns.items()})

    def arrow(self) -> Any:
        """Return the table as a `pyarrow.Table`, where NaN is null. Raises UserError without the extra."""
        need("pyarrow", extra=EXTRA)
        import pyarrow as pa  # noqa: PLC0415  # optional

        found = {name: pa.array(column, from_pandas=True) for name, column in self._columns.items()}
        return pa.table(
            {
                name: one.cast(pa.string()) if pa.types.is_null(one.type) else one
                for name, one in found.items()
            }
        )

    def pandas(self) -> Any:
        """Return the table as a `pandas.DataFrame`. Raises UserError without the extra."""
        need("pandas", extra=EXTRA)
        import pandas as pd  # noqa: PLC0415  # optional

        return pd.DataFrame(dict(self._columns), copy=True)

    def polars(self) -> Any:
        """Return the table as a `polars.DataFrame`, where NaN is null. Raises UserError without the extra."""
        need("polars", "pyarrow", extra=EXTRA)
        import polars as pl  # noqa: PLC0415  # optional

        return pl.from_arrow(self.arrow())

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        return self.arrow().__arrow_c_stream__(requested_schema)

    def __repr__(self) -> str:
        return f"<Table of {len(self)} rows: {', '.join(self._columns)}>"

    def _repr_html_(self) -> str:
        """Return the first rows, as a notebook shows them."""
        head = "".join([f"<th>{html.escape(name)}</th>" for name in self._columns])
        rows = [
            "".join([f"<td>{html.escape(_text(column[row]))}</td>" for column in self._columns.values()])
            for row in range(min(len(self), SHOWN_ROWS))
        ]
        more = f"<p>{len(self)} rows</p>" if len(self) > SHOWN_ROWS else ""
        lines = "".join([f"<tr>{row}</tr>" for row in rows])
        return f"<table><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>{more}"


def _text(value: Any) -> str:
    if value is None or value != value:  # noqa: PLR0124  # NaN is not itself
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def table_of(kind: type[msgspec.Struct], rows: Iterable[msgspec.Struct]) -> Table:
    """Return the table whose columns are the fields of `kind`, with one row for each of `rows`."""
    content = [msgspec.structs.astuple(row) for row in rows]
    return Table(
        {
            name: _array([row[place] for row in content], hint)
            for place, (name, hint) in enumerate(get_type_hints(kind).items())
        }
    )


def _array(values: list[Any], hint: Any) -> Column:
    """Return the values of a field as an array; `hint` is the type of the field."""
    optional = isinstance(hint, UnionType)
    kind = next(one for one in get_args(hint) if one is not type(None)) if optional else hint
    if kind is str:
        column: Column = np.empty(len(values), object)
        column[:] = values
        return column
    if optional:
        return np.array([np.nan if value is None else value for value in values], float)
    return np.array(values, kind)
