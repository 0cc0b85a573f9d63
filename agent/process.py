"""The agent's process: Zenoh in, journal, planner, Zenoh out. It knows nothing but what it is told.

It reacts to what arrives and never steps twice: a Sense heard again makes it send again what it
answered, so whatever is lost, late or doubled costs time and changes nothing.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import zenoh

from agent import radio
from agent.robot import Robot, Told
from protocol import keys, session
from protocol.journal import Journal
from protocol.messages import Briefing, End, Report, Sense
from protocol.wire import MAX_REPORT_BYTES, MalformedFrame, decode, encode

LATE_REPORTS = 64
"""ticks for which a report is kept that no Sense has listed yet"""
QUERY_S = 2.0
"""how long to wait for the answer to one query"""
FIRST_WORD_S = 5.0
"""how long an agent looks for its world before it says so"""


class Interrupted(Exception):
    """The process was told to stop."""


class Unwelcome(Exception):
    """There is a world, but this robot cannot join it; says why."""


class WorldLost(Exception):
    """The world has been silent for longer than the patience; says so."""


def join(
    link: zenoh.Session,
    run: str | None,
    robot: str,
    wait: float,
    inbox: SimpleQueue[Any],
    say: Callable[[str], None],
) -> tuple[str, Briefing]:
    """The run that `robot` belongs to, and its briefing; `run` may name it.

    Raises WorldLost if there is no world within `wait` seconds, Unwelcome if there are several, if the
    world has no such robot, or if somebody else plays it already; Interrupted when told to stop.
    """
    began = time.monotonic()
    said = False
    while True:
        worlds = [keys.run_of(key) for key in session.alive(link, keys.world_alive(run or "*"), QUERY_S)]
        if len(worlds) > 1:
            raise Unwelcome(f"several runs are alive: {', '.join(worlds)}; choose one with --run")
        if worlds:
            if session.alive(link, keys.robot_alive(worlds[0], robot), QUERY_S):
                raise Unwelcome(f"robot '{robot}' is in run '{worlds[0]}' already")
            answer = session.ask(link, keys.briefing(worlds[0], robot), QUERY_S)
            if isinstance(answer, str):
                raise Unwelcome(answer)
            if answer is not None:
                try:
                    return worlds[0], decode(answer, Briefing)
                except MalformedFrame as error:
                    raise Unwelcome(f"the world's briefing is not understood: {error}") from None
        waited = time.monotonic() - began
        missing = f"no world{f' of run {run!r}' if run else ''} answers yet"
        if waited > wait:
            raise WorldLost(f"{missing}, gave up after {wait:g} s")
        if waited > FIRST_WORD_S and not said:
            said = True
            say(f"{missing}; trying for {wait:g} s")
        stopped(inbox, 0.05)


def stopped(inbox: SimpleQueue[Any], timeout: float) -> None:
    """Wait `timeout` seconds. Raises Interrupted when told to stop meanwhile."""
    try:
        topic, key, _ = inbox.get(timeout=timeout)
    except Empty:
        return
    if topic == "stop":
        raise Interrupted(key)


class AgentProcess:
    """One robot in one run. `inbox` may be given a ("stop", why, b"") at any time."""

    def __init__(
        self,
        briefing: Briefing,
        link: zenoh.Session,
        run: str,
        out: Path | None,
        *,
        patience: float = 30.0,
        fsync: bool = False,
        inbox: SimpleQueue[Any] | None = None,
        say: Callable[[str], None] = lambda line: print(line, file=sys.stderr, flush=True),
    ) -> None:
        self.id, self._peer = briefing.robot, briefing.peer
        self._within = briefing.answer_within
        self._patience = patience
        self._say = say
        self._inbox: SimpleQueue[Any] = inbox if inbox is not None else SimpleQueue()
        self._complained: set[tuple[str, str]] = set()
        self._estimate_wanted = False
        self._reports: dict[int, Told] = {}
        """the peer's, by tick, as they came"""
        self._sense: Sense | None = None
        """the latest; what it asked for is being done"""
        self._told: bytes | None = None
        """the report sent for it"""
        self._driven: bytes | None = None
        """the Drive sent for it; none while reports are awaited"""
        self._due: float | None = None
        """when to go on without them"""

        self._drive = session.publisher(link, keys.drive(run, self.id))
        self._report = session.publisher(link, keys.report(run, self.id, self._peer))
        self._estimate = session.publisher(link, keys.estimate(run, self.id))
        session.on_matching(self._estimate, self._set_estimate_wanted)
        journal = Journal(out / f"agent-{self.id}.journal", fsync=fsync) if out is not None else None
        self.robot = Robot(briefing, journal)
        session.subscribe(link, keys.sense(run, self.id), self._inbox, "sense")
        session.subscribe(link, keys.report(run, self._peer, self.id), self._inbox, "report")
        session.watch_liveliness(link, keys.world_alive(run), self._inbox)
        self._token = session.show_alive(link, keys.robot_alive(run, self.id))

    def play(self) -> End:
        """The whole run, to its End. Raises Interrupted when told to stop, WorldLost, Unwelcome."""
        while True:
            topic, key, frame = self._next()
            match topic:
                case "sense":
                    end = self._on_sense(key, frame)
                    if end is not None:
                        return self._part(end)
                case "report":
                    self._on_report(key, frame)
                case "gone":
                    self._say(f"{self.id}: the world has gone; waiting {self._patience:g} s for it")
                case "alive" | "":
                    pass
            self._decide_if_all_heard()

    # --- what arrives ---

    def _next(self) -> tuple[str, str, bytes]:
        timeout = self._patience
        if self._due is not None and self._driven is None:
            timeout = min(timeout, max(self._due - time.monotonic(), 0.0))
        try:
            topic, key, frame = self._inbox.get(timeout=timeout)
        except Empty:
            if timeout == self._patience:
                raise WorldLost(f"nothing heard from the world for {self._patience:g} s") from None
            return "", "", b""
        if topic == "stop":
            raise Interrupted(key)
        return topic, key, frame

    def _on_sense(self, key: str, frame: bytes) -> End | None:
        message = self._accept(key, frame, Sense | End)
        if isinstance(message, End):
            return message
        if not isinstance(message, Sense):
            return None
        known = self._sense.tick if self._sense is not None else -1
        if message.tick == known:
            self._say_again()
        elif message.tick == known + 1:
            self._step(message)
        elif message.tick > known:
            raise Unwelcome(
                f"the world is at tick {message.tick}, and the record of {self.id} ends at tick {known}"
            )
        return None

    def _on_report(self, key: str, frame: bytes) -> None:
        message = self._accept(key, frame, Report)
        if isinstance(message, Report):
            now = self._sense.tick if self._sense is not None else 0
            if abs(message.tick - now) <= LATE_REPORTS:
                self._reports.setdefault(message.tick, Told(message, frame))

    def _accept(self, key: str, frame: bytes, kind: Any) -> Sense | End | Report | None:
        """The message in `frame`, if it is one of `kind` and from whom the key says."""
        try:
            message: Sense | End | Report
            if kind is Report:
                message = report = decode(frame, Report, MAX_REPORT_BYTES)
                wrong = radio.contradiction(report)
                if report.robot != keys.robot_of(key):
                    wrong = f"says it is from '{report.robot}'"
                if wrong is not None:
                    raise MalformedFrame(wrong)
            else:
                message = decode(frame, kind)
                if isinstance(message, Sense) and message.robot != self.id:
                    raise MalformedFrame(f"is meant for '{message.robot}'")
        except MalformedFrame as error:
            self.robot.refused += 1
            if (key, str(error)) not in self._complained and len(self._complained) < 100:
                self._complained.add((key, str(error)))
                self._say(f"{self.id}: refused a frame on {key}: {error}")
            return None
        return message

    # --- what is done about it ---

    def _step(self, sense: Sense) -> None:
        self._sense, self._driven, self._told = sense, None, None
        if self._within is not None:
            self._due = time.monotonic() + self._within
        told = self.robot.sense(sense)
        if told is not None:
            self._told = told.frame
            self._report.put(told.frame)

    def _decide_if_all_heard(self) -> None:
        if self._sense is None or self._driven is not None:
            return
        heard: list[Told] = []
        missed: list[str] = []
        for contact in self._sense.contacts:
            for tick in contact.heard:
                told = self._reports.get(tick)
                if told is not None:
                    heard.append(told)
                elif self._due is None or time.monotonic() < self._due:
                    return
                else:
                    missed.append(contact.peer)
        drive = self.robot.decide(heard, missed)
        self._driven = encode(drive)
        self._drive.put(self._driven)
        if self._estimate_wanted:
            self._estimate.put(encode(self.robot.estimate()))
        if self._reports:
            oldest = drive.tick - LATE_REPORTS
            self._reports = {tick: told for tick, told in self._reports.items() if tick >= oldest}

    def _say_again(self) -> None:
        if self._told is not None:
            self._report.put(self._told)
        if self._driven is not None:
            self._drive.put(self._driven)

    def _part(self, end: End) -> End:
        self._drive.put(encode(self.robot.farewell(end)))
        return end

    def _set_estimate_wanted(self, wanted: bool) -> None:
        self._estimate_wanted = wanted
