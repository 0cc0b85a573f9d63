"""The world's process: its clock is the barrier of the tick.

Lockstep goes as fast as the answers come, and no decision depends on a time-out. A robot that has not
answered is sent its Observation again when it appears, and every REPEAT_S; and so is its peer, whose reports it may
have lost. That one rule serves late starters, lost messages and restarted agents; and a world that is started
again, which says to everyone what it would have said. Everyone is sent its Observation again every REPEAT_TO_ALL_S,
so that no link falls silent meanwhile. In real time a tick lasts its period, and a robot whose Command did not
come stands still.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import ExitStack
from typing import Any

import zenoh

from protocol.messages import Command, FinalReport, GroundTruth, Message, MissionEnd, Observation
from protocol.network import diagnosis, keys, session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import NOTHING, Arrival, Inbox
from protocol.spelling import did_you_mean
from protocol.wire import MalformedFrame, decode, encode
from world.referee import Judgement
from world.simulation import Course

SILENCE_S = 3.0
"""a replaceable link over which no robot has said anything for so long is replaced, as an agent's is"""
REPEAT_S = 0.25
"""how often what is unanswered is said again"""
REPEAT_TO_ALL_S = 1.0
"""how often everyone is told again, as long as somebody has not answered; less than the silence after which
an agent replaces its link"""
FAREWELL_S = 2.0
"""how long the world waits for the last word of robots that had not answered any more"""


class NoAnswer(TimeoutError):
    """Somebody did not answer within the patience; says who."""


class RobotsLinkLost(Exception):
    """Nothing comes over this link any more; over another the robots may be there."""


