"""The world's process: its clock is the barrier of the tick.

Lockstep goes as fast as the answers come, and no decision depends on a time-out. Whoever has not
answered hears its Sense again, with everyone else, when a robot appears and every REPEAT_S: that one
rule serves late starters, lost messages and restarted agents. In real time a tick lasts its period,
and a robot whose Drive did not come stands still.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

import zenoh

from protocol import keys, session
from protocol.journal import Journal
from protocol.messages import Drive, End, Farewell, Message, Sense, Truth
from protocol.wire import MalformedFrame, decode, encode
from world.course import Course
from world.referee import Judgement
from world.scenario import Scenario

REPEAT_S = 0.25
"""how often what is unanswered is said again"""
FAREWELL_S = 2.0
"""how long the world waits for the robots' last word"""
TRUSTED_ANSWER = 0.5
"""of a real-time tick: how long an agent may wait for its peer's report"""


class Interrupted(Exception):
    """The process was told to stop."""


class Silence(Exception):
    """Somebody did not answer within the patience; says who."""


class WorldProcess:
    """One run over one session. `inbox` may be given a ("stop", why, b"") at any time."""

    def __init__(
        self,
        scenario: Scenario,
        link: zenoh.Session,
        run: str,
        journal: Journal,
        *,
        rate: float | None = None,
        patience: float = 30.0,
        inbox: SimpleQueue[Any] | None = None,
        say: Callable[[str], None] = lambda line: print(line, file=sys.stderr, flush=True),
    ) -> None:
        self.scenario = scenario
        self.course = Course(scenario, journal)
        self._link = link
        self._run = run
        self._period = scenario.mission.period / rate if rate is not None else None
        self._patience = patience
        self._inbox: SimpleQueue[Any] = inbox if inbox is not None else SimpleQueue()
        self._say = say
        self._robots = [robot.id for robot in scenario.robots]
        self._alive: set[str] = set()
        self._complained: set[tuple[str, str]] = set()
        self._truth_wanted = False
        self._answered = time.monotonic()
        """when a robot last appeared, or answered something new"""

        self._sense = {r: session.publisher(link, keys.sense(run, r)) for r in self._robots}
        self._truth = session.publisher(link, keys.truth(run))
        session.on_matching(self._truth, self._set_truth_wanted)
        session.subscribe(link, keys.drive(run, "*"), self._inbox, "drive")
        session.watch_liveliness(link, keys.robot_alive(run, "*"), self._inbox)
        session.answer(link, keys.briefing(run, "*"), self._brief)
        self._token = session.show_alive(link, keys.world_alive(run))

    def play(self) -> End:
        """The whole run, to its End. Raises Interrupted when told to stop."""
        due = None
        try:
            while True:
                senses = self.course.senses()
                self._publish_truth()
                drives = self._collect(senses, due)
                end = self.course.drive(drives)
                if end is not None:
                    break
                if self._period is not None:
                    due = (time.monotonic() if due is None else due) + self._period
        except Silence as silence:
            end = self.course.end(Judgement("failed", str(silence)))
        self.course.farewells(self._part(end))
        return end

    # --- a tick ---

    def _collect(self, senses: list[Sense], due: float | None) -> dict[str, Drive]:
        """Everyone's Drive; in real time (`due` is when the tick ends) those that came until then."""
        tick = self.course.tick
        frames = {sense.robot: encode(sense) for sense in senses}
        self._put(frames)
        drives: dict[str, Drive] = {}
        repeat = time.monotonic() + REPEAT_S
        while len(drives) < len(self._robots) or due is not None:
            now = time.monotonic()
            if due is not None and now >= due:
                break
            if now - self._answered > self._patience:
                raise Silence(self._who_is_missing(drives))
            if now >= repeat:
                repeat = now + REPEAT_S
                self._put({robot: frame for robot, frame in frames.items() if due is None})
            topic, key, frame = self._next(min(repeat, due or repeat) - now)
            if topic == "drive":
                drive = self._accept(key, frame, Drive)
                if isinstance(drive, Drive) and drive.tick == tick and drive.robot not in drives:
                    drives[drive.robot] = drive
                    self._answered = time.monotonic()
            elif topic == "alive":
                self._answered = time.monotonic()
                self._put(frames)
        return drives

    def _put(self, frames: dict[str, bytes]) -> None:
        for robot, frame in frames.items():
            self._sense[robot].put(frame)

    def _next(self, timeout: float) -> tuple[str, str, bytes]:
        """What came; ("", "", b"") if nothing did in `timeout` seconds."""
        try:
            topic, key, frame = self._inbox.get(timeout=max(timeout, 0.0))
        except Empty:
            return "", "", b""
        if topic == "stop":
            raise Interrupted(key)
        if topic == "alive":
            self._alive.add(keys.robot_of(key))
        elif topic == "gone":
            self._alive.discard(keys.robot_of(key))
        return topic, key, frame

    def _accept(self, key: str, frame: bytes, kind: Any) -> Drive | Farewell | None:
        """The message in `frame`, if it is one of `kind` and from the robot whose key it came by."""
        robot = keys.robot_of(key)
        try:
            message: Drive | Farewell = decode(frame, kind)
            if message.robot != robot or robot not in self._robots:
                raise MalformedFrame(f"says it is from '{message.robot}'")
        except MalformedFrame as error:
            if (key, str(error)) not in self._complained and len(self._complained) < 100:
                self._complained.add((key, str(error)))
                self._say(f"world: refused a frame on {key}: {error}")
            return None
        return message

    def _who_is_missing(self, drives: dict[str, Drive]) -> str:
        missing = [robot for robot in self._robots if robot not in drives]
        names = ", ".join(f"{robot}{'' if robot in self._alive else ' (gone)'}" for robot in missing)
        return f"no answer from {names} at tick {self.course.tick} for {self._patience:g} s"

    # --- beside the tick ---

    def _publish_truth(self) -> None:
        if self._truth_wanted:
            truth = self.course.world.truth
            poses = dict(zip(self._robots, truth.poses, strict=True))
            self._truth.put(encode(Truth(truth.tick, poses)))

    def _set_truth_wanted(self, wanted: bool) -> None:
        self._truth_wanted = wanted

    def _brief(self, key: str) -> Message | str:
        robot = key.rsplit("/", 1)[1]
        if robot not in self._robots:
            return f"this world has no robot '{robot}'; it has {', '.join(self._robots)}"
        within = self._period * TRUSTED_ANSWER if self._period is not None else None
        return self.scenario.briefing(robot, within)

    def _part(self, end: End) -> list[Farewell]:
        """Tell everyone that it is over, until everyone has answered or left."""
        frame = encode(end)
        said: dict[str, Farewell] = {}
        give_up = time.monotonic() + FAREWELL_S
        repeat = 0.0
        while len(said) < len(self._robots) and time.monotonic() < give_up:
            now = time.monotonic()
            if now >= repeat:
                repeat = now + REPEAT_S
                self._put(dict.fromkeys(self._robots, frame))
            topic, key, answer = self._next(repeat - now)
            if topic == "drive":
                farewell = self._accept(key, answer, Drive | Farewell)
                if isinstance(farewell, Farewell):
                    said[farewell.robot] = farewell
            elif topic == "gone" and not self._alive - said.keys():
                break
        return list(said.values())
