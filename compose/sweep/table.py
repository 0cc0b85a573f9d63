"""The table of trials: columns for the axes and draws, the fields of a TrialRow, and those of each robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec.structs import asdict

from compose.scenario.scenario_tables import MAX_ROBOTS
from compose.sweep.cells import Cell
from compose.sweep.field_paths import canonical
from compose.sweep.group_columns import GroupColumns
from compose.sweep.spec import Sweep
from compose.sweep.trial import RobotRow, TrialRow
from protocol.files import open_file

_ARROW = {int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


def _fields(row: type[msgspec.Struct], prefix: str = "") -> list[pa.Field]:
    """Return the columns of the fields of `row` that have one."""
    kinds = {name: (hint, *get_args(hint)) for name, hint in get_type_hints(row).items()}
    return [
        pa.field(prefix + name, next((_ARROW[one] for one in (bool, int, float) if one in kind), pa.string()))
        for name, kind in kinds.items()
        if name not in ("cell", "trial", "robots", "drawn")
    ]


def schema_of(sweep: Sweep, cells: Sequence[Cell]) -> pa.Schema:
    """Return the schema of the table of trials, which the sweep and its cells determine."""
    cell, trial = pa.field("cell", pa.int32()), pa.field("trial", pa.int32())
    axes = [
        pa.field(name, _kind([one for one in values if one is not None]))
        for axis in sweep.axes
        for name, *values in zip(axis.columns, *map(axis.row, range(len(axis.values))), strict=True)
    ]
    draws = [pa.field(draw.field, pa.float64()) for draw in sweep.draws.fields]
    fields = _fields(TrialRow)
    place = [field.name for field in fields].index("group")
    fields[place : place + 1] = _fields(GroupColumns) if sweep.of_group else []
    robots = [field for robot in _robots(cells) for field in _fields(RobotRow, f"{robot}_")]
    return pa.schema([cell, *axes, *draws, trial, *fields, *robots])


def _robots(cells: Sequence[Cell]) -> list[str]:
    """Return the ids of all robots in any cell. Malformed scenarios are skipped; they are rejected later."""
    ids: dict[str, None] = {}
    for cell in cells:
        robots = cell.table.get("robot")
        for drawn in (cell.table.get("group"), cell.table.get("team")):
            if isinstance(drawn, Mapping) and isinstance(number := drawn.get("robots"), int):
                ids |= {f"r{i}": None for i in range(1, min(number, MAX_ROBOTS) + 1)}
        for robot in robots if isinstance(robots, list) else []:
            if isinstance(robot, Mapping) and isinstance(robot.get("id"), str):
                ids[robot["id"]] = None
    return list(ids)


def _kind(values: Sequence[Any]) -> pa.DataType:
    """Return the column type for the values of an axis; a string for JSON text if no other type fits."""
    kinds = {type(value) for value in values}
    if kinds <= {bool}:
        return pa.bool_()
    if kinds <= {int} and all(abs(value) < 2**63 for value in values):
        return pa.int64()
    return pa.float64() if kinds <= {int, float} else pa.string()


def of_rows(rows: Sequence[TrialRow], sweep: Sweep, cells: Mapping[int, Cell], schema: pa.Schema) -> pa.Table:
    """Return `rows` as a table of `schema`. The columns of the axes come from the cells."""
    names = [name for axis in sweep.axes for name in axis.columns]
    texts = [schema.field(name).type == pa.string() for name in names]
    axes = {}
    for index in {row.cell for row in rows}:
        values = [
            canonical(value) if text and not isinstance(value, str | None) else value
            for text, value in zip(texts, cells[index].on_axes(sweep.axes), strict=True)
        ]
        axes[index] = dict(zip(names, values, strict=True))
    columns = [asdict(row) | row.drawn | axes[row.cell] for row in rows]
    for row, found in zip(rows, columns, strict=True):
        found.update(asdict(row.group) if row.group is not None else {})
        for robot, one in row.robots.items():
            found.update({f"{robot}_{name}": value for name, value in asdict(one).items()})
    return pa.Table.from_pylist(columns, schema)


def gathered(tables: Sequence[pa.Table]) -> pa.Table:
    """Return the rows of all tables, sorted by cell and trial, each trial once."""
    table = pa.concat_tables(tables).sort_by([("cell", "ascending"), ("trial", "ascending")])
    cell, trial = table["cell"].to_numpy(), table["trial"].to_numpy()
    first = np.ones(len(table), bool)
    first[1:] = (np.diff(cell) != 0) | (np.diff(trial) != 0)
    return table.filter(pa.array(first)).combine_chunks()


def read(path: Path, schema: pa.Schema, columns: list[str]) -> pa.Table:
    """Return `columns` of the Parquet file at `path`.

    Raises OSError if it cannot be read, and ValueError if it is not Parquet or does not have `schema`.
    """
    # pyarrow would read a path with a colon as a URI
    with open_file(path) as opened, pq.ParquetFile(opened) as file:
        if not file.schema_arrow.equals(schema):
            raise ValueError("its columns are not those of this sweep")
        return file.read(columns)


def encoded(table: pa.Table) -> bytes:
    """Return the table as the bytes of a Parquet file."""
    file = pa.BufferOutputStream()
    pq.write_table(table, file)
    return bytes(file.getvalue().to_pybytes())