class WorldProcess:
    """One run, over one session after the other. Nothing is heard or said before one is attached."""

    def __init__(
        self,
        course: Course,
        run: str,
        inbox: Inbox,
        *,
        rate: float | None = None,
        timeout: float = 30.0,
        on_kill_point: Callable[[str, int], None] | None = None,
    ) -> None:
        """`course` may have come some way. `rate` is real time's speed, lockstep without.

        `timeout` (s) bounds every wait for an answer; `on_kill_point` is told how far each tick has come.
        """
        self._run = run
        scenario = course.world.scenario
        self._scenario = scenario
        self._course = course
        self._on_kill_point = on_kill_point
        self._period = scenario.mission.period / rate if rate is not None else None
        self._tick_s = self._period or 0.0
        self._timeout = timeout
        self._inbox = inbox
        self._robots = [robot.id for robot in scenario.robots]
        self._peers = {robot.id: robot.peer for robot in scenario.robots}
        self._repeat = self._repeat_to_all = math.inf
        """when what is unanswered is said again, and when it is said to everyone"""
        self._alive: set[str] = set()
        self._answered = time.monotonic()
        """when a robot last appeared, or answered something new"""
        self._late = 0
        """Drives of ticks that are over"""
        self._latest: dict[str, int] = {}
        """of each robot: the tick of the latest Command that came, in time or not"""
        self._truth_wanted = False
        self._mute = math.inf
        """when its link counts as lost, if nothing comes until then"""
        self._silence = math.inf
        self._began: float | None = None
        """when everyone had answered the first Sense"""
        self.playing_s = 0.0
        """wall time since then, to the MissionEnd"""
        self._parting: float | None = None
        """when the MissionEnd was first said"""
        self._last_words: dict[str, FinalReport] = {}

    def attach(self, link: zenoh.Session, *, replaceable: bool = False) -> None:
        """From now on, this is the session over which it hears and is heard; `replaceable` by silence."""
        run, inbox = self._run, self._inbox
        self._silence = SILENCE_S + self._tick_s if replaceable else math.inf
        self._mute = time.monotonic() + self._silence
        self._observation = {
            robot: session.publisher(link, keys.observation(run, robot)) for robot in self._robots
        }
        self._truth = session.publisher(link, keys.truth(run))
        session.on_matching(self._truth, self._want_truth)
        session.subscribe(link, keys.command(run, "*"), inbox, "command")
        session.watch_liveliness(link, keys.robot_alive(run, "*"), inbox)
        session.answer(link, keys.config(run, "*"), self._brief)
        self._token = session.show_alive(link, keys.world_alive(run))

    def play(self) -> MissionEnd:
        """The run, to its MissionEnd.

        Raises LinkLost, to be played on over another; or Interrupted when told to stop.
        """
        course = self._course
        due: float | None = None
        end = course.over
        expected = self._robots if end is not None else []
        if course.tick > 0 and self._period is not None:  # its clock goes on; not everyone is back yet
            due = time.monotonic() + self._period
        try:
            while end is None:
                commands = self._answers(course.observations(), due)
                if self._on_kill_point is not None:
                    self._on_kill_point("command", course.tick)
                course.recording(commands)
                if self._on_kill_point is not None:
                    self._on_kill_point("journal", course.tick)
                end = course.advance(commands)
                self._began = time.monotonic() if self._began is None else self._began
                if self._period is not None:
                    due = max((due or self._began) + self._period, time.monotonic())
        except NoAnswer as silence:
            end = course.end(Judgement("failed", str(silence)))
        self._parting = time.monotonic() if self._parting is None else self._parting
        self.playing_s = self._parting - self._began if self._began is not None else 0.0
        course.final_reports(self._farewells(end, expected))
        self._say_who_gave_none()
        self._put({robot: encode(final_report) for robot, final_report in course.phase1_done_tick.items()})
        if refused := self._inbox.refused.total():
            late = f", and left aside {self._late} of ticks past" if self._late else ""
            self._inbox.say(f"refused {refused} frames in all{late}")
        return end

    # --- a tick ---

    def _answers(self, observations: list[Observation], due: float | None) -> dict[str, Command]:
        """Everyone's Command; in real time, where `due` is when the tick ends, those that came until then."""
        tick = self._course.tick
        frames = {observation.robot: encode(observation) for observation in observations}
        if self._on_kill_point is not None:
            self._on_kill_point("observation", tick)
        self._put(frames)
        if self._on_kill_point is not None:
            self._on_kill_point("report", tick)
        self._show_truth()
        commands: dict[str, Command] = {}
        now = time.monotonic()
        self._set_repeat(now)
        while due is not None or len(commands) < len(self._robots):
            arrival = self._next((self._repeat if due is None else due) - now)
            now = time.monotonic()
            if arrival.topic == "command":
                command = self._answer(arrival)
                if command is not None and command.robot not in commands:
                    commands[command.robot] = command
                    self._answered = now
            if arrival.topic == "alive" and arrival.source.robot in self._alive:
                self._tell_missed(arrival.source.robot)
                self._put_again(frames, [arrival.source.robot])
            if due is None and now >= self._repeat:
                self._put_all_again(frames, frames.keys() - commands.keys(), now)
            if len(commands) < len(self._robots) and now - self._answered > self._timeout + self._tick_s:
                raise NoAnswer(self._who_is_missing(commands))
            if due is not None and now >= due and (arrival is NOTHING or now >= due + self._tick_s):
                break
        return commands

    def _put(self, frames: Mapping[str, bytes]) -> None:
        for robot, frame in frames.items():
            self._observation[robot].put(frame)

    def _put_again(self, frames: Mapping[str, bytes], robots: Iterable[str]) -> None:
        """To `robots`, and to their peers, whose reports they may have lost."""
        named = {*robots} & self._peers.keys()
        named |= {self._peers[robot] for robot in named}
        self._put({robot: frame for robot, frame in frames.items() if robot in named})

    def _set_repeat(self, now: float) -> None:
        """Something new is said."""
        self._repeat, self._repeat_to_all = now + REPEAT_S, now + REPEAT_TO_ALL_S

    def _put_all_again(self, frames: Mapping[str, bytes], missing: Iterable[str], now: float) -> None:
        """To those that are `blocking_reason`, and to everyone where the last time is long ago."""
        self._repeat = now + REPEAT_S
        if now < self._repeat_to_all:
            self._put_again(frames, missing)
        else:
            self._repeat_to_all = now + REPEAT_TO_ALL_S
            self._put(frames)

    def _tell_missed(self, robot: str) -> None:
        """In real time, what the others have been told while `robot` was away."""
        for observation in self._course.missed.get(robot, ()):
            self._observation[robot].put(encode(observation))

    def _next(self, timeout: float) -> Arrival:
        now = time.monotonic()
        arrival = self._inbox.next(min(timeout, self._mute - now))
        if arrival is not NOTHING:
            self._mute = now + self._silence
        elif time.monotonic() >= self._mute:
            raise RobotsLinkLost
        robot = arrival.source.robot
        if arrival.topic == "alive" and robot in self._robots:
            if robot not in self._alive:
                self._answered = time.monotonic()
            self._alive.add(robot)
        elif arrival.topic == "gone":
            self._alive.discard(robot)
        return arrival

    def _accepted(self, arrival: Arrival, kind: Any) -> Command | FinalReport | None:
        """The message that arrived, if it is one of `kind` and from the robot whose key it came by."""
        try:
            message: Command | FinalReport = decode(arrival.frame, kind)
        except MalformedFrame as error:
            self._inbox.refuse(arrival, error)
            return None
        if message.robot not in self._peers or message.robot != arrival.source.robot:
            self._inbox.refuse(arrival, f"it says it is from '{message.robot}'")
            return None
        return message

    def _answer(self, arrival: Arrival) -> Command | None:
        """The Command that arrived, if it is of this tick."""
        command = self._accepted(arrival, Command)
        if not isinstance(command, Command):
            return None
        if command.tick <= self._course.tick:
            self._latest[command.robot] = command.tick
        if command.tick == self._course.tick:
            return command
        if command.tick > self._course.tick:
            self._inbox.refuse(arrival, "it is of a tick to come")
        else:
            self._late += 1
        return None

    def _who_is_missing(self, commands: Mapping[str, Command]) -> str:
        missing = [robot for robot in self._robots if robot not in commands]
        names = ", ".join(robot if robot in self._alive else f"{robot} (not there)" for robot in missing)
        return f"no answer from {names} at tick {self._course.tick} for {self._timeout:g} s"

    def _say_who_gave_none(self) -> None:
        """Tell of which robots there is no FinalReport, and why."""
        reasons: dict[str, list[str]] = {}
        for robot in self._robots:
            if robot not in self._course.phase1_done_tick:
                reasons.setdefault(self._why_none(robot), []).append(robot)
        for reason, robots in reasons.items():
            self._inbox.say(f"no FinalReport of {', '.join(robots)}: {reason}")

    def _why_none(self, robot: str) -> str:
        latest = self._latest.get(robot)
        if robot not in self._alive:
            return "not there" if latest is None else f"gone; the last Command was of tick {latest}"
        if latest is None:
            return "there, but no Command has come"
        if latest < self._course.tick:
            slower = "; a lower --rate leaves more time for each tick" if self._period is not None else ""
            return f"behind, at tick {latest} of {self._course.tick}{slower}"
        return "no answer to the MissionEnd"

    # --- beside the tick ---

    def _show_truth(self) -> None:
        if self._truth_wanted:
            truth = self._course.world.truth
            poses = dict(zip(self._robots, truth.poses, strict=True))
            self._truth.put(encode(GroundTruth(truth.tick, poses)))

    def _want_truth(self, wanted: bool) -> None:
        self._truth_wanted = wanted

    def _brief(self, robot: str) -> Message | str:
        if robot not in self._robots:
            near = did_you_mean(robot, self._robots)
            return f"this world has no robot '{robot}'; it has {', '.join(self._robots)}{near}"
        return self._scenario.config(robot, self._period)

    def _farewells(self, end: MissionEnd, expected: Collection[str]) -> list[FinalReport]:
        """Tell everyone that it is over, until everyone has answered or left.

        Who answered in the last tick is waited for with patience, though it be started again; `expected`, and
        whoever else is there, for FAREWELL_S.
        """
        frames = dict.fromkeys(self._robots, encode(end))
        said = self._last_words = {**self._course.phase1_done_tick, **self._last_words}
        now = time.monotonic()
        began = self._parting or now
        self._repeat = self._repeat_to_all = now
        told = False
        while True:
            last_words = set(self._course.witnesses) - said.keys()
            others = self._alive.union(expected) - said.keys()
            give_up = began + (self._timeout if last_words else FAREWELL_S)
            if now >= give_up or not (last_words or others):
                return list(said.values())
            if last_words and now >= began + FAREWELL_S and not told:
                told = True
                names = ", ".join(sorted(last_words))
                self._inbox.say(f"waiting {self._timeout:g} s for the last word of {names}")
            if now >= self._repeat:
                self._put_all_again(frames, last_words | others, now)
            arrival = self._next(min(self._repeat, give_up) - now)
            if arrival.topic == "alive":
                self._put_again(frames, [arrival.source.robot])
            if arrival.topic == "command":
                last = self._accepted(arrival, Command | FinalReport)
                if isinstance(last, FinalReport):
                    said[last.robot] = last
                elif last is not None and last.tick <= end.tick:
                    self._latest[last.robot] = last.tick
            now = time.monotonic()


