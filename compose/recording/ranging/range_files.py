"""Range recordings of all formats: the reader that a file or folder needs."""

from __future__ import annotations

from pathlib import Path

from compose.errors import BadRecording
from compose.extras import need
from compose.recording.ranging import range_csv
from compose.recording.ranging.pyfg import read_pyfg
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.recording_files import journals_in, user_errors
from compose.recording.run import read

FORMATS = "a .pyfg file, an .mcap file, a folder with odometry.csv and ranges.csv, or a recording of Tandem"
"""The formats that can be read."""


def read_ranges(path: Path) -> RangeRecording:
    """Return the range recording at `path`, one of FORMATS.

    Raises UserError with one line that names the file, and the line of the file if it has one.
    """
    try:
        if path.is_dir():
            return _folder(path)
        if path.suffix == ".pyfg":
            return read_pyfg(path)
        if path.suffix == ".mcap":
            need("mcap")
            from compose.recording.ranging.range_mcap import read_mcap  # noqa: PLC0415  # optional

            return read_mcap(path)
        path.stat()
    except OSError as error:
        raise BadRecording(f"{error.filename or path} cannot be read: {error.strerror or error}") from None
    raise BadRecording(f"{path}: it is not {FORMATS}")


def _folder(folder: Path) -> RangeRecording:
    if any((folder / f"{name}.csv").exists() for name in range_csv.REQUIRED):
        return range_csv.read_csv(folder)
    if journals_in(folder):
        with user_errors(folder):
            return ranges_of_run(read(folder))
    raise BadRecording(f"{folder}: it is not {FORMATS}")
