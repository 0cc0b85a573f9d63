"""The terminal output of a run, and the files derived from it at its end."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from compose.errors import status_of, writing
from compose.recording import run
from compose.recording.summary_json import Mode, leave, outcome_line, summary
from protocol.journal.journal_file import Journal
from protocol.journal.resume import Retrace
from protocol.network.inbox import Inbox
from protocol.output import say
from world.scenario import Scenario


@contextmanager
def shown_live(options: argparse.Namespace, scenario: Scenario, folder: Path) -> Iterator[None]:
    """Show the progress of the run recorded in `folder`, if standard output is a terminal."""
    if options.quiet or not sys.stdout.isatty():
        yield
        return
    from compose.terminal import live_display  # noqa: PLC0415  # loaded only if it is used

    with live_display.live(scenario, folder):
        yield


@contextmanager
def counting(what: str, steps: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on standard error if that is a terminal; yield a callback for each step."""
    if not steps or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.progress import Progress, TimeElapsedColumn  # noqa: PLC0415  # as above

    from compose.terminal import tables  # noqa: PLC0415

    console = tables.console(stderr=True, soft_wrap=True)  # other output is not wrapped
    with Progress(
        *Progress.get_default_columns(),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        redirect_stdout=sys.stdout.isatty(),  # the console would print it on standard error
    ) as bar:
        task = bar.add_task(what, total=steps)
        yield lambda: bar.advance(task)


@contextmanager
def concluded(
    options: argparse.Namespace, recording: run.Run, folder: Path | None, mode: Mode, began: float
) -> Iterator[int]:
    """Write `summary.json` and `ticks.csv` if `--out` is given, and yield the exit status of the outcome.

    The outcome is printed after the block, even if something cannot be written: the block writes further
    files, and the reader of the output may leave at the first line.

    `began` is the value of time.perf_counter at the start, in s. Raises UserError if the files cannot be
    written.
    """
    result = summary(recording, mode, round(time.perf_counter() - began, 6))
    try:
        if folder is not None and options.out is not None:
            with writing(folder):
                leave(recording, result, folder)
        yield status_of(result["outcome"])
    finally:
        if options.quiet:
            say(outcome_line(result))
        else:
            from compose.terminal import progress  # noqa: PLC0415  # as above

            progress.result(result, getattr(options, "rate", None))


def break_off(options: argparse.Namespace, folder: Path, mode: Mode, reason: str, began: float) -> None:
    """Write the derived files of a recording that breaks off, if `--out` is given and it is readable."""
    if options.out is None:
        return
    with suppress(OSError, ValueError):
        recording = run.read(folder)
        result = summary(recording, mode, round(time.perf_counter() - began, 6))
        leave(recording, result | {"reason": reason}, folder)


def reopened(old: Retrace, inbox: Inbox) -> Journal:
    """Return the journal of `old`, open for appending; report a torn end. Raises CannotRecord."""
    journal, cut = old.open_for_append()
    if cut:
        inbox.say(f"{old.path}: the last {cut} bytes are of a torn write and are cut off")
    return journal
