"""One robot without a world: its driver's Observations to its agent, its agent's Commands to the driver.

The agent is the one that a world has, in a process of its own: whatever becomes of it, its robot stands still
within a manoeuvre. A tick is a manoeuvre of T_s and a moment at rest, in which is sensed, heard and decided.
The two of a pair count the same ticks: a says when one begins, b goes by that, or by its own clock while it
hears nothing.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import TypeVar

import msgspec
import zenoh

from protocol.journal.journal_file import Sink
from protocol.messages import (
    Command,
    Contact,
    FinalReport,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
    TickStart,
    Verdict,
)
from protocol.network import keys, session
from protocol.network.inbox import NOTHING, Arrival, Inbox
from protocol.wire import MAX_REPORT_BYTES, MalformedFrame, decode, encode
from world.hardware.driver import THINKING, Driver, Reading
from world.hardware.driver_journal import DriverPast, Mark
from world.hardware.termination import Ending

REPEAT_S = 0.25
"""how often the MissionEnd is said again"""
FAREWELL_S = 2.0
"""how long to wait for the agent's last word"""
ASTRAY = 64
"""ticks that a's beat may be ahead of b; a beat of long ago is of an a that was started again, and lost"""

AT_ONCE = 1000
"""messages that are taken without a look at the clock"""
UNKNOWN = -math.inf
"""a time; clocks may begin at 0, and what is late lies before that"""

UNHEARD = 4.0
"""ticks within which a robot that goes on tells that it does"""

M = TypeVar("M", Command, TickStart, Report)


class NoStart(TimeoutError):
    """Somebody was not there within the wait; says who."""


class DriverFailed(Exception):
    """The driver cannot go on, or says what cannot be; its text says what."""


