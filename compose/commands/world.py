"""`tandem world`: the world of a mission whose robots join from wherever they reach it."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import zenoh

from compose.keeping import conclude, named, progress, record_folder, validated
from compose.record import WORLD_JOURNAL, read
from compose.status import LOCALISED, NOT_LOCALISED, STOPPED, UserError
from compose.stop import stops_into
from protocol import session
from protocol.inbox import Inbox, Interrupted
from protocol.journal import Journal, RecordExists
from world.process import WorldProcess
from world.scenario import Scenario


def main(options: argparse.Namespace) -> int:
    """Play the world's part."""
    scenario = validated(options)
    run = named(options, scenario)
    inbox = Inbox("tandem world")
    with stops_into(inbox):
        try:
            with session.open_router(options.listen) as link, record_folder(options.out) as folder:
                return _play(options, scenario, run, link, folder, inbox)
        except (session.BadEndpoint, session.CannotListen) as error:
            raise UserError(f"--listen: {error}") from None
        except RecordExists as error:
            raise UserError(f"--out: {error}") from None
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            return STOPPED


def _play(
    options: argparse.Namespace,
    scenario: Scenario,
    run: str,
    link: zenoh.Session,
    folder: Path,
    inbox: Inbox,
) -> int:
    began = time.perf_counter()
    with Journal(folder / WORLD_JOURNAL, fsync=options.fsync) as journal:
        process = WorldProcess(
            scenario, link, run, journal, inbox, rate=options.rate, patience=options.patience
        )
        if not options.quiet:
            robots = ", ".join(robot.id for robot in scenario.robots)
            print(f"run {run} at {options.listen}: waiting for {robots}", flush=True)
        with progress(options, scenario, folder):
            end = process.play()
    if options.launched:
        return LOCALISED if end.outcome == "localised" else NOT_LOCALISED
    return conclude(options, read(folder), folder, "processes", began)
