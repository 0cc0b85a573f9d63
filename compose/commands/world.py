"""`tandem world`: the world of a mission whose robots join from wherever they reach it."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import zenoh

from compose import kill
from compose.local import handed
from compose.record import WORLD_JOURNAL, folder_for, read
from compose.scenario import check_rate, run_name, setting
from compose.status import ENDED, STOPPED, UserError
from compose.stop import stop_by_signal, stop_with_launcher
from compose.telling import break_off, conclude, going_on, progress
from protocol import session
from protocol.inbox import Inbox, Interrupted
from protocol.journal import CannotRecord, CorruptJournal, Journal
from protocol.retrace import Retrace
from world.course import Course, again
from world.process import WorldProcess

RELISTEN_S = 5.0
"""how long the port of a world that has just been killed may stay busy"""


def main(options: argparse.Namespace) -> int:
    """Play the world's part."""
    if options.launched:
        scenario = handed()
    else:
        found = setting(options.scenario, options.fault)
        if found.file.kill:
            raise UserError(f"{options.scenario}: kill: a world starts nobody again; `tandem run` does")
        scenario = found.seeded(options.seed)
    check_rate(scenario, options.rate)
    inbox = Inbox("tandem world")
    if options.launched:
        stop_with_launcher(inbox)
    stop_by_signal(inbox)
    try:
        session.check_endpoint(options.listen)
        record = _record(options)
        course = again(scenario, record) if record is not None else None
        wait = RELISTEN_S if record is not None else 0.0
        with session.open_router(options.listen, wait) as link, folder_for(options.out) as folder:
            if course is None or record is None:
                with Journal(folder / WORLD_JOURNAL, fsync=options.fsync) as journal:
                    return _play(options, Course(scenario, journal), link, folder, inbox)
            with going_on(record, inbox) as journal:
                course.keep(journal)
                return _play(options, course, link, folder, inbox)
    except (session.BadEndpoint, session.CannotListen) as error:
        raise UserError(f"--listen: {error}") from None
    except CannotRecord as error:
        raise UserError(f"--out: {error}") from None
    except CorruptJournal as error:
        raise UserError(f"--out: {error}; choose another folder") from None


def _record(options: argparse.Namespace) -> Retrace | None:
    """What a world has left in the folder before, if one has."""
    path: Path | None = options.out / WORLD_JOURNAL if options.out is not None else None
    return Retrace(path, fsync=options.fsync) if path is not None and path.exists() else None


def _play(
    options: argparse.Namespace, course: Course, link: zenoh.Session, folder: Path, inbox: Inbox
) -> int:
    began = time.perf_counter()
    scenario = course.world.scenario
    run = options.run or run_name(scenario, options.out)
    process = WorldProcess(
        course,
        link,
        run,
        inbox,
        rate=options.rate,
        patience=options.patience,
        reached=kill.taker(options.kill),
    )
    if not (options.quiet or options.launched):
        robots = ", ".join(robot.id for robot in scenario.robots)
        where = f", again, at tick {course.tick}" if course.tick else ""
        print(f"run {run} at {options.listen}{where}: waiting for {robots}", flush=True)
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
