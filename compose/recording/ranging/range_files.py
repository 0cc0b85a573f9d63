"""Range recordings of all formats: the reader that a file or folder needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from compose.errors import BadRecording
from compose.extras import need
from compose.recording.ranging.pyfg import read_pyfg
from compose.recording.ranging.range_csv import REQUIRED, read_csv, rows_in
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.recording_rows import AnchorRow, check_anchor
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.recording_files import journals_in, user_errors
from compose.recording.run import read

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
