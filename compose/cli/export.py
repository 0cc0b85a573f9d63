"""`tandem export`: convert a recording to the file formats of other tools."""

from __future__ import annotations

import argparse
from pathlib import Path

from compose.cli.export_files import EXPORT_MODULES, exported
from compose.cli.recording import note, read_noted
from compose.errors import ENDED, FAILED, UserError, writing
from compose.extras import need
from compose.recording import recording_files
from compose.terminal.text_width import tell
from protocol import files
from protocol.output import say


def main(options: argparse.Namespace) -> int:
    """Write the files, and return FAILED if a robot's journal is missing.

    The export then contains only what the other journals hold about that robot.
    """
    out: Path = options.out or options.recording
    alone = {"pyfg": _pyfg, "html": _html, "rerun": _rerun, "tum": _tum}
    for flag, write in alone.items():
        if getattr(options, flag):
            write(options.recording, out)
            return ENDED
    need(*EXPORT_MODULES)
    done = exported(options.recording, out)
    say(*map(str, done.files))
    note("export", [f"{name} ends with {size} bytes of a torn write" for name, size in done.torn.items()])
    note("export", [f"{name} is missing" for name in done.missing])
    return FAILED if done.missing else ENDED


def _pyfg(recording: Path, out: Path) -> None:
    """Write run.pyfg to `out`, and print its path and the names that it has for the radios."""
    from compose.recording.ranging.pyfg import written_pyfg  # noqa: PLC0415  # it needs numpy
    from compose.recording.ranging.run_ranges import ranges_of_run  # noqa: PLC0415

    with recording_files.user_errors(recording):
        text, names = written_pyfg(ranges_of_run(read_noted(recording, "export")))
    _write(out, "run.pyfg", text)
    tell(", ".join([f"{name} is {letter}" for name, letter in names.items()]))


def _html(recording: Path, out: Path) -> None:
    """Write run.html to `out`, and print its path and what the recording lacks."""
    from compose.view.web.standalone import standalone_page  # noqa: PLC0415  # it imports Zenoh

    page, notes = standalone_page(recording)
    _write(out, "run.html", page)
    note("export", notes)


def _rerun(recording: Path, out: Path) -> None:
    """Write run.rrd to `out`, and print its path."""
    need("rerun", extra="rerun")
    from compose.view.export.rerun_recording import rerun_recording  # noqa: PLC0415  # slow, and optional
    from compose.view.recorded import checked, scenes_of  # noqa: PLC0415

    with recording_files.user_errors(recording):
        run = read_noted(recording, "export")
        _, setup = checked(run)
        content = rerun_recording(setup, scenes_of(run))
    _write(out, "run.rrd", content)


def _tum(recording: Path, out: Path) -> None:
    """Write the TUM files of a run, or of an estimate, to `out`, and print their paths."""
    from compose.view.export.tum import tum_of_estimate, tum_of_run  # noqa: PLC0415  # numpy

    with recording_files.user_errors(recording):
        if (recording / recording_files.ESTIMATE_CSV).exists() and not recording_files.journals_in(recording):
            texts = tum_of_estimate(recording)
        elif recording.is_dir() and not recording_files.journals_in(recording):
            neither = f"there is no {recording_files.WORLD_JOURNAL} and no {recording_files.ESTIMATE_CSV}"
            raise UserError(f"{recording} contains no recording and no estimate: {neither}")
        else:
            texts = tum_of_run(read_noted(recording, "export"))
    for name, text in texts.items():
        _write(out, name, text)


def _write(out: Path, name: str, text: str | bytes) -> None:
    """Write a file to the folder `out`, and print its path. Raises UserError."""
    recording_files.make_folder(out)
    with writing(out):
        files.write(out / name, text)
    say(str(out / name))
