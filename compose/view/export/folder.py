"""The files of an export: `run.mcap` with a layout for it, `frames.csv`, `ticks.csv` and `ticks.parquet`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from compose.errors import CannotWrite, UserError
from compose.recording.frames import in_time
from compose.recording.recording_files import make_folder
from compose.recording.rows import MessageRow, TickRow, csv_text, message_rows, tick_rows
from compose.recording.run import Run
from compose.view.export.parquet import write_ticks
from compose.view.foxglove.layout import layout
from compose.view.foxglove.mcap import TooLong, mcap
from compose.view.recorded import checked, scenes_of
from protocol import files

FILES = ("run.mcap", "run.foxglove.json", "frames.csv", "ticks.csv", "ticks.parquet")


def export(
    run: Run,
    out: Path,
    *,
    done: Callable[[], object] = lambda: None,
    check: Callable[[], object] = lambda: None,
) -> None:
    """Write FILES for `run` to `out`.

    Calls `done` after each file, and `check` between steps, which may raise.
    Raises OSError or CorruptJournal if a journal cannot be read to its end, UserError if there is no
    configuration, the run is too long for a format or `out` cannot be written.
    """
    _, setup = checked(run)
    check()
    frames = in_time(run)
    ticks = list(tick_rows(run))
    check()
    make_folder(out)
    paths = tuple([out / name for name in FILES])
    writers: Sequence[Callable[[Path], object]] = (
        lambda path: path.write_bytes(mcap(setup, scenes_of(run), check)),
        lambda path: path.write_bytes(layout(setup)),
        lambda path: path.write_text(csv_text(MessageRow, message_rows(frames, check)), encoding="utf-8"),
        lambda path: path.write_text(csv_text(TickRow, ticks), encoding="utf-8"),
        lambda path: write_ticks(run, ticks, setup.mission.period, path),
    )
    try:
        for write, path in zip(writers, paths, strict=True):
            check()
            with files.draft(path) as place:
                write(place)
            done()
    except OSError as error:
        raise CannotWrite(out, error) from None
    except TooLong as error:
        raise UserError(str(error)) from None
