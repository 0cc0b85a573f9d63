"""The results folder of a sweep: its manifest, the scenarios of its cells, and the rows of its trials.

The rows of a chunk are written to a file of their own, a part, as soon as the chunk completes. At the end,
the parts are merged into `trials.parquet`. All files are replaced by renaming, so the folder is consistent
whenever the process ends.
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
from compose.recording.recording_files import make_folder
from compose.sweep import PARTS, SWEEP_JSON
from compose.sweep.cells import Cell, cells, label
from compose.sweep.field_paths import canonical
from compose.sweep.spec import Sweep
from compose.sweep.table import encoded, gathered, of_rows, read, schema_of
from compose.sweep.trial import TrialRow
from protocol import documents, files

TRIALS_PARQUET = "trials.parquet"
"""The name of the merged table of trials."""
CELLS = "cells"
"""The name of the folder of the cells' scenario files."""
MAX_DIFFERENCE = 60
"""The largest length of a differing value in an error, in characters."""


class Manifest(msgspec.Struct, frozen=True):
    """The contents of `sweep.json`: the sweep to which the rows of the folder belong."""

    sweep: Sweep
    refused: dict[int, str]
    """reasons why cells are infeasible, by the index of the cell"""


class Folder:
    """The results folder of a sweep, locked against other sweeps."""

    def __init__(self, path: Path, sweep: Sweep) -> None:
        self.path = path
        self.sweep = sweep
        self.cells: dict[int, Cell] = {cell.index: cell for cell in cells(sweep)}
        self.schema = schema_of(sweep, list(self.cells.values()))
        self.ignored: list[Path] = []
        """paths of parts that cannot be read"""
        self.refused: dict[int, str] = {}
        """reasons why cells are infeasible, by the index of the cell"""
        self._parts = path / PARTS

    @property
    def trials(self) -> int:
        """The number of trials of all cells that are not refused."""
        return self.sweep.trials * (len(self.cells) - len(self.refused))

    def done(self) -> dict[int, set[int]]:
        """Return the indices of the trials with a row, by the index of the cell."""
        found: dict[int, set[int]] = {index: set() for index in self.cells}
        for table in self._tables(["cell", "trial"]):
            for cell, trial in zip(table["cell"].to_pylist(), table["trial"].to_pylist(), strict=True):
                found[cell].add(trial)
        return found

    def forget_lost(self) -> None:
        """Delete the rows of lost trials, so that the trials run again."""
        table = self.table()
        self.gather(table.filter(table["error"].is_null()))

    def ask(self, refused: Mapping[int, str]) -> None:
        """Write the manifest with the refused cells, and the scenario file of each cell."""
        self.refused = dict(refused)
        manifest = msgspec.json.encode(Manifest(self.sweep, self.refused))
        files.write(self.path / SWEEP_JSON, msgspec.json.format(manifest, indent=2) + b"\n")
        (self.path / CELLS).mkdir(exist_ok=True)
        self._parts.mkdir(exist_ok=True)
        for cell in self.cells.values():
            comment = f"# Cell {cell.index} of {self.sweep.name}: {label(self.sweep, cell)}."
            text = f"{comment}\n{tomli_w.dumps(cell.table)}"
            files.write(self.path / CELLS / cell.file_name, text.encode())

    def add(self, rows: Sequence[TrialRow]) -> None:
        """Write the rows of a chunk to a part."""
        if rows:
            name = f"{rows[0].cell:05d}-{rows[0].trial:08d}.parquet"
            files.write(self._parts / name, encoded(of_rows(rows, self.sweep, self.cells, self.schema)))

    def table(self) -> pa.Table:
        """Return all rows, sorted by cell and trial. Raises UserError if `trials.parquet` cannot be read."""
        return gathered([self.schema.empty_table(), *self._tables(self.schema.names)])

    def gather(self, table: pa.Table) -> None:
        """Replace `trials.parquet` by `table`, and delete the parts."""
        files.write(self.path / TRIALS_PARQUET, encoded(table))
        for part in self._parts.glob("*"):
            part.unlink()
        if self._parts.exists():
            self._parts.rmdir()

    def _tables(self, columns: list[str]) -> Iterator[pa.Table]:
        """Yield the columns of `trials.parquet`, then those of each part.

        Raises UserError if `trials.parquet` cannot be read. Parts that cannot be read are added to `ignored`.
        """
        gathered = self.path / TRIALS_PARQUET
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
    """Yield the results folder at `path`, new or with rows of the same sweep, under an exclusive lock.

    Raises UserError if it cannot be written, is in use, or belongs to another sweep. A new folder that is
    still empty at the end is removed.
    """
    new = not path.exists()
    make_folder(path)
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
            with suppress(OSError):  # the folder is not empty
                path.rmdir()


def _refused_before(path: Path, sweep: Sweep) -> dict[int, str]:
    """Return the refused cells of an earlier run of `sweep` in this folder; empty if there was none.

    Raises UserError if the folder belongs to another sweep.
    """
    try:
        manifest: Manifest = documents.json_file(path / SWEEP_JSON, Manifest)
    except FileNotFoundError:
        if (path / TRIALS_PARQUET).exists() or (path / PARTS).exists():
            raise UserError(f"--out: {path} contains rows of an unknown sweep") from None
        return {}
    except ValueError as error:
        raise UserError(f"--out: {path / SWEEP_JSON} cannot be read: {error}") from None
    there, here = dict(_identity(manifest.sweep)), dict(_identity(sweep))
    for name in {**there, **here}:
        if there.get(name) != here.get(name):
            one, other = [_cut(values.get(name, "not set")) for values in (there, here)]
            raise UserError(
                f"--out: {path} contains another sweep: {name} is {one} in the folder and {other} in this "
                "sweep; choose another folder"
            )
    return manifest.refused


def _identity(sweep: Sweep) -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each value that must be equal for two runs to use one folder.

    The number of trials and the timeout may differ.
    """
    left: list[tuple[str, Any]] = [
        ("name", sweep.name),
        ("seed", sweep.seed),
        ("scenario", sweep.base),
        ("axis", msgspec.to_builtins(sweep.axes)),
        ("draws", msgspec.to_builtins(sweep.draws)),
    ]
    while left:
        match left.pop(0):
            case path, {**values} if values:
                left[:0] = [(f"{path}.{name}", value) for name, value in values.items()]
            case path, [*values] if values:
                left[:0] = [(f"{path}[{i}]", value) for i, value in enumerate(values)]
            case path, value:
                yield path, canonical(value)


def _cut(text: str) -> str:
    return text if len(text) <= MAX_DIFFERENCE else f"{text[: MAX_DIFFERENCE - 3]}..."
