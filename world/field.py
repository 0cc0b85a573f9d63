"""One robot without a world: its driver's Senses to its agent, its agent's Drives to the driver.

The agent is the one that a world has, in a process of its own: whatever becomes of it, its robot stands still
within a manoeuvre. A tick is a manoeuvre of T_s and a moment at rest, in which is sensed, heard and decided.
The two of a pair count the same ticks: a says when one begins, b goes by that, or by its own clock while it
hears nothing.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import TypeVar

import msgspec
import zenoh

from protocol import keys, session
from protocol.inbox import Arrival, Inbox
from protocol.messages import Beat, Briefing, Contact, Drive, End, Farewell, Report, Sense, Verdict
from protocol.wire import MAX_REPORT_BYTES, MalformedFrame, decode, encode
from world.driver import THINKING, Driver, Reading
from world.ending import Ending

REPEAT_S = 0.25
"""how often the End is said again"""
FAREWELL_S = 2.0
"""how long to wait for the agent's last word"""
ASTRAY = 64
"""ticks that a's beat may be ahead of b; a beat of long ago is of an a that was started again, and lost"""

M = TypeVar("M", Drive, Beat, Report)


class NoStart(TimeoutError):
    """Somebody was not there within the wait; says who."""


class DriverFailed(Exception):
    """The driver cannot go on, or says what cannot be; its text says what."""


