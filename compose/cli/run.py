"""`tandem run`: a mission on this machine."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from compose.cli import export_bar
from compose.errors import FAILED, STOPPED, UserError
from compose.extras import need
from compose.launch import processes
from compose.launch.signals import stop_by_signal
from compose.launch.viewers import Beside, beside, page, stay, viewers
from compose.recording.run import folder_for, read
from compose.scenario.kills import WORLD, Kill
from compose.scenario.scenario_file import ScenarioTemplate, check_rate, run_name, setting
from compose.terminal.outcome import break_off, conclude, shown_live
from protocol.journal.journal_file import CannotRecord
from protocol.network.inbox import Inbox, Interrupted
from protocol.spelling import did_you_mean
from world.scenario import Scenario


def main(options: argparse.Namespace) -> int:
    """Play the mission, as processes or in this one."""
    if not options.in_process:
        processes.fork_server()  # it imports while the launcher does
    found = setting(options.scenario, options.fault)
    scenario = found.seeded(options.seed)
    if options.out is not None and any(options.out.glob("*.journal")):
        raise UserError(f"--out: {options.out} holds a record already; choose another folder")
    _check_viewers(options)
    if options.export:
        need(*export_bar.MODULES)
        if options.out is None:
            raise UserError("--export: there is no --out DIR to leave it in")
    kills = _kills(options, found, scenario)
    if options.secure:
        need("cryptography", extra="deploy")
    if options.in_process:
        return _in_process(options, scenario, kills)
    return _as_processes(options, scenario, kills)


def _check_viewers(options: argparse.Namespace) -> None:
    """Raises UserError."""
    if options.port is not None and not options.watch:
        raise UserError("--port: of the page, and there is none without --watch")
    if options.foxglove is not None:
        need("foxglove")
    elif options.foxglove_origin:
        raise UserError("--foxglove-origin: of a page that shows what --foxglove serves, and there is none")


def _kills(options: argparse.Namespace, found: ScenarioTemplate, scenario: Scenario) -> tuple[Kill, ...]:
    """Those of the file, then those of the command line. Raises UserError."""
    ids = [robot.id for robot in scenario.robots]
    for kill in options.kill:
        if kill.who not in (*ids, WORLD):
            near = did_you_mean(kill.who, [*ids, WORLD])
            raise UserError(
                f"--kill: {kill.text}: there is no '{kill.who}'; there are {', '.join(ids)}, {WORLD}{near}"
            )
    return (*found.kills(scenario.seed), *options.kill)


def _in_process(options: argparse.Namespace, scenario: Scenario, kills: tuple[Kill, ...]) -> int:
    from compose.launch import in_process  # noqa: PLC0415  # the launcher needs no planner

    if options.secure:
        raise UserError("--secure: --in-process has no network")
    if kills:
        where = "--kill" if options.kill else f"{options.scenario}: kill"
        raise UserError(f"{where}: --in-process has no processes to kill")
    if options.rate is not None:
        raise UserError("--rate: --in-process knows no real time")
    if options.foxglove is not None:
        raise UserError("--foxglove: what --in-process plays is over before anyone could look")
    began = time.perf_counter()
    if options.out is None and not options.watch:
        return conclude(options, in_process.play(scenario), None, "in-process", began)
    with folder_for(options.out) as folder, _shown(options, scenario, folder) as shows:
        began = time.perf_counter()
        try:
            played = in_process.play(scenario, folder)
        except CannotRecord as error:
            raise UserError(f"--out: {error}") from None
        status = conclude(options, played, folder, "in-process", began)
        inbox = Inbox("tandem run")
        stop_by_signal(inbox)
        return _afterwards(options, folder, shows, inbox, status)


def _as_processes(options: argparse.Namespace, scenario: Scenario, kills: tuple[Kill, ...]) -> int:
    check_rate(scenario, options.rate)
    inbox = Inbox("tandem run")
    stop_by_signal(inbox)
    with (
        folder_for(options.out) as folder,
        _keys(options, scenario) as keys,
        _shown(options, scenario, folder) as shows,
    ):
        began = time.perf_counter()
        try:
            with shown_live(options, scenario, folder):
                spared = processes.play(
                    scenario,
                    folder,
                    inbox,
                    run=run_name(scenario),
                    rate=options.rate,
                    timeout=options.timeout,
                    kills=kills,
                    keys=keys,
                    agents_journal=bool(options.out is not None or kills or shows),
                )
        except processes.ChildFailed as failure:
            inbox.say(f"failed: {failure}")
            break_off(options, folder, str(failure), began)
            return FAILED
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            break_off(options, folder, f"stopped by {signal_name}", began)
            return STOPPED
        for kill in spared:
            inbox.say(f"--kill {kill.text}: never came")
        status = conclude(options, read(folder), folder, "processes", began)
        return _afterwards(options, folder, shows, inbox, status)


@contextmanager
def _keys(options: argparse.Namespace, scenario: Scenario) -> Iterator[Path | None]:
    """Keys for this run alone, if it is to be secured."""
    if not options.secure:
        yield None
        return
    from compose.security import certificates  # noqa: PLC0415  # there may be no such library

    with tempfile.TemporaryDirectory(prefix="tandem-keys-") as folder:
        certificates.make(Path(folder), [robot.id for robot in scenario.robots], (), 1)
        yield Path(folder)


@contextmanager
def _shown(options: argparse.Namespace, scenario: Scenario, folder: Path) -> Iterator[list[Beside]]:
    """What is to show the mission that is recorded in `folder`: it is there, and where has been said."""
    wanted = [page(folder, options.port or 0)] if options.watch else []
    if options.foxglove is not None:
        ids = [robot.id for robot in scenario.robots]
        wanted.append(viewers(folder, options.foxglove, options.foxglove_origin, ids))
    with ExitStack() as stack:
        shows = [stack.enter_context(beside(*one)) for one in wanted]
        for show in shows:
            show.announce()
        yield shows


def _afterwards(
    options: argparse.Namespace, folder: Path, shows: Sequence[Beside], inbox: Inbox, status: int
) -> int:
    """The outcome has been told: export the record, and stay as long as somebody looks; the exit status."""
    try:
        exported = _export(options, folder, inbox)
    except Interrupted as signal_name:
        inbox.say(f"stopped by {signal_name} before all was exported")
        return STOPPED
    stay(shows, inbox)
    return FAILED if options.export and not exported else status


def _export(options: argparse.Namespace, folder: Path, inbox: Inbox) -> bool:
    """Whether the record has been exported. Raises Interrupted."""
    if options.out is None or options.export is False:
        return False
    sys.stdout.flush()
    try:
        need(*export_bar.MODULES)
    except UserError as error:
        if not options.quiet:  # nobody asked for it
            inbox.say(f"not exported: {error}")
        return False
    try:
        export_bar.exported(folder, folder, inbox, quiet=options.quiet)
    except UserError as error:
        inbox.say(f"not exported: {error}")
        return False
    return True
