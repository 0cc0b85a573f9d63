"""The table of trials: columns for the axes and draws, the fields of a TrialRow, and those of each robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from compose.scenario.scenario_tables import MAX_ROBOTS
from compose.sweep.cells import Cell
from compose.sweep.field_paths import canonical
from compose.sweep.group_columns import GROUP_COLUMNS
from compose.sweep.spec import Sweep
from compose.sweep.trial import RobotRow, TrialRow
from protocol.files import open_file

_ARROW = {int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
_TRIAL_TYPES: dict[str, pa.DataType] = {
    name: next((_ARROW[one] for one in (bool, int, float) if one in (hint, *get_args(hint))), pa.string())
    for row in (TrialRow, RobotRow)
    for name, hint in get_type_hints(row).items()
} | {"cell": pa.int32(), "trial": pa.int32()}
"""The types of the columns of rows, by name."""
_OF_ALL = [field for field in TrialRow.__struct_fields__ if field not in ("cell", "trial", "robots", "drawn")]


def schema_of(sweep: Sweep, cells: Sequence[Cell]) -> pa.Schema:
    """Return the schema of the table of trials, which the sweep and its cells determine."""
    fields = [pa.field("cell", _TRIAL_TYPES["cell"])]
    for axis in sweep.axes:
        if axis.labels is not None:
            fields.append(pa.field(axis.name, pa.string()))
        for i, field in enumerate(axis.fields):
            fields.append(pa.field(field, _kind([one[i] for one in axis.values if one[i] is not None])))
    fields += [pa.field(draw.field, pa.float64()) for draw in sweep.draws.fields]
    fields.append(pa.field("trial", _TRIAL_TYPES["trial"]))
    fields += [
        pa.field(name, _TRIAL_TYPES[name]) for name in _OF_ALL if name not in GROUP_COLUMNS or sweep.of_group
    ]
    for robot in _robots(cells):
        fields += [pa.field(f"{robot}_{name}", _TRIAL_TYPES[name]) for name in RobotRow.__struct_fields__]
    return pa.schema(fields)


def _robots(cells: Sequence[Cell]) -> list[str]:
    """Return the ids of all robots in any cell. Malformed scenarios are skipped; they are rejected later."""
    ids: dict[str, None] = {}
    for cell in cells:
        robots, group = cell.table.get("robot"), cell.table.get("group")
        if isinstance(group, Mapping) and isinstance(number := group.get("robots"), int):
            ids |= {f"r{i}": None for i in range(1, min(number, MAX_ROBOTS) + 1)}
        for robot in robots if isinstance(robots, list) else []:
            if isinstance(robot, Mapping) and isinstance(robot.get("id"), str):
                ids[robot["id"]] = None
    return list(ids)


def _kind(values: Sequence[Any]) -> pa.DataType:
    """Return the column type for the values of an axis; a string for JSON text if no other type fits."""
    if all(isinstance(value, bool) for value in values):
        return pa.bool_()
    if any(isinstance(value, bool) for value in values):
        return pa.string()
    if all(isinstance(value, int) and abs(value) < 2**63 for value in values):
        return pa.int64()
    if all(isinstance(value, int | float) for value in values):
        return pa.float64()
    return pa.string()


def _cast(value: Any, kind: pa.DataType) -> Any:
    """Return `value` as an element of a column of type `kind`; None if it is None."""
    if value is None:
        return None
    if kind == pa.string() and not isinstance(value, str):
        return canonical(value)
    return float(value) if kind == pa.float64() else value


def of_rows(rows: Sequence[TrialRow], sweep: Sweep, cells: Mapping[int, Cell], schema: pa.Schema) -> pa.Table:
    """Return `rows` as a table of `schema`. The columns of the axes come from the cells."""
    columns: dict[str, list[Any]] = {"cell": [row.cell for row in rows]}
    for where, axis in enumerate(sweep.axes):
        if axis.labels is not None:
            columns[axis.name] = [axis.labels[cells[row.cell].place[where]] for row in rows]
        for field in axis.fields:
            kind = schema.field(field).type
            columns[field] = [_cast(cells[row.cell].fields[field], kind) for row in rows]
    for draw in sweep.draws.fields:
        columns[draw.field] = [row.drawn.get(draw.field) for row in rows]
    columns["trial"] = [row.trial for row in rows]
    for name in _OF_ALL if sweep.of_group else [name for name in _OF_ALL if name not in GROUP_COLUMNS]:
        columns[name] = [getattr(row, name) for row in rows]
    nothing = RobotRow()
    for robot in _robots(list(cells.values())):
        for name in RobotRow.__struct_fields__:
            columns[f"{robot}_{name}"] = [getattr(row.robots.get(robot, nothing), name) for row in rows]
    return pa.table(columns, schema=schema)


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
