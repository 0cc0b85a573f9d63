"""`tandem world`: run the simulator of a mission; agents connect to it."""

from __future__ import annotations

import argparse
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import zenoh

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
from compose.launch.processes import handed
from compose.launch.signals import stop_by_signal, stop_with_launcher
from compose.network import beyond, reach
from compose.recording.run import WORLD_JOURNAL, folder_for, read
from compose.scenario import kills
from compose.scenario.scenario_file import check_rate, run_name, setting
from compose.terminal.outcome import break_off, conclude, going_on, shown_live
from protocol import limits
from protocol.journal.journal_file import CannotRecord, CorruptJournal, Journal
from protocol.journal.resume import Retrace
from protocol.network import diagnosis, session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say
from world.process import RobotsLinkLost, WorldProcess
from world.scenario import Scenario
from world.simulation import Course, again

RELISTEN_S = 5.0
"""how long the port of a world that has just been killed may stay busy"""
LOOK_AGAIN_S = 0.05
"""how long to wait before trying a router again"""


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
        recording = _record(options)
        course = again(scenario, recording) if recording is not None else None
        limits.need_files(limits.SESSION_FILES + len(scenario.robots), "a world with a link to each robot")
        with ExitStack() as stack:
            wait = RELISTEN_S if recording is not None else 0.0
            way = stack.enter_context(_Way(endpoints, options.timeout, inbox, wait))
            if (warning := beyond(endpoints)) is not None:
                inbox.say(warning)
            folder = stack.enter_context(folder_for(options.out))
            if course is None or recording is None:
                journal = stack.enter_context(Journal(folder / WORLD_JOURNAL, fsync=options.fsync))
                return _play(options, Course(scenario, journal), way, folder, inbox)
            course.keep(stack.enter_context(going_on(recording, inbox)))
            return _play(options, course, way, folder, inbox)
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
    if options.launched:
        return handed()
    found = setting(options.scenario, options.fault)
    if found.file.kill:
        raise UserError(f"{options.scenario}: kill: a world starts nobody again; `tandem run` does")
    return found.seeded(options.seed)


def _endpoints(options: argparse.Namespace) -> Endpoints:
    found = reach(options, "world")
    if not found.connect and not found.listen:
        raise UserError("--listen ENDPOINT is needed, such as tcp/127.0.0.1:7447, or --connect to a router's")
    return found


class NoRouter(TimeoutError):
    """The router that the world is to be a client of is not there; says so."""


class _Way:
    """One session of the world's after the other."""

    def __init__(self, endpoints: Endpoints, timeout: float, inbox: Inbox, wait: float) -> None:
        """`wait` (s) bounds how long to wait for where it listens to be free, `timeout` for a router."""
        self.endpoints = endpoints
        self._timeout = timeout
        self._inbox = inbox
        self._wait = wait
        self._open = ExitStack()

    def open(self) -> None:
        """Close the session there is, and open another. Raises CannotListen, NoRouter or Interrupted."""
        self._open.close()
        give_up = time.monotonic() + self._timeout
        self.session: zenoh.Session | None = None

        def unanswered() -> None:
            if time.monotonic() >= give_up:
                why = diagnosis.why(self.endpoints)
                raise NoRouter(f"no router at {self.endpoints}; gave up after {self._timeout:g} s: {why}")
            self._inbox.next(LOOK_AGAIN_S)

        if self.endpoints.connect:
            later = threading.Timer(diagnosis.FIRST_WORD_S, self._tell_if_alone)
            later.daemon = True
            later.start()
            self._open.callback(later.cancel)
        opened = session.open_session(self.endpoints, unanswered, self._wait)
        self.session = self._open.enter_context(opened)

    def _tell_if_alone(self) -> None:
        """A router goes on without those that it connects to, and a client waits for one; they may come."""
        if self.session is None or not session.linked(self.session):
            self._inbox.say(f"no router at {self.endpoints} yet: {diagnosis.why(self.endpoints)}")

    def play(self, process: WorldProcess) -> None:
        """The run to its MissionEnd, over as many sessions as it takes. Raises NoRouter or Interrupted."""
        while True:
            assert self.session is not None
            process.attach(self.session, replaceable=self.endpoints.mode == "client")
            try:
                process.play()
            except RobotsLinkLost:
                self.open()
            else:
                return

    def __enter__(self) -> _Way:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()


def _record(options: argparse.Namespace) -> Retrace | None:
    """What a world has left in the folder before, if one has."""
    path: Path | None = options.out / WORLD_JOURNAL if options.out is not None else None
    return Retrace(path, fsync=options.fsync) if path is not None and path.exists() else None


def _play(options: argparse.Namespace, course: Course, way: _Way, folder: Path, inbox: Inbox) -> int:
    began = time.perf_counter()
    scenario = course.world.scenario
    run = options.run or run_name(scenario, options.out)
    process = WorldProcess(
        course,
        run,
        inbox,
        rate=options.rate,
        timeout=options.timeout,
        on_kill_point=kills.taker(options.kill),
    )
    if not (options.quiet or options.launched):
        robots = ", ".join(robot.id for robot in scenario.robots)
        where = f", again, at tick {course.tick}" if course.tick else ""
        at = " and ".join(way.endpoints.listen) or way.endpoints
        say(f"run {run} at {at}{where}: waiting for {robots}")
    try:
        with shown_live(options, scenario, folder):
            way.play(process)
    except (Interrupted, NoRouter) as stop:
        if not options.launched:
            reason = f"stopped by {stop}" if isinstance(stop, Interrupted) else str(stop)
            break_off(options, folder, reason, began)
        raise
    if options.launched:  # who did so concludes
        return ENDED
    return conclude(options, read(folder), folder, "processes", began)
