"""`tandem world`: the world of a mission whose robots join from wherever they reach it."""

from __future__ import annotations

import argparse
import time

from compose.keeping import conclude, named, progress, record_folder, validated
from compose.record import WORLD_JOURNAL, ended, read
from compose.status import LOCALISED, NOT_LOCALISED, STOPPED, UserError
from compose.stop import stops_into
from protocol import session
from protocol.inbox import Inbox, Interrupted
from protocol.journal import Journal, RecordExists
from world.process import WorldProcess


def main(options: argparse.Namespace) -> int:
    """Play the world's part."""
    scenario = validated(options)
    run = named(options, scenario)
    inbox = Inbox("tandem world")
    with stops_into(inbox), record_folder(options.out) as folder:
        began = time.perf_counter()
        try:
            with (
                session.open_router(options.listen) as link,
                Journal(folder / WORLD_JOURNAL, fsync=options.fsync) as journal,
            ):
                process = WorldProcess(
                    scenario, link, run, journal, inbox, rate=options.rate, patience=options.patience
                )
                if not options.quiet:
                    robots = ", ".join(robot.id for robot in scenario.robots)
                    print(f"run {run} at {options.listen}: waiting for {robots}", flush=True)
                with progress(options, scenario, folder):
                    end = process.play()
        except (session.BadEndpoint, session.CannotListen) as error:
            raise UserError(f"--listen: {error}") from None
        except RecordExists as error:
            raise UserError(f"--out: {error}") from None
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            return STOPPED
        if not options.quiet:
            return conclude(options, read(folder), folder, "processes", began)
    print(ended(end.outcome, end.tick, end.reason))
    return LOCALISED if end.outcome == "localised" else NOT_LOCALISED