class Field:
    """One robot's mission over one session."""

    def __init__(
        self,
        driver: Driver,
        briefing: Briefing,
        run: str,
        inbox: Inbox,
        *,
        max_ticks: int,
        manoeuvre_s: float,
        patience: float = 30.0,
    ) -> None:
        """`manoeuvre_s` (s) is T_s by the clock; `patience` (s) bounds every wait for an answer."""
        self._driver = driver
        self._briefing = briefing
        self._id, self._peer = briefing.robot, briefing.peer
        self.run = run
        self._inbox = inbox
        self._manoeuvre_s = manoeuvre_s
        self._tick_s = (1.0 + THINKING) * manoeuvre_s
        self._patience = patience + self._tick_s
        self._ended: Callable[[], None] = lambda: None
        self._ending = Ending(briefing, max_ticks, self._patience)
        self._alive: set[str] = set()
        self._unanswered: deque[tuple[int, bytes]] = deque()
        """Senses that the agent has not answered"""
        self._answered = 0.0
        """when it last did, or appeared"""
        self._tick = -1
        self._next = 0.0
        """when the tick after this one begins"""
        self.missed = 0
        """manoeuvres that the robot stood instead"""

    @property
    def verdict(self) -> Verdict | None:
        """What the robot has come to, if it has."""
        return self._ending.verdict

    def attach(self, link: zenoh.Session) -> None:
        """This is the session over which the agent and the peer are reached."""
        me, run, inbox = self._id, self.run, self._inbox
        self._sense = session.publisher(link, keys.sense(run, me))
        self._beat = session.publisher(link, keys.beat(run, me))
        session.subscribe(link, keys.drive(run, me), inbox, "drive")
        session.subscribe(link, keys.beat(run, self._peer), inbox, "beat")
        session.subscribe(link, keys.report(run, self._peer, me), inbox, "report")
        session.watch_liveliness(link, keys.robot_alive(run, "*"), inbox)
        session.answer(link, keys.briefing(run, me), lambda _: self._briefing)
        self._token = session.show_alive(link, keys.world_alive(run))

    def play(self, wait: float, ended: Callable[[], None]) -> End:
        """The whole mission; looks for agent and peer for `wait` seconds. The robot stands when this is over.

        `ended` is called when the agent's process has ended; it may start it again, or raise. Raises NoStart;
        whatever `ended` raises; Interrupted when told to stop.
        """
        self._ended = ended
        end: End | None = None
        try:
            self._gather(time.monotonic() + wait)
            while end is None:
                end = self._play_tick()
        except DriverFailed as failure:
            end = End(max(self._tick, 0), "failed", f"{self._id}'s driver: {failure}")
        finally:
            self._stop()
        self._part(end)
        return end

    # --- a tick ---

    def _gather(self, give_up: float) -> None:
        """Until tick 0: a's begins when both agents are there, b's when a's has."""
        follows = self._briefing.role == "b"
        while not (self._id in self._alive and (self._next > 0.0 if follows else self._peer in self._alive)):
            if time.monotonic() >= give_up:
                missing = [one for one in (self._id, self._peer) if one not in self._alive]
                raise NoStart(f"{' and '.join(missing) or self._peer}: not there; nobody has moved")
            self._take(self._inbox.next(give_up - time.monotonic()))
        self._answered = time.monotonic()

    def _play_tick(self) -> End | None:
        self._tick += 1
        tick = self._tick
        self._next = (self._next or time.monotonic()) + self._tick_s
        self._beat.put(encode(Beat(tick, self._id)))
        sense = _sense(self._reading(tick), tick, self._briefing)
        self._unanswered.append((tick, sense))
        self._sense.put(sense)
        drive = self._awaited(tick)
        until = time.monotonic()
        if drive is not None:
            until += self._manoeuvre_s
            self._set_off(drive)
        else:
            self.missed += 1
        while (now := time.monotonic()) < max(until, self._next):
            self._take(self._inbox.next(max(until, self._next) - now))
        if self._unanswered and now - self._answered > self._patience:
            return End(tick, "failed", f"no answer from {self._id}'s agent for {self._patience:g} s")
        return self._ending.after(tick, drive, peer_there=self._peer in self._alive)

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
        except Exception as error:  # noqa: BLE001  # as above; and there is an End to be told
            self._inbox.say(f"the driver does not stop: {type(error).__name__}: {error}")

    def _set_off(self, drive: Drive) -> None:
        """At v_max and omega_max at the most."""
        mission = self._briefing.mission
        v = min(max(drive.v, -mission.max_speed), mission.max_speed)
        omega = min(max(drive.omega, -mission.max_turn_rate), mission.max_turn_rate)
        try:
            self._driver.drive(v, omega)
        except Exception as error:  # as above
            raise DriverFailed(f"drive({v:g}, {omega:g}): {type(error).__name__}: {error}") from error

    def _awaited(self, tick: int) -> Drive | None:
        """The Drive of this tick, if it comes before the manoeuvre would outlast the tick."""
        while (left := self._next - self._manoeuvre_s - time.monotonic()) > 0.0:
            drive = self._take(self._inbox.next(left))
            if drive is not None and drive.tick == tick:
                return drive
        return None

    # --- what arrives ---

    def _take(self, arrival: Arrival) -> Drive | None:
        """Do what is to be done about it; the agent's Drive, if it is one, of whichever tick."""
        match arrival.topic:
            case "drive":
                return self._on_drive(arrival)
            case "beat":
                self._on_beat(arrival)
            case "report":
                self._on_report(arrival)
            case "alive":
                self._alive.add(arrival.source.robot)
                if arrival.source.robot == self._id:
                    self._answered = time.monotonic()
                    for _, frame in self._unanswered:  # while it was away
                        self._sense.put(frame)
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

    def _on_drive(self, arrival: Arrival) -> Drive | None:
        drive = self._accepted(arrival, Drive)
        if drive is None or drive.tick > self._tick:
            if drive is not None:
                self._inbox.refuse(arrival, "it is of a tick to come")
            return None
        while self._unanswered and self._unanswered[0][0] <= drive.tick:
            self._unanswered.popleft()
            self._answered = time.monotonic()
        return drive

    def _on_beat(self, arrival: Arrival) -> None:
        """b's next tick begins as many ticks after that of a's as it is farther on: at once, if it is not."""
        beat = self._accepted(arrival, Beat)
        if beat is None or self._briefing.role == "a":
            return
        left = self._tick + 1 - beat.tick
        if -ASTRAY <= left <= 2:
            self._next = time.monotonic() + left * self._tick_s
        else:
            self._inbox.refuse(arrival, f"it is of tick {beat.tick}, this is tick {max(self._tick, 0)}")

    def _on_report(self, arrival: Arrival) -> None:
        report = self._accepted(arrival, Report)
        if report is not None:
            self._ending.told(report)

    # --- the end ---

    def _part(self, end: End) -> None:
        """Tell the agent that it is over, until it has said its last word, and that this has been heard."""
        give_up = time.monotonic() + FAREWELL_S
        while (now := time.monotonic()) < give_up and self._id in self._alive:
            self._sense.put(encode(end))
            repeat = min(now + REPEAT_S, give_up)
            while (left := repeat - time.monotonic()) > 0.0:
                arrival = self._inbox.next(left)
                if arrival.topic == "gone":
                    self._alive.discard(arrival.source.robot)
                elif arrival.topic == "drive" and _is_farewell(arrival.frame, self._id):
                    self._sense.put(arrival.frame)
                    return


def _sense(reading: Reading, tick: int, briefing: Briefing) -> bytes:
    """The frame of the Sense that `reading` makes. Raises DriverFailed if it is none."""
    ranged = reading.mutual_range is not None
    contacts = (Contact(briefing.peer, reading.mutual_range, None),) if ranged or reading.contact else ()
    executed = reading.executed if tick > 0 else None
    try:
        frame = encode(Sense(tick, briefing.robot, executed, reading.anchor_range, contacts))
        decode(frame, Sense)
    except (MalformedFrame, TypeError, msgspec.MsgspecError) as error:
        raise DriverFailed(f"sense({tick}): {error}") from None
    return frame


def _is_farewell(frame: bytes, robot: str) -> bool:
    try:
        return decode(frame, Farewell).robot == robot
    except MalformedFrame:
        return False
