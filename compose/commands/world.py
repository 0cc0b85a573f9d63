"""`tandem world`: the world of a mission whose robots join from wherever they reach it."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import zenoh

from compose.local import handed
from compose.record import WORLD_JOURNAL, folder_for, read
from compose.scenario import check_rate, load, run_name
from compose.status import ENDED, STOPPED, UserError
from compose.stop import stop_by_signal, stop_with_launcher
from compose.telling import break_off, conclude, progress
from protocol import session
from protocol.inbox import Inbox, Interrupted
from protocol.journal import CannotRecord, Journal
from world.process import WorldProcess
from world.scenario import Scenario


def main(options: argparse.Namespace) -> int:
    """Play the world's part."""
    if options.launched:
        scenario = handed()
    else:
        scenario = load(options.scenario, seed=options.seed, faults=options.fault)
    check_rate(scenario, options.rate)
    inbox = Inbox("tandem world")
    if options.launched:
        stop_with_launcher(inbox)
    stop_by_signal(inbox)
    try:
        with session.open_router(options.listen) as link, folder_for(options.out) as folder:
            return _play(options, scenario, link, folder, inbox)
    except (session.BadEndpoint, session.CannotListen) as error:
        raise UserError(f"--listen: {error}") from None
    except CannotRecord as error:
        raise UserError(f"--out: {error}") from None


def _play(
    options: argparse.Namespace, scenario: Scenario, link: zenoh.Session, folder: Path, inbox: Inbox
) -> int:
    began = time.perf_counter()
    run = options.run or run_name(scenario)
    with Journal(folder / WORLD_JOURNAL, fsync=options.fsync) as journal:
        process = WorldProcess(
            scenario, link, run, journal, inbox, rate=options.rate, patience=options.patience
        )
        if not (options.quiet or options.launched):
            robots = ", ".join(robot.id for robot in scenario.robots)
            print(f"run {run} at {options.listen}: waiting for {robots}", flush=True)
        try:
            with progress(options, scenario, folder):
                process.play()
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            if not options.launched:
                break_off(options, folder, f"stopped by {signal_name}", began)
            return STOPPED
    if options.launched:  # who did so concludes
        return ENDED
    return conclude(options, read(folder), folder, "processes", began)
