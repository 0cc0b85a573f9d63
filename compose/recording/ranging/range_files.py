"""Range recordings of all formats: the reader that a file or folder needs, and that of CSV and TUM files.

A folder of them has ranges.csv, and odometry.csv, poses.csv or TUM files; anchors.csv, antennas.csv and
truth.csv, if any.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path

from compose.errors import BadRecording
from compose.extras import need
from compose.recording.ranging.pyfg import add_pyfg
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.recording_builder import RecordingBuilder
from compose.recording.ranging.recording_rows import (
    TABLES,
    AnchorRow,
    AnyRow,
    OdometryRow,
    PoseRow,
    Row,
    RowKind,
    SourcePlace,
    check_anchor,
    row_of,
)
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.reasons import listed
from compose.recording.recording_files import journals_in, user_errors
from compose.recording.run import read
from protocol import files
from protocol.spelling import did_you_mean

ODOMETRY = ("odometry", "poses")
"""The tables of which a folder of CSV files must have one, beside `ranges`."""
TUM = re.compile(r"(?P<table>poses|truth)-(?P<robot>.+)\.tum")
"""The name of a TUM file in such a folder: the table whose rows it has, and the robot."""
TUM_FIELDS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
"""The fields of a line of a TUM file."""

TABLES_NEEDED = "ranges.csv and odometry.csv or poses.csv"
READABLE_FORMATS = (
    f"a .pyfg file, an .mcap file, a folder with {TABLES_NEEDED}, a .toml file that maps a rosbag2, or a "
    "recording of Tandem"
)
"""The formats that can be read."""
BAG_METADATA = "metadata.yaml"
"""The file by which the folder of a rosbag2 is known."""

OTHER_NAMES = {
    "robot": ("robot_id", "id", "name", "agent"),
    "t": ("time", "timestamp", "stamp", "time_s", "t_s"),
    "x": ("pos_x", "px", "tx", "x_m", "position_x"),
    "y": ("pos_y", "py", "ty", "y_m", "position_y"),
    "heading": ("yaw", "theta", "heading_rad", "yaw_rad"),
    "from": ("source", "src", "tag", "tag_id", "robot", "robot_id"),
    "to": ("target", "dst", "anchor", "anchor_id", "beacon", "beacon_id"),
    "range": ("distance", "dist", "range_m", "distance_m", "rho"),
    "sigma": ("std", "stddev", "sigma_m"),
    "anchor": ("anchor_id", "id", "name", "beacon", "landmark"),
}
"""The names that other logs give to a column, for suggestions: nothing is read by them."""


def read_ranges(path: Path, anchors_csv: Path | None = None) -> RangeRecording:
    """Return the range recording at `path`, one of READABLE_FORMATS.

    The anchors in the file `anchors_csv` are added, and replace those of the same names.

    Raises UserError with one line that names the file, and the line of the file if it has one.
    """
    try:
        anchors = _anchors(anchors_csv) if anchors_csv is not None else []
        is_bag = path.suffix in (".toml", ".db3", ".bag") or (path / BAG_METADATA).exists()
        tables = any((path / f"{name}.csv").exists() for name in (*ODOMETRY, "ranges"))
        _check_names(path)
        if path.is_dir() and not (tables or is_bag):
            if not journals_in(path):
                others = sorted(one.name for one in path.glob("*.csv"))
                has = f"; it has {listed(others)}" if others else ""
                raise BadRecording(f"{path}: it is not {READABLE_FORMATS}{has}")
            with user_errors(path):
                return ranges_of_run(read(path), anchors)
        builder = RecordingBuilder(path, anchors)
        if tables:
            for row, place in _tables(path):
                builder.add(row, place)
        elif path.suffix == ".pyfg":
            add_pyfg(builder, path, _text(path))
        elif is_bag:
            need("rosbags", extra="ros")
            from compose.recording.ranging.ros_bag import add_bag  # noqa: PLC0415  # optional

            add_bag(
                builder, path, _text(path) if path.suffix == ".toml" else f"bag = {json.dumps(path.name)}"
            )
        elif path.suffix == ".mcap":
            need("mcap")
            from compose.recording.ranging.range_mcap import add_mcap  # noqa: PLC0415  # optional

            add_mcap(builder, path)
        else:
            path.stat()
            if path.suffix == ".csv":
                raise BadRecording(f"{path}: name the folder that it is in, with {TABLES_NEEDED}")
            raise BadRecording(f"{path}: it is not {READABLE_FORMATS}")
    except OSError as error:
        raise BadRecording(f"{error.filename or path} cannot be read: {error.strerror or error}") from None
    return builder.recording()


def _check_names(folder: Path) -> None:
    """Raise BadRecording if the name of a table in `folder` has capital letters."""
    for one in sorted(folder.iterdir()) if folder.is_dir() else ():
        name = one.name.lower()
        if name in [f"{table}.csv" for table in TABLES] and not (folder / name).exists():
            raise BadRecording(f"{one}: the name of a table is in lower case: {name}")


def _anchors(path: Path) -> list[AnchorRow]:
    found: dict[str, AnchorRow] = {}
    for row, place in rows_in(path, AnchorRow):
        if row.anchor in found:
            raise BadRecording(f"{place}: there are two anchors {row.anchor}")
        check_anchor(row, place)
        found[row.anchor] = row
    return [*found.values()]


# --- CSV and TUM files --------------------------------------------------------------------------------------


def _tables(folder: Path) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield all rows in `folder` and their places. Raises OSError, and BadRecording, which names the line."""
    tracks = {path: found for path in sorted(folder.iterdir()) if (found := TUM.fullmatch(path.name))}
    odometry = [name for name in ODOMETRY if (folder / f"{name}.csv").exists()]
    if not odometry and not any(found["table"] == "poses" for found in tracks.values()):
        raise BadRecording(
            f"{folder}: it has no odometry: poses.csv, odometry.csv, or poses-ROBOT.tum of each robot"
        )
    for name, kind in TABLES.items():
        path = folder / f"{name}.csv"
        if name in (*odometry, "ranges") or path.exists():
            yield from rows_in(path, kind)
        for track, found in tracks.items():
            if found["table"] == name:
                yield from _rows_in_tum(track, found["robot"], kind)


