"""What is told of a run: while it runs, at its end, or where it breaks off."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from compose.errors import UserError, status_of
from compose.recording import run
from compose.recording.summary_json import Mode, leave, outcome_line, summary
from protocol.journal.journal_file import Journal
from protocol.journal.resume import Retrace
from protocol.network.inbox import Inbox
from protocol.output import say
from world.scenario import Scenario


@contextmanager
def shown_live(options: argparse.Namespace, scenario: Scenario, folder: Path) -> Iterator[None]:
    """Show the run while it runs, where somebody can see it."""
    if options.quiet or not sys.stdout.isatty():
        yield
        return
    from compose.terminal import progress  # noqa: PLC0415  # where nothing is shown, nothing is loaded to show it

    with progress.live(scenario, folder):
        yield


@contextmanager
def counting(what: str, steps: int) -> Iterator[Callable[[], None]]:
    """A bar of so many steps, if any, where somebody can see it; what is called after each of them."""
    if not steps or not sys.stdout.isatty():
        yield lambda: None
        return
    from rich.console import Console  # noqa: PLC0415  # as above
    from rich.progress import Progress, TimeElapsedColumn  # noqa: PLC0415

    console = Console(soft_wrap=True)  # what is printed meanwhile is not broken into lines
    with Progress(
        *Progress.get_default_columns(), TimeElapsedColumn(), console=console, transient=True
    ) as bar:
        task = bar.add_task(what, total=steps)
        yield lambda: bar.advance(task)


def conclude(
    options: argparse.Namespace,
    played: run.Recording,
    folder: Path | None,
    mode: Mode,
    began: float,
) -> int:
    """Say how it went, and leave the views of the record in `folder`, if it is to stay; the status.

    Raises UserError if there is no room for them.
    """
    told = summary(played, mode, round(time.perf_counter() - began, 6))
    if options.quiet:
        say(outcome_line(told))
    else:
        from compose.terminal import progress  # noqa: PLC0415  # as above

        progress.result(told, getattr(options, "rate", None))
    if folder is not None and options.out is not None:
        sys.stdout.flush()
        try:
            leave(played, told, folder)
        except OSError as error:
            raise UserError(run.cannot_write(folder, error)) from None
    return status_of(told["outcome"])


def break_off(options: argparse.Namespace, folder: Path, reason: str, began: float) -> None:
    """Leave the views of a record that has no end, if it is to stay; as far as there is a record."""
    if options.out is None:
        return
    with suppress(OSError, ValueError):
        played = run.read(folder)
        told = summary(played, "processes", round(time.perf_counter() - began, 6))
        leave(played, told | {"reason": reason}, folder)


def going_on(old: Retrace, inbox: Inbox) -> Journal:
    """The journal of `old`, to be written on; says so if its end was torn. Raises CannotRecord."""
    journal, cut = old.go_on()
    if cut:
        inbox.say(f"{old.path}: the last {cut} bytes were torn, and are cut off")
    return journal
