"""The folder of a sweep: what was asked, the rows of what has been played, and what follows from them.

A row is on disk from the moment its chunk is done: in a part of its own until the parts are gathered into
`trials.parquet`. Both change by renaming, so whenever it ends, what is there is whole.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import tomli_w

from compose.errors import UserError
from compose.recording.run import make
from compose.sweep.cells import Cell, cells, label
from compose.sweep.field_paths import canonical
from compose.sweep.spec import Sweep
from compose.sweep.table import encoded, gathered, of_rows, read, schema_of
from compose.sweep.trial import TrialRow
from protocol import files

TRIALS = "trials.parquet"
SWEEP = "sweep.json"
PARTS = "parts"
CELLS = "cells"
MAX_DIFFERENCE = 60
"""characters, of a value that differs"""


class Manifest(msgspec.Struct, frozen=True):
    """`sweep.json`: what a folder's rows are of."""

    sweep: Sweep
    refused: dict[int, str]
    """cells in whose setting no mission can be played, and why"""


class Folder:
    """A sweep's folder, which no other run writes meanwhile."""

    def __init__(self, path: Path, sweep: Sweep) -> None:
        self.path = path
        self.sweep = sweep
        self.cells: dict[int, Cell] = {cell.index: cell for cell in cells(sweep)}
        self.schema = schema_of(sweep, list(self.cells.values()))
        self.ignored: list[Path] = []
        """parts that cannot be read"""
        self.refused: dict[int, str] = {}
        self._parts = path / PARTS

    def done(self) -> dict[int, set[int]]:
        """The trials of each cell that have a row."""
        found: dict[int, set[int]] = {index: set() for index in self.cells}
        for table in self._tables(["cell", "trial"]):
            for cell, trial in zip(table["cell"].to_pylist(), table["trial"].to_pylist(), strict=True):
                found[cell].add(trial)
        return found

    def forget_lost(self) -> None:
        """The trials that were lost, to an error or with their process, have no row any more."""
        table = self.table()
        self.gather(table.filter(table["error"].is_null()))

    def ask(self, refused: Mapping[int, str]) -> None:
        """Put down what is about to be played, and each cell's scenario."""
        self.refused = dict(refused)
        asked = msgspec.json.encode(Manifest(self.sweep, self.refused))
        files.write(self.path / SWEEP, msgspec.json.format(asked, indent=2) + b"\n")
        (self.path / CELLS).mkdir(exist_ok=True)
        self._parts.mkdir(exist_ok=True)
        for cell in self.cells.values():
            comment = f"# Cell {cell.index} of {self.sweep.name}: {label(self.sweep, cell)}."
            text = f"{comment}\n{tomli_w.dumps(cell.table)}"
            files.write(self.path / CELLS / cell.file_name, text.encode())

    def add(self, rows: Sequence[TrialRow]) -> None:
        """Keep the rows of a chunk."""
        if rows:
            name = f"{rows[0].cell:05d}-{rows[0].trial:08d}.parquet"
            files.write(self._parts / name, encoded(of_rows(rows, self.sweep, self.cells, self.schema)))

    def table(self) -> pa.Table:
        """All rows, in order."""
        return gathered([self.schema.empty_table(), *self._tables(self.schema.names)])

    def gather(self, table: pa.Table) -> None:
        """From now on `trials.parquet` holds these rows, and there are no parts."""
        files.write(self.path / TRIALS, encoded(table))
        for part in self._parts.glob("*"):
            part.unlink()
        if self._parts.exists():
            self._parts.rmdir()

    def _tables(self, columns: list[str]) -> Iterator[pa.Table]:
        """What has been gathered, then each part. Raises UserError if the former cannot be read."""
        gathered = self.path / TRIALS
        if gathered.exists():
            try:
                yield read(gathered, self.schema, columns)
            except (OSError, ValueError) as error:
                raise UserError(f"--out: {gathered} cannot be read: {error}") from None
        for part in sorted(self._parts.glob("*.parquet")):
            try:
                yield read(part, self.schema, columns)
            except (OSError, ValueError):
                if part not in self.ignored:
                    self.ignored.append(part)


@contextmanager
def opened(path: Path, sweep: Sweep) -> Iterator[Folder]:
    """The folder at `path`, new or with what has been played of the same sweep.

    Raises UserError where it cannot be written, is in use, or is of another sweep.
    """
    new = not path.exists()
    make(path)
    lock = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(f"--out: {path} is in use by another sweep") from None
        folder = Folder(path, sweep)
        folder.refused = _refused_before(path, sweep)
        yield folder
    finally:
        os.close(lock)
        if new:
            with suppress(OSError):  # it holds something
                path.rmdir()


def _refused_before(path: Path, sweep: Sweep) -> dict[int, str]:
    """The cells that an earlier run found unworkable. Raises UserError if it was of another sweep."""
    try:
        asked = msgspec.json.decode(files.read_bytes(path / SWEEP), type=Manifest)
    except FileNotFoundError:
        if (path / TRIALS).exists() or (path / PARTS).exists():
            raise UserError(f"--out: {path} holds the rows of an unknown sweep") from None
        return {}
    except ValueError as error:
        raise UserError(f"--out: {path / SWEEP} cannot be read: {error}") from None
    difference = _difference(_identity(asked.sweep), _identity(sweep))
    if difference is not None:
        raise UserError(f"--out: {path} holds another sweep: {difference}; choose another folder")
    return asked.refused


def _identity(sweep: Sweep) -> dict[str, Any]:
    """What two sweeps must share to share a folder. Trials can be added, and time-outs changed."""
    return {
        "name": sweep.name,
        "seed": sweep.seed,
        "scenario": sweep.base,
        "axis": [msgspec.to_builtins(axis) for axis in sweep.axes],
        "draws": msgspec.to_builtins(sweep.draws),
    }


def _difference(there: Any, here: Any, where: str = "") -> str | None:
    """The first field in which the two differ, and how."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        pairs = [(f"{where}.{key}".lstrip("."), there.get(key), here.get(key)) for key in {**there, **here}]
    elif isinstance(there, list | tuple) and isinstance(here, list | tuple) and len(there) == len(here):
        pairs = [(f"{where}[{i}]", *both) for i, both in enumerate(zip(there, here, strict=True))]
    else:
        same = canonical(there) == canonical(here)
        return None if same else f"{where} is {_cut(there)} there and {_cut(here)} here"
    return next((found for name, one, other in pairs if (found := _difference(one, other, name))), None)


def _cut(value: Any) -> str:
    said = "left out" if value is None else canonical(value)
    return said if len(said) <= MAX_DIFFERENCE else f"{said[: MAX_DIFFERENCE - 3]}..."
