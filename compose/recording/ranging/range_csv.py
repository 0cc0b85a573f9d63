"""Range recordings as CSV files in a folder: odometry.csv, ranges.csv; anchors, antennas, truth, if any."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from compose.errors import BadRecording
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    AntennaRow,
    AnyRow,
    OdometryRow,
    RangeRow,
    RecordingBuilder,
    Row,
    RowKind,
    SourcePlace,
    TruePoseRow,
    row_of,
)
from protocol import files
from protocol.spelling import did_you_mean

TABLES: dict[str, type[AnyRow]] = {
    "odometry": OdometryRow,
    "ranges": RangeRow,
    "anchors": AnchorRow,
    "antennas": AntennaRow,
    "truth": TruePoseRow,
}
"""The rows of each table, by its name."""
REQUIRED = ("odometry", "ranges")


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
