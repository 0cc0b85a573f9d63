"""`tandem agent`: run the agent of one robot; it connects to a world."""

from __future__ import annotations

import argparse
from pathlib import Path

from agent.process.discovery import NoWorld, Search, Unwelcome, join
from agent.process.link import WorldLinkLost
from agent.process.node import AgentProcess
from agent.process.recovery import Memory, remember
from agent.process.robot import Robot
from compose.cli.arguments import (
    add_closing,
    add_connect_timeout,
    add_connection,
    add_fsync,
    add_launched,
    add_listen,
    add_running,
    kill,
    name,
)
from compose.errors import ENDED, FAILED, STOPPED, UserError, status_of
from compose.launch.signals import stop_by_signal, stop_with_launcher
from compose.network import beyond, reach
from compose.recording.summary_json import ended
from compose.scenario import kills
from compose.terminal.outcome import going_on
from protocol.journal.journal_file import CannotRecord, CorruptJournal, Journal
from protocol.journal.resume import Retrace
from protocol.messages import MissionEnd, RobotConfig
from protocol.network import session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say

STILL_THERE_S = 3.0
"""how long an agent whose mission has ended looks for a world that may not know its last word"""
LAST_WORD_S = 10.0
"""how long it then waits for what such a world says"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem agent`."""
    parser.add_argument("id", type=name, metavar="ID", help="id of the robot in the scenario")
    add_running(parser)
    parser.add_argument(
        "--run", type=name, metavar="NAME", help="name of the run [default: the only one that is running]"
    )
    add_connect_timeout(parser, "a world")
    add_connection(parser)
    add_listen(parser, "endpoint on which this process is a Zenoh router")
    add_fsync(parser)
    add_launched(parser)
    parser.add_argument("--kill", type=kill, action="append", default=[], help=argparse.SUPPRESS)
    add_closing(parser, "tandem agent a --connect tcp/127.0.0.1:7447 --out recording-a", "docs/network.md")


def main(options: argparse.Namespace) -> int:
    """Run the agent to the end of its mission, and return the exit status of the outcome."""
    inbox = Inbox(f"tandem agent {options.id}")
    if options.launched:
        stop_with_launcher(inbox)
    stop_by_signal(inbox)
    try:
        end = _play(options, inbox)
    except session.CannotListen as error:
        raise UserError(f"--listen: {error}") from None
    except CannotRecord as error:
        raise UserError(f"--out: {error}") from None
    except CorruptJournal as error:
        raise UserError(f"--out: {error}; choose another folder") from None
    except Unwelcome as error:
        raise UserError(str(error)) from None
    except NoWorld as error:
        inbox.say(str(error))
        return FAILED
    except Interrupted as signal_name:
        inbox.say(f"stopped by {signal_name}")
        return STOPPED
    if options.launched:
        return ENDED
    say(f"{options.id}: {ended(end.outcome, end.tick, end.reason)}")
    return status_of(end.outcome)


def _play(options: argparse.Namespace, inbox: Inbox) -> MissionEnd:
    endpoints = _endpoints(options)
    path: Path | None = options.out / f"agent-{options.id}.journal" if options.out is not None else None
    old = Retrace(path, fsync=options.fsync) if path is not None and path.exists() else None
    memory = remember(old) if old is not None else None
    end = memory.end if memory is not None else None
    which = f"world of run '{options.run}'" if options.run else "world"
    wait = options.connect_timeout if end is None else min(options.connect_timeout, STILL_THERE_S)
    timeout = options.timeout if end is None else min(options.timeout, LAST_WORD_S)
    search = Search(which, endpoints, wait, inbox)
    warning = beyond(endpoints)
    process: AgentProcess | None = None
    while True:
        try:
            with session.open_session(
                endpoints, search.go_on if process is None else process.unanswered, session.CLOSE_TIMEOUT_S
            ) as link:
                if process is None:
                    if warning is not None:
                        inbox.say(warning)
                        warning = None
                    joined = join(link, options.run, options.id, search)
                    if joined is None:  # a session that has lost its link finds nothing; a new one may
                        continue
                    run, config = joined
                    if memory is not None and old is not None and memory.config != config:
                        raise CorruptJournal(f"{old.path}: another run's: its briefing is not this world's")
                    memory = _ready(options, config, old, memory, inbox)
                    process = AgentProcess(
                        memory, run, inbox, timeout=timeout, on_kill_point=kills.taker(options.kill)
                    )
                    process.attach(link)
                    if not (options.quiet or options.launched):
                        again = memory.observation
                        where = f", again, from tick {again.tick} on" if again is not None else ""
                        say(f"{options.id}: in run {run}, with {config.peer}{where}")
                else:
                    process.attach(link)
                return _left(options, process.play())
        except WorldLinkLost:
            continue
        except NoWorld:
            end = process.end if process is not None else end
            if end is None:
                raise
            return end


def _left(options: argparse.Namespace, end: MissionEnd) -> MissionEnd:
    """Return `end`; a process of a launcher ends here instead, with its link open.

    The world has all of it on record, and where many robots end at once, closing takes a while.
    """
    if options.launched:
        session.leave(ENDED)
    return end


def _endpoints(options: argparse.Namespace) -> Endpoints:
    found = reach(options, f"agent-{options.id}")
    if not found.connect and not found.listen:
        raise UserError("--connect ENDPOINT is needed, such as tcp/127.0.0.1:7447")
    return found


def _ready(
    options: argparse.Namespace,
    config: RobotConfig,
    old: Retrace | None,
    memory: Memory | None,
    inbox: Inbox,
) -> Memory:
    """What the robot knows, its journal open to be written on. Raises CannotRecord."""
    journal: Journal | None = None
    if old is not None:
        journal = going_on(old, inbox)
    elif options.out is not None:
        journal = Journal(options.out / f"agent-{options.id}.journal", fsync=options.fsync)
    if memory is None:
        return Memory(config, Robot(config, journal))
    memory.robot.keep(journal)
    return memory
