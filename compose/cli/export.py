"""`tandem export`: convert a recording to the file formats of other tools."""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable
from pathlib import Path

from compose.cli.recording import note, read_noted
from compose.errors import ENDED, FAILED, UserError, writing
from compose.extras import need
from compose.recording import recording_files
from compose.recording.run import Run
from compose.terminal.outcome import counting
from compose.terminal.text_width import tell
from protocol import files
from protocol.output import say

EXPORT_MODULES = ("foxglove", "pyarrow")
"""The optional libraries that an export of all files needs; the caller checks that they are installed."""


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
    from compose.view.export.folder import FILES  # noqa: PLC0415  # slow to import, and optional
    from compose.view.recorded import checked  # noqa: PLC0415

    with recording_files.user_errors(options.recording):
        run = read_noted(options.recording, "export")
    exported(run, options.recording, out)
    say(*[str(out / name) for name in FILES])
    torn = {name: one.torn for name, one in run.journals.items() if one.torn}
    note("export", [f"{name} ends with {size} bytes of a torn write" for name, size in torn.items()])
    names = [recording_files.agent_journal(robot) for robot in checked(run)[0]]
    missing = [name for name in names if name not in run.journals]
    note("export", [f"{name} is missing" for name in missing])
    return FAILED if missing else ENDED


def exported(
    run: Run, folder: Path, out: Path, check: Callable[[], object] = lambda: None, *, quiet: bool = False
) -> None:
    """Export `run`, the recording in `folder`, to `out`, with a progress bar unless `quiet`.

    `check` is called repeatedly, and may raise an exception to end the export. Raises UserError if a file
    cannot be read or written.
    """
    from compose.view.export.folder import FILES, export  # noqa: PLC0415  # slow to import, and optional

    with recording_files.user_errors(folder), counting("export", 0 if quiet else len(FILES)) as done:
        gc.freeze()  # else each garbage collection goes through all messages again
        export(run, out, done=done, check=check)


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
