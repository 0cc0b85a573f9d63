"""`tandem run`: a mission on this machine."""

from __future__ import annotations

import argparse
import time

from compose import local
from compose.keeping import break_off, conclude, named, progress, record_folder, validated
from compose.record import read
from compose.status import FAILED, STOPPED, UserError
from compose.stop import stops_into
from protocol.inbox import Inbox, Interrupted
from world.scenario import Scenario


def main(options: argparse.Namespace) -> int:
    """Play the mission, as processes or in this one."""
    scenario = validated(options)
    if options.out is not None and any(options.out.glob("*.journal")):
        raise UserError(f"--out: {options.out} holds a record already; choose another folder")
    return _in_process(options, scenario) if options.in_process else _as_processes(options, scenario)


def _in_process(options: argparse.Namespace, scenario: Scenario) -> int:
    from compose import inline  # noqa: PLC0415  # the launcher needs no planner

    if options.rate is not None:
        raise UserError("--rate: --in-process knows no real time")
    began = time.perf_counter()
    if options.out is None:
        return conclude(options, inline.play(scenario), None, "in-process", began)
    with record_folder(options.out) as folder:
        return conclude(options, inline.play(scenario, folder), folder, "in-process", began)


def _as_processes(options: argparse.Namespace, scenario: Scenario) -> int:
    arguments = [options.scenario]
    for option, value in (("--seed", options.seed), ("--rate", options.rate)):
        if value is not None:
            arguments += [option, str(value)]
    inbox = Inbox("tandem run")
    with stops_into(inbox), record_folder(options.out) as folder:
        began = time.perf_counter()
        run = named(options, scenario)
        try:
            with progress(options, scenario, folder):
                local.play(scenario, arguments, folder, inbox, run=run, patience=options.patience)
        except local.ChildFailed as failure:
            inbox.say(f"failed: {failure}")
            break_off(options, folder, str(failure), began)
            return FAILED
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            break_off(options, folder, f"stopped by {signal_name}", began)
            return STOPPED
        return conclude(options, read(folder), folder, "processes", began)