def _rows_in_tum(path: Path, robot: str, kind: type[AnyRow]) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield the poses of a TUM file, of which the height is not used. Raises like `_tables`."""
    for number, line in enumerate(_text(path).splitlines(), 1):
        place, words = SourcePlace(path, number), line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != len(TUM_FIELDS):
            needed = "timestamp tx ty tz qx qy qz qw"
            raise BadRecording(f"{place}: it has {len(words)} fields, and needs {needed}")
        values = dict(zip(TUM_FIELDS, words, strict=True))
        del values["z"]
        yield row_of({"robot": robot, **values}, kind, place), place


def _text(path: Path) -> str:
    try:
        return files.read_text(path)
    except UnicodeDecodeError:
        raise BadRecording(f"{path}: it is not UTF-8 text") from None


def rows_in(path: Path, kind: type[RowKind]) -> Iterator[tuple[RowKind, SourcePlace]]:
    """Yield the rows of the CSV file `path` and their places. Raises like `_tables`."""
    lines = csv.reader(io.StringIO(_text(path), newline=""), strict=True)
    try:
        head = [name.strip() for name in next(lines, [])]
        _check_head(head, kind, SourcePlace(path, 1))
        for values in lines:
            place = SourcePlace(path, lines.line_num)
            if not values:
                continue
            if len(values) != len(head):
                raise BadRecording(f"{place}: it has {len(values)} fields, and the first line {len(head)}")
            given = {name: value.strip() for name, value in zip(head, values, strict=True)}
            yield row_of({name: value for name, value in given.items() if value}, kind, place), place
    except csv.Error as error:
        raise BadRecording(f"{SourcePlace(path, lines.line_num)}: {error}") from None


def _renames(unknown: list[str], free: list[str]) -> list[tuple[str, str]]:
    """Return columns of a log in `unknown`, each with the column in `free` that it is likely to be."""
    renames = []
    for one in unknown:
        like = [name for name in free if one.lower() in (name, *OTHER_NAMES.get(name, ()))]
        if like:
            free = [name for name in free if name != like[0]]
            renames.append((one, like[0]))
    return renames


def _check_head(head: list[str], kind: type[Row], place: SourcePlace) -> None:
    """Raise BadRecording unless `head` has the columns of `kind`, each once, and all that are required."""
    known = kind.__struct_encode_fields__
    required = known[: len(known) - len(kind.__struct_defaults__)]
    unknown = [name for name in head if name not in known]
    missing = [name for name in required if name not in head]
    absent = f"the column {listed(missing)} is missing"
    if len(missing) > 1:
        absent = f"the columns {listed(missing)} are missing"
    if unknown:
        guess = did_you_mean(unknown[0], known)
        if renames := _renames(unknown, [name for name in known if name not in head]):
            guess = f"; rename {listed([f'{one} to {name}' for one, name in renames])}"
        if missing:
            guess = f"; {absent}{guess}"
        if kind is OdometryRow and unknown[0] in PoseRow.__struct_fields__:
            guess = "; poses are in poses.csv"
        if len(head) == 1 and any(one in unknown[0] for one in ";\t"):
            guess = "; commas separate columns"
        what = (
            f"unknown column{'s' if len(unknown) > 1 else ''} {listed([f'{one[:40]!a}' for one in unknown])}"
        )
        raise BadRecording(f"{place}: {what}; there may be {', '.join(known)}{guess}")
    for name in head:
        if head.count(name) > 1:
            raise BadRecording(f"{place}: there are two columns {name}")
    if missing:
        raise BadRecording(f"{place}: {absent}")