class Field:
    """One robot's mission over one session."""

    def __init__(
        self,
        driver: Driver,
        config: RobotConfig,
        run: str,
        inbox: Inbox,
        *,
        max_ticks: int,
        manoeuvre_s: float,
        timeout: float = 30.0,
        journal: Sink | None = None,
    ) -> None:
        """`manoeuvre_s` (s) is T_s by the clock; `timeout` (s) bounds every wait for an answer.

        What is measured and driven goes to `journal`, which begins with the briefing.
        """
        self._driver = driver
        self._config = config
        self._id, self._peer = config.robot, config.peer
        self.run = run
        self._inbox = inbox
        self._manoeuvre_s = manoeuvre_s
        self._tick_s = (1.0 + THINKING) * manoeuvre_s
        self._timeout = timeout + self._tick_s
        self._ended: Callable[[], None] = lambda: None
        self._journal = journal
        self._max_ticks = max_ticks
        self._ending = Ending(config, max_ticks, self._timeout)
        self._end: MissionEnd | None = None
        """once it is on record"""
        self._again = False
        """whether its process was killed before, be it before tick 0"""
        self._resumed = False
        self._astray = ASTRAY
        """ticks that the peer's beat may be ahead"""
        self._alive: set[str] = set()
        self._unanswered: deque[tuple[int, bytes]] = deque()
        """Senses that the agent has not answered"""
        self._answered = 0.0
        """when it last did; one that only appears, be it over and over, has not"""
        self._tick = -1
        self._next = UNKNOWN
        """when the tick after this one begins"""
        self.missed = 0
        """manoeuvres that the robot stood instead"""

    def resume(self, past: DriverPast, known: int) -> None:
        """Go on where the driver's journal ends; `known` is the latest tick on the agent's.

        The robot stood while this process was down, so the peer may be any number of ticks ahead.
        """
        self._again = True
        for one in past.ticks:
            for report in one.reports:
                self._ending.told(report)
            self._end = self._ending.after(one.observation.tick, one.command, peer_there=True)
            self.missed += one.command is None
        self._end = past.end or self._end
        self._tick, self._resumed, self._astray = past.tick, past.tick >= 0, self._max_ticks + 1
        self._unanswered.extend((one.observation.tick, one.frame) for one in past.ticks[known + 1 :])

    @property
    def tick(self) -> int:
        """The latest that has begun; -1 before any."""
        return self._tick

    @property
    def verdict(self) -> Verdict | None:
        """What the robot has come to, if it has."""
        return self._ending.verdict

    def attach(self, link: zenoh.Session) -> None:
        """This is the session over which the agent and the peer are reached."""
        me, run, inbox = self._id, self.run, self._inbox
        self._observation = session.publisher(link, keys.observation(run, me))
        self._beat = session.publisher(link, keys.tick_start(run, me))
        session.subscribe(link, keys.command(run, me), inbox, "command")
        session.subscribe(link, keys.tick_start(run, self._peer), inbox, "tick-start")
        session.subscribe(link, keys.report(run, self._peer, me), inbox, "report")
        session.watch_liveliness(link, keys.robot_alive(run, "*"), inbox)
        session.answer(link, keys.config(run, me), lambda _: self._config)
        self._token = session.show_alive(link, keys.world_alive(run))

    def play(self, wait: float, ended: Callable[[], None]) -> MissionEnd:
        """The whole mission; looks for agent and peer for `wait` seconds. The robot stands when this is over.

        `ended` is called when the agent's process has ended; it may start it again, or raise. Raises NoStart;
        whatever `ended` raises; Interrupted when told to stop.
        """
        self._ended = ended
        end = self._end
        try:
            self._gather(time.monotonic() + wait)
            while end is None:
                end = self._play_tick()
        except DriverFailed as failure:
            end = MissionEnd(max(self._tick, 0), "failed", f"{self._id}'s driver: {failure}")
        finally:
            self._stop()
        if self._end is None:
            self._write(encode(end))
        self._part(end)
        return end

    def _write(self, *frames: bytes) -> None:
        """Put them on record. Raises CannotRecord."""
        if self._journal is not None:
            self._journal.write(*frames)

    # --- a tick ---

    def _gather(self, give_up: float) -> None:
        """Until tick 0: a's begins when both agents are there, b's when a's has.

        Whoever resumes waits for its own agent only: the peer may have come to its end. A b that was killed
        before tick 0 may have missed that a has begun, and that a now waits for it.
        """
        unheard = time.monotonic() + UNHEARD * self._tick_s
        while not self._may_begin():
            if self._again and {self._id, self._peer} <= self._alive and time.monotonic() >= unheard:
                self._next = time.monotonic()
                break
            if time.monotonic() >= give_up:
                missing = [one for one in (self._id, self._peer) if one not in self._alive]
                moved = "" if self._resumed else "; nobody has moved"
                raise NoStart(f"{' and '.join(missing) or self._peer}: not there{moved}")
            until = min(give_up, unheard) if self._again and unheard > time.monotonic() else give_up
            self._take(self._inbox.next(until - time.monotonic()))
        self._answered = time.monotonic()

    def _may_begin(self) -> bool:
        if self._id not in self._alive:
            return False
        if self._resumed:
            return True
        return self._next != UNKNOWN if self._config.role == "b" else self._peer in self._alive

    def _play_tick(self) -> MissionEnd | None:
        self._tick += 1
        tick = self._tick
        now = time.monotonic()
        self._next = (now if self._next == UNKNOWN else self._next) + self._tick_s
        if not self._resumed or self._next > now:  # one that catches up says so once it is there
            self._beat.put(encode(TickStart(tick, self._id)))
        reading = self._reading(tick)
        observation = _sense(reading, tick, self._config)
        self._write(*_mark(reading, tick, self._id), observation)
        self._unanswered.append((tick, observation))
        self._observation.put(observation)
        command = self._awaited(tick)
        until = time.monotonic()
        if command is not None:
            self._write(encode(command))
            self._set_off(command)
            until = time.monotonic() + self._manoeuvre_s
        else:
            self.missed += 1
        while (now := time.monotonic()) < max(until, self._next):
            self._take(self._inbox.next(max(until, self._next) - now))
        self._take_waiting()
        if self._unanswered and now - self._answered > self._timeout:
            return MissionEnd(tick, "failed", f"no answer from {self._id}'s agent for {self._timeout:g} s")
        return self._ending.after(tick, command, peer_there=self._peer in self._alive)

    def _reading(self, tick: int) -> Reading:
        try:
            reading = self._driver.sense(tick)
        except Exception as error:  # it is the user's own, and may raise anything
            raise DriverFailed(f"sense({tick}): {type(error).__name__}: {error}") from error
        if not isinstance(reading, Reading):
            raise DriverFailed(f"sense({tick}): gives {type(reading).__name__}, expected a Reading")
        return reading

    def _stop(self) -> None:
        try:
            self._driver.stop()
        except Exception as error:  # noqa: BLE001  # as above; and there is an MissionEnd to be told
            self._inbox.say(f"the driver does not stop: {type(error).__name__}: {error}")

    def _set_off(self, command: Command) -> None:
        """At v_max and omega_max at the most."""
        mission = self._config.mission
        v = min(max(command.v, -mission.max_speed), mission.max_speed)
        omega = min(max(command.omega, -mission.max_turn_rate), mission.max_turn_rate)
        try:
            self._driver.drive(v, omega)
        except Exception as error:  # as above
            raise DriverFailed(f"drive({v:g}, {omega:g}): {type(error).__name__}: {error}") from error

    def _awaited(self, tick: int) -> Command | None:
        """The Command of this tick, if it comes before the manoeuvre would outlast the tick."""
        while (left := self._next - self._manoeuvre_s - time.monotonic()) > 0.0:
            command = self._take(self._inbox.next(left))
            if command is not None and command.tick == tick:
                return command
        return None

    # --- what arrives ---

    def _take_waiting(self) -> None:
        """Take what has arrived by now: with a driver whose `observation` lasts for a tick, nobody else looks."""
        for _ in range(AT_ONCE):
            arrival = self._inbox.next(0.0)
            if arrival is NOTHING:
                return
            self._take(arrival)

    def _take(self, arrival: Arrival) -> Command | None:
        """Do what is to be done about it; the agent's Command, if it is one, of whichever tick."""
        match arrival.topic:
            case "command":
                return self._on_drive(arrival)
            case "tick-start":
                self._on_beat(arrival)
            case "report":
                self._on_report(arrival)
            case "alive":
                self._alive.add(arrival.source.robot)
                if arrival.source.robot == self._id:
                    for _, frame in self._unanswered:  # while it was away
                        self._observation.put(frame)
            case "gone":
                self._alive.discard(arrival.source.robot)
            case "ended":
                self._ended()
            case _:
                pass
        return None

    def _accepted(self, arrival: Arrival, kind: type[M]) -> M | None:
        """The message that arrived, if it is one of `kind` and from the robot whose key it came by."""
        try:
            message: M = decode(arrival.frame, kind, MAX_REPORT_BYTES)
        except MalformedFrame as error:
            self._inbox.refuse(arrival, error)
            return None
        if message.robot != arrival.source.robot:
            self._inbox.refuse(arrival, f"it says it is from '{message.robot}'")
            return None
        return message

    def _on_drive(self, arrival: Arrival) -> Command | None:
        command = self._accepted(arrival, Command)
        if command is None or command.tick > self._tick:
            if command is not None:
                self._inbox.refuse(arrival, "it is of a tick to come")
            return None
        while self._unanswered and self._unanswered[0][0] <= command.tick:
            self._unanswered.popleft()
            self._answered = time.monotonic()
        return command

    def _on_beat(self, arrival: Arrival) -> None:
        """b's next tick begins as many ticks after that of a's as it is farther on: at once, if it is not.

        An a that has been started again goes by b in the same way, as long as it is behind.
        """
        beat = self._accepted(arrival, TickStart)
        if beat is None:
            return
        left = self._tick + 1 - beat.tick
        if self._config.role == "a" and (left >= 0 or not self._resumed):
            return
        if -self._astray <= left <= (2 if self._resumed or self._astray == ASTRAY else ASTRAY):
            self._astray = ASTRAY
            self._next = time.monotonic() + left * self._tick_s
        else:
            self._inbox.refuse(arrival, f"it is of tick {beat.tick}, this is tick {max(self._tick, 0)}")

    def _on_report(self, arrival: Arrival) -> None:
        report = self._accepted(arrival, Report)
        if report is not None and self._ending.told(report):
            self._write(arrival.frame)

    # --- the end ---

    def _part(self, end: MissionEnd) -> None:
        """Tell the agent that it is over, until it has said its last word, and that this has been heard."""
        give_up = time.monotonic() + FAREWELL_S
        while (now := time.monotonic()) < give_up and self._id in self._alive:
            self._observation.put(encode(end))
            repeat = min(now + REPEAT_S, give_up)
            while (left := repeat - time.monotonic()) > 0.0:
                arrival = self._inbox.next(left)
                if arrival.topic == "gone":
                    self._alive.discard(arrival.source.robot)
                elif arrival.topic == "command" and _is_farewell(arrival.frame, self._id):
                    self._observation.put(arrival.frame)
                    return
        why = "no answer to the MissionEnd" if self._id in self._alive else "its agent has gone"
        self._inbox.say(f"no FinalReport of {self._id}: {why}")