LOOK_AGAIN_S = 0.05
"""s to wait before trying to reach a router again."""


class NoRouter(TimeoutError):
    """There is no router that the world, as a client, can connect to; the text says why."""


class WorldLinks:
    """The Zenoh sessions of a world, one after another; a context manager that opens the first."""

    def __init__(self, endpoints: Endpoints, timeout: float, inbox: Inbox, busy_timeout: float) -> None:
        """Wait at most `timeout` s for a router, and `busy_timeout` s for a port in use to become free."""
        self.endpoints = endpoints
        self._timeout = timeout
        self._inbox = inbox
        self._busy_timeout = busy_timeout
        self._open = ExitStack()

    def open(self) -> None:
        """Close the session, if there is one, and open another.

        Raises CannotListen, NoRouter or Interrupted.
        """
        self._open.close()
        give_up = time.monotonic() + self._timeout
        self.session: zenoh.Session | None = None

        def unanswered() -> None:
            if time.monotonic() >= give_up:
                why = diagnosis.why(self.endpoints)
                raise NoRouter(f"no router at {self.endpoints}; gave up after {self._timeout:g} s: {why}")
            self._inbox.next(LOOK_AGAIN_S)

        if self.endpoints.connect:
            later = threading.Timer(diagnosis.FIRST_WORD_S, self._warn_without_link)
            later.daemon = True
            later.start()
            self._open.callback(later.cancel)
        opened = session.open_session(self.endpoints, unanswered, self._busy_timeout)
        self.session = self._open.enter_context(opened)

    def _warn_without_link(self) -> None:
        """Print that no router is connected: a router runs without its peers, a client waits for one."""
        if self.session is None or not session.linked(self.session):
            self._inbox.say(f"no router at {self.endpoints} yet: {diagnosis.why(self.endpoints)}")

    def run(self, process: WorldProcess) -> None:
        """Run `process` to its MissionEnd, over as many sessions as needed. Raises NoRouter or Interrupted."""
        while True:
            assert self.session is not None
            process.attach(self.session, replaceable=self.endpoints.mode == "client")
            try:
                process.play()
            except RobotsLinkLost:
                self.open()
            else:
                return

    def __enter__(self) -> WorldLinks:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
