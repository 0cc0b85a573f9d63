"""`tandem world`: run the simulator of a mission; agents connect to it."""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from pathlib import Path

from compose.cli.arguments import (
    add_closing,
    add_connection,
    add_fsync,
    add_launched,
    add_listen,
    add_running,
    add_scenario,
    kill,
    name,
)
from compose.errors import ENDED, FAILED, STOPPED, UserError
from compose.launch.processes import scenario_from_launcher
from compose.launch.signals import stop_by_signal, stop_with_launcher
from compose.network import beyond, reach
from compose.recording.run import WORLD_JOURNAL, folder_for, read
from compose.scenario import kills
from compose.scenario.scenario_file import check_rate, run_name, setting
from compose.terminal.outcome import break_off, conclude, reopened, shown_live
from protocol import limits
from protocol.journal.journal_file import CannotRecord, CorruptJournal, Journal
from protocol.journal.resume import Retrace
from protocol.network import session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say
from world.process import NoRouter, WorldLinks, WorldProcess
from world.scenario import Scenario
from world.simulation import Simulation, resumed

RELISTEN_S = 5.0
"""s to wait for the port of a world that has just been killed to become free."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem world`."""
    add_scenario(parser)
    add_running(parser)
    parser.add_argument(
        "--run",
        type=name,
        metavar="NAME",
        help="name of the run [default: the scenario's and a random suffix]",
    )
    add_connection(parser)
    add_listen(parser, "endpoint on which this process is a Zenoh router")
    add_fsync(parser)
    add_launched(parser)
    parser.add_argument("--kill", type=kill, action="append", default=[], help=argparse.SUPPRESS)
    add_closing(parser, "tandem world paper-1 --listen tcp/127.0.0.1:7447 --out recording", "docs/network.md")


def main(options: argparse.Namespace) -> int:
    """Run the world to the end of its mission, and return the exit status of the outcome."""
    scenario = _scenario(options)
    check_rate(scenario, options.rate)
    inbox = Inbox("tandem world")
    if options.launched:
        stop_with_launcher(inbox)
    stop_by_signal(inbox)
    try:
        endpoints = _endpoints(options)
        recording = _old_journal(options)
        simulation = resumed(scenario, recording) if recording is not None else None
        limits.need_files(limits.SESSION_FILES + len(scenario.robots), "a world with a link to each robot")
        with ExitStack() as stack:
            wait = RELISTEN_S if recording is not None else 0.0
            links = stack.enter_context(WorldLinks(endpoints, options.timeout, inbox, wait))
            if (warning := beyond(endpoints)) is not None:
                inbox.say(warning)
            folder = stack.enter_context(folder_for(options.out))
            if simulation is None or recording is None:
                journal = stack.enter_context(Journal(folder / WORLD_JOURNAL, fsync=options.fsync))
                return _run(options, Simulation(scenario, journal), links, folder, inbox)
            simulation.append_to(stack.enter_context(reopened(recording, inbox)))
            return _run(options, simulation, links, folder, inbox)
    except session.CannotListen as error:
        raise UserError(f"--listen: {error}") from None
    except CannotRecord as error:
        raise UserError(f"--out: {error}") from None
    except CorruptJournal as error:
        raise UserError(f"--out: {error}; choose another folder") from None
    except NoRouter as error:
        inbox.say(str(error))
        return FAILED
    except Interrupted as signal_name:
        inbox.say(f"stopped by {signal_name}")
        return STOPPED


def _scenario(options: argparse.Namespace) -> Scenario:
    """Return the scenario of the launcher or of the command line. Raises UserError."""
    if options.launched:
        return scenario_from_launcher()
    found = setting(options.scenario, options.fault)
    if found.file.kill:
        raise UserError(
            f"{options.scenario}: kill: `tandem world` does not restart processes; use `tandem run`"
        )
    return found.seeded(options.seed)


def _endpoints(options: argparse.Namespace) -> Endpoints:
    """Return the endpoints of the flags. Raises UserError if there are none."""
    found = reach(options, "world")
    if not found.connect and not found.listen:
        raise UserError("--listen ENDPOINT is required, such as tcp/127.0.0.1:7447, or --connect to a router")
    return found


def _old_journal(options: argparse.Namespace) -> Retrace | None:
    """Return the journal of an earlier world in --out, if there is one."""
    path: Path | None = options.out / WORLD_JOURNAL if options.out is not None else None
    return Retrace(path, fsync=options.fsync) if path is not None and path.exists() else None


def _run(
    options: argparse.Namespace, simulation: Simulation, links: WorldLinks, folder: Path, inbox: Inbox
) -> int:
    """Run the mission, write its files, and return the exit status. Raises Interrupted or NoRouter."""
    began = time.perf_counter()
    scenario = simulation.world.scenario
    run = options.run or run_name(scenario, options.out)
    process = WorldProcess(
        simulation,
        run,
        inbox,
        rate=options.rate,
        timeout=options.timeout,
        on_kill_point=kills.taker(options.kill),
    )
    if not (options.quiet or options.launched):
        robots = ", ".join(robot.id for robot in scenario.robots)
        where = f", resumed at tick {simulation.tick}" if simulation.tick else ""
        at = " and ".join(links.endpoints.listen) or links.endpoints
        say(f"run {run} at {at}{where}: waiting for {robots}")
    try:
        with shown_live(options, scenario, folder):
            links.run(process)
    except (Interrupted, NoRouter) as stop:
        if not options.launched:
            reason = f"stopped by {stop}" if isinstance(stop, Interrupted) else str(stop)
            break_off(options, folder, reason, began)
        raise
    if options.launched:  # the launcher prints the outcome
        return ENDED
    return conclude(options, read(folder), folder, "processes", began)