def _sense(reading: Reading, tick: int, config: RobotConfig) -> bytes:
    """The frame of the Observation that `reading` makes. Raises DriverFailed if it is none."""
    ranged = reading.mutual_range is not None
    contacts = (Contact(config.peer, reading.mutual_range, None),) if ranged or reading.contact else ()
    executed = reading.executed if tick > 0 else None
    try:
        frame = encode(Observation(tick, config.robot, executed, reading.anchor_range, contacts))
        decode(frame, Observation)
    except (MalformedFrame, TypeError, msgspec.MsgspecError) as error:
        raise DriverFailed(f"sense({tick}): {error}") from None
    return frame


def _mark(reading: Reading, tick: int, robot: str) -> list[bytes]:
    """The frame of the mark of `reading`, if it has one. Raises DriverFailed if it is none."""
    if not reading.mark:
        return []
    try:
        frame = encode(Mark(tick, robot, reading.mark))
        decode(frame, Mark)
    except (MalformedFrame, TypeError, msgspec.MsgspecError) as error:
        raise DriverFailed(f"sense({tick}): mark: {error}") from None
    return [frame]


def _is_farewell(frame: bytes, robot: str) -> bool:
    try:
        return decode(frame, FinalReport).robot == robot
    except MalformedFrame:
        return False
