"""`tandem run`: run a mission on this machine."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

from compose.cli import export
from compose.cli.recording import read_noted
from compose.errors import FAILED, STOPPED_STATUS, UserError
from compose.extras import need
from compose.launch import processes, supervisor
from compose.launch.page_process import PageProcess, serving
from compose.launch.signals import INTERRUPTION, stop_by_signal
from compose.recording.kills_file import KILLS
from compose.recording.recording_files import folder_for, not_recorded, user_errors
from compose.recording.run import Run, read
from compose.recording.summary_json import Mode
from compose.scenario.kills import Kill
from compose.scenario.run_settings import check_rate, run_name
from compose.scenario.scenario_file import setting
from compose.terminal.outcome import break_off, concluded, shown_live
from protocol.journal.journal_file import CannotRecord
from protocol.network.clock import ClockError
from protocol.network.inbox import Inbox, Interrupted
from world.scenario import Scenario


def main(options: argparse.Namespace) -> int:
    """Run the mission, as processes or in this one, and return the exit status of its outcome."""
    if not options.in_process:
        supervisor.fork_server()  # it imports modules while this process does
    found = setting(options.scenario, options.fault, options.planner, options.planner_option)
    scenario = found.seeded(options.seed)
    if options.out is not None and (any(options.out.glob("*.journal")) or (options.out / KILLS).exists()):
        raise UserError(f"--out: {options.out} already contains a recording; choose another folder")
    if options.port is not None and not options.watch:
        raise UserError("--port: it needs --watch, which serves the page")
    if options.export:
        need(*export.EXPORT_MODULES)
        if options.out is None:
            raise UserError("--export: it needs --out DIR")
    kills = found.kills(scenario.seed, options.kill)
    if options.secure:
        need("cryptography", extra="deploy")
    if options.in_process:
        return _in_process(options, scenario, kills)
    return _as_processes(options, scenario, kills, found.clocks)


def _in_process(options: argparse.Namespace, scenario: Scenario, kills: tuple[Kill, ...]) -> int:
    from compose.launch import in_process  # noqa: PLC0415  # processes need no planner here

    if options.secure:
        raise UserError("--secure: --in-process has no network")
    if kills:
        where = "--kill" if options.kill else f"{options.scenario}: kill"
        raise UserError(f"{where}: --in-process has no processes to kill")
    if options.rate is not None:
        raise UserError("--rate: --in-process cannot run in real time")
    began = time.perf_counter()
    if options.out is None and not options.watch:
        with concluded(options, in_process.run_mission(scenario), None, "in-process", began) as status:
            return status
    inbox = Inbox("tandem run")
    with folder_for(options.out) as folder, _page(options, folder, inbox) as page:
        began = time.perf_counter()
        try:
            finished = in_process.run_mission(scenario, folder)
        except CannotRecord as error:
            raise not_recorded(error) from None
        except KeyboardInterrupt:
            break_off(options, folder, "in-process", f"stopped by {INTERRUPTION.signal_name}", began)
            raise
        stop_by_signal(inbox)
        return _finish(options, finished, folder, "in-process", began, page, inbox)


def _as_processes(
    options: argparse.Namespace, scenario: Scenario, kills: tuple[Kill, ...], clocks: Mapping[str, ClockError]
) -> int:
    check_rate(scenario, options.rate)
    inbox = Inbox("tandem run")
    with (
        folder_for(options.out) as folder,
        _keys(scenario) if options.secure else nullcontext() as keys,
        _page(options, folder, inbox) as page,
    ):
        began = time.perf_counter()
        try:
            with shown_live(options, scenario, folder):
                spared = processes.run_mission(
                    scenario,
                    folder,
                    inbox,
                    run=run_name(scenario),
                    rate=options.rate,
                    timeout=options.timeout,
                    kills=kills,
                    clocks=clocks,
                    keys=keys,
                    agents_journal=bool(options.out is not None or kills or page),
                    on_start=lambda: stop_by_signal(inbox),
                )
        except supervisor.ChildFailed as failure:
            break_off(options, folder, "processes", str(failure), began)
            inbox.say(f"failed: {failure}")
            return FAILED
        except KeyboardInterrupt:
            break_off(options, folder, "processes", f"stopped by {INTERRUPTION.signal_name}", began)
            raise
        except Interrupted as signal_name:
            break_off(options, folder, "processes", f"stopped by {signal_name}", began)
            inbox.say(f"stopped by {signal_name}")
            return STOPPED_STATUS
        for kill in spared:
            inbox.say(f"--kill {kill.text}: not reached")
        return _finish(options, read(folder), folder, "processes", began, page, inbox)


@contextmanager
def _keys(scenario: Scenario) -> Iterator[Path]:
    """Create keys for this run only, and yield their folder."""
    from compose.security import certificates  # noqa: PLC0415  # the library is optional

    with tempfile.TemporaryDirectory(prefix="tandem-keys-") as folder:
        certificates.make(Path(folder), [robot.id for robot in scenario.robots], (), 1)
        yield Path(folder)


def _page(
    options: argparse.Namespace, folder: Path, inbox: Inbox
) -> AbstractContextManager[PageProcess | None]:
    """Return the context in which the page of the mission is served, with --watch."""
    if not options.watch:
        return nullcontext()
    return serving(folder, options.port or 0, inbox, lockstep=options.rate is None)


def _finish(
    options: argparse.Namespace,
    run: Run,
    folder: Path,
    mode: Mode,
    began: float,
    page: PageProcess | None,
    inbox: Inbox,
) -> int:
    """Write all files, print the outcome, serve the page until it is stopped, and return the status."""
    try:
        with concluded(options, run, folder, mode, began) as status:
            exported = _export(options, folder, inbox, None if options.in_process else run)
    except Interrupted as signal_name:
        inbox.say(f"stopped by {signal_name} before the export was complete")
        return STOPPED_STATUS
    served = page is None or page.stay(inbox)
    return FAILED if not served or (options.export and not exported) else status


def _export(options: argparse.Namespace, folder: Path, inbox: Inbox, run: Run | None) -> bool:
    """Export the recording if the flags allow it, and return whether it was done. Raises Interrupted.

    `run` is the recording if it has been read already.
    """
    if options.out is None or options.export is False:
        return False
    try:
        need(*export.EXPORT_MODULES)
    except UserError as error:
        if not options.quiet:  # the export was not requested
            inbox.say(f"not exported: {error}")
        return False
    try:
        with user_errors(folder):
            whole = run or read_noted(folder, "export")
        export.exported(whole, folder, folder, lambda: inbox.next(0.0), quiet=options.quiet)
    except UserError as error:
        inbox.say(f"not exported: {error}")
        return False
    return True
