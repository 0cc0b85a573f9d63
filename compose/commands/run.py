"""`tandem run`: a mission on this machine."""

from __future__ import annotations

import argparse
import time

from compose import local
from compose.kill import WORLD
from compose.record import folder_for, read
from compose.scenario import check_rate, load, run_name
from compose.status import FAILED, STOPPED, UserError
from compose.stop import stop_by_signal
from compose.telling import break_off, conclude, progress
from protocol.inbox import Inbox, Interrupted
from protocol.journal import CannotRecord
from world.scenario import Scenario


def main(options: argparse.Namespace) -> int:
    """Play the mission, as processes or in this one."""
    scenario = load(options.scenario, seed=options.seed, faults=options.fault)
    if options.out is not None and any(options.out.glob("*.journal")):
        raise UserError(f"--out: {options.out} holds a record already; choose another folder")
    for kill in options.kill:
        ids = [robot.id for robot in scenario.robots]
        if kill.who not in (*ids, WORLD):
            raise UserError(
                f"--kill: {kill.text}: there is no '{kill.who}'; there are {', '.join(ids)}, {WORLD}"
            )
    return _in_process(options, scenario) if options.in_process else _as_processes(options, scenario)


def _in_process(options: argparse.Namespace, scenario: Scenario) -> int:
    from compose import inline  # noqa: PLC0415  # the launcher needs no planner

    if options.rate is not None:
        raise UserError("--rate: --in-process knows no real time")
    if options.kill:
        raise UserError("--kill: --in-process has no processes to kill")
    began = time.perf_counter()
    if options.out is None:
        return conclude(options, inline.play(scenario), None, "in-process", began)
    with folder_for(options.out) as folder:
        try:
            played = inline.play(scenario, folder)
        except CannotRecord as error:
            raise UserError(f"--out: {error}") from None
        return conclude(options, played, folder, "in-process", began)


def _as_processes(options: argparse.Namespace, scenario: Scenario) -> int:
    check_rate(scenario, options.rate)
    inbox = Inbox("tandem run")
    stop_by_signal(inbox)
    with folder_for(options.out) as folder:
        began = time.perf_counter()
        try:
            with progress(options, scenario, folder):
                spared = local.play(
                    scenario,
                    folder,
                    inbox,
                    run=run_name(scenario),
                    rate=options.rate,
                    patience=options.patience,
                    kills=options.kill,
                )
        except local.ChildFailed as failure:
            inbox.say(f"failed: {failure}")
            break_off(options, folder, str(failure), began)
            return FAILED
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            break_off(options, folder, f"stopped by {signal_name}", began)
            return STOPPED
        for kill in spared:
            inbox.say(f"--kill {kill.text}: never came")
        return conclude(options, read(folder), folder, "processes", began)
