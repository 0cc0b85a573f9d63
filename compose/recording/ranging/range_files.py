"""Range recordings of all formats: the reader that a file or folder needs, and that of CSV files.

A folder of them has odometry.csv and ranges.csv; anchors.csv, antennas.csv and truth.csv, if any.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from compose.errors import BadRecording
from compose.extras import need
from compose.recording.ranging.pyfg import read_pyfg
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.recording_rows import (
    TABLES,
    AnchorRow,
    RecordingBuilder,
    Row,
    RowKind,
    SourcePlace,
    check_anchor,
    row_of,
)
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.recording_files import journals_in, user_errors
from compose.recording.run import read
from protocol import files
from protocol.spelling import did_you_mean

REQUIRED = ("odometry", "ranges")
"""The tables that a folder of CSV files must have."""

READABLE_FORMATS = (
    "a .pyfg file, an .mcap file, a folder with odometry.csv and ranges.csv, or a recording of Tandem"
)
"""The formats that can be read."""


def read_ranges(path: Path, anchors_csv: Path | None = None) -> RangeRecording:
    """Return the range recording at `path`, one of READABLE_FORMATS.

    The anchors in the file `anchors_csv` are added, and replace those of the same names.

    Raises UserError with one line that names the file, and the line of the file if it has one.
    """
    try:
        anchors = _anchors(anchors_csv) if anchors_csv is not None else []
        if path.is_dir():
            return _folder(path, anchors)
        if path.suffix == ".pyfg":
            return read_pyfg(path, anchors)
        if path.suffix == ".mcap":
            need("mcap")
            from compose.recording.ranging.range_mcap import read_mcap  # noqa: PLC0415  # optional

            return read_mcap(path, anchors)
        path.stat()
    except OSError as error:
        raise BadRecording(f"{error.filename or path} cannot be read: {error.strerror or error}") from None
    raise BadRecording(f"{path}: it is not {READABLE_FORMATS}")


def _anchors(path: Path) -> list[AnchorRow]:
    found: dict[str, AnchorRow] = {}
    for row, place in rows_in(path, AnchorRow):
        if row.anchor in found:
            raise BadRecording(f"{place}: there are two anchors {row.anchor}")
        check_anchor(row, place)
        found[row.anchor] = row
    return [*found.values()]


def _folder(folder: Path, anchors: Sequence[AnchorRow]) -> RangeRecording:
    if any((folder / f"{name}.csv").exists() for name in REQUIRED):
        return read_csv(folder, anchors)
    if journals_in(folder):
        with user_errors(folder):
            return ranges_of_run(read(folder), anchors)
    raise BadRecording(f"{folder}: it is not {READABLE_FORMATS}")


# --- CSV files ---------------------------------------------------------------------------------------------


def read_csv(folder: Path, anchors: Sequence[AnchorRow] = ()) -> RangeRecording:
    """Return the recording in `folder`, with `anchors` in place of those of the same names there.

    Raises OSError, and BadRecording, which names the file and the line.
    """
    builder = RecordingBuilder(folder, anchors)
    for name, kind in TABLES.items():
        path = folder / f"{name}.csv"
        if name in REQUIRED or path.exists():
            for row, place in rows_in(path, kind):
                builder.add(row, place)
    return builder.recording()


def rows_in(path: Path, kind: type[RowKind]) -> Iterator[tuple[RowKind, SourcePlace]]:
    """Yield the rows of the CSV file `path` and their places. Raises like `read_csv`."""
    try:
        lines = csv.reader(io.StringIO(files.read_text(path), newline=""), strict=True)
        head = next(lines, [])
        _check_head(head, kind, SourcePlace(path, 1))
        for values in lines:
            place = SourcePlace(path, lines.line_num)
            if not values:
                continue
            if len(values) != len(head):
                raise BadRecording(f"{place}: it has {len(values)} fields, and the first line {len(head)}")
            given = {name: value.strip() for name, value in zip(head, values, strict=True)}
            yield row_of({name: value for name, value in given.items() if value}, kind, place), place
    except UnicodeDecodeError:
        raise BadRecording(f"{path}: it is not UTF-8 text") from None
    except csv.Error as error:
        raise BadRecording(f"{SourcePlace(path, lines.line_num)}: {error}") from None


def _check_head(head: list[str], kind: type[Row], place: SourcePlace) -> None:
    """Raise BadRecording unless `head` has the columns of `kind`, each once, and all that are required."""
    head[:] = [name.strip() for name in head]
    known = kind.__struct_encode_fields__
    for name in head:
        if name not in known:
            guess = did_you_mean(name, known)
            raise BadRecording(f"{place}: unknown column {name[:40]!a}; it has {', '.join(known)}{guess}")
        if head.count(name) > 1:
            raise BadRecording(f"{place}: there are two columns {name}")
    required = known[: len(known) - len(kind.__struct_defaults__)]
    missing = [name for name in required if name not in head]
    if missing:
        raise BadRecording(f"{place}: the column {missing[0]} is missing")
