"""`tandem world`: run the simulator of a mission; agents connect to it."""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from pathlib import Path

from compose.cli.participant import RELISTEN_S, endpoints_of, old_journal, participate, replayed, warn_beyond
from compose.errors import ENDED, UserError
from compose.launch.processes import scenario_from_launcher
from compose.launch.signals import stop_by_signal
from compose.recording.recording_files import WORLD_JOURNAL, folder_for
from compose.recording.run import read
from compose.scenario import kills
from compose.scenario.run_settings import check_rate, run_name
from compose.scenario.scenario_file import setting
from compose.terminal.outcome import break_off, concluded, reopened, shown_live
from compose.terminal.text_width import tell
from protocol import limits
from protocol.journal.journal_file import Journal
from protocol.network.inbox import Inbox, Interrupted
from world.process import NoRouter, WorldLinks, WorldProcess
from world.scenario import Scenario
from world.simulation import Simulation, resumed

LISTEN_MISSING = "--listen ENDPOINT is required, such as tcp/127.0.0.1:7447, or --connect to a router"


def main(options: argparse.Namespace) -> int:
    """Run the world to the end of its mission, and return the exit status of the outcome."""
    scenario = _scenario(options)
    check_rate(scenario, options.rate)

    def take_part(inbox: Inbox) -> int:
        endpoints = endpoints_of(options, "world", LISTEN_MISSING)
        recording = old_journal(options, WORLD_JOURNAL)
        simulation = resumed(scenario, recording) if recording is not None else None
        limits.need_files(limits.SESSION_FILES + len(scenario.robots), "a world with a link to each robot")
        with ExitStack() as stack:
            wait = RELISTEN_S if recording is not None else 0.0
            links = stack.enter_context(WorldLinks(endpoints, options.timeout, inbox, wait))
            warn_beyond(endpoints, inbox)
            folder = stack.enter_context(folder_for(options.out))
            if simulation is None or recording is None:
                journal = stack.enter_context(Journal(folder / WORLD_JOURNAL, fsync=options.fsync))
                return _run(options, Simulation(scenario, journal), links, folder, inbox)
            simulation.append_to(stack.enter_context(reopened(recording, inbox)))
            if options.launched:
                inbox.say(replayed(simulation.tick))
            return _run(options, simulation, links, folder, inbox)

    return participate("tandem world", take_part, (NoRouter,), launched=options.launched, clock=options.clock)


def _scenario(options: argparse.Namespace) -> Scenario:
    """Return the scenario of the launcher or of the command line. Raises UserError."""
    if options.launched:
        return scenario_from_launcher()
    found = setting(options.scenario, options.fault, options.planner, options.planner_option)
    for name, tables in (("kill", found.file.kill), ("clock", found.file.clock)):
        if tables:
            raise UserError(f"{options.scenario}: {name}: `tandem world` starts no robots; use `tandem run`")
    return found.seeded(options.seed)


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
    stop_by_signal(inbox)
    links.attach(process)
    if not (options.quiet or options.launched):
        robots = ", ".join(robot.id for robot in scenario.robots)
        where = f", resumed at tick {simulation.tick}" if simulation.tick else ""
        at = " and ".join(links.endpoints.listen) or links.endpoints
        tell(f"run {run} at {at}{where}: waiting for {robots}")
    try:
        with shown_live(options, scenario, folder):
            links.run(process)
    except (Interrupted, NoRouter) as stop:
        if not options.launched:
            reason = f"stopped by {stop}" if isinstance(stop, Interrupted) else str(stop)
            break_off(options, folder, "processes", reason, began)
        raise
    if options.launched:  # the launcher prints the outcome
        return ENDED
    with concluded(options, read(folder), folder, "processes", began) as status:
        return status
