"""The inbox of a process: received frames, liveliness changes and signals, and counts of refused frames."""

from __future__ import annotations

import math
import threading
from collections import Counter
from queue import Empty, SimpleQueue
from typing import Any, Literal, NamedTuple, Protocol

from protocol.network.clock import Clock
from protocol.network.keys import UNKNOWN_KEY, Key
from protocol.network.timer import Timer
from protocol.output import say
from protocol.wire import MAX_SENT_BYTES, MalformedFrame, decode

Topic = Literal[
    "observation", "command", "estimate", "report", "tick-start", "alive", "gone", "ended", "stop", "nothing"
]
"""The kind of an event: a received frame ("observation" to "tick-start"), a liveliness token that appeared or
disappeared, the end of the agent's process, a signal to stop, or a timeout."""

COMPLAINTS = 100
"""The maximum number of messages about refused frames. Further ones are only counted."""
COMPLAINT = 300
"""The maximum number of characters of the key and reason in each message."""
ROOM_BYTES = 1 << 22
"""The maximum size of the queue of one topic: thousands of frames, more than any mission needs."""
ARRIVAL_BYTES = 200
"""The approximate memory that a queued frame takes in addition to its own bytes."""


SIGNAL_S = 0.5
"""The longest wait in s without a look for signals. One that arrives just before a wait does not end it."""


class Interrupted(Exception):
    """The process received a signal to stop. The text of the error is the name of the signal."""


class Arrival(NamedTuple):
    """An event in the inbox."""

    topic: Topic
    """The kind of event."""
    key: str = ""
    """The key of the frame or token; for "stop", the name of the signal."""
    frame: bytes = b""
    """The received frame; empty for other events."""
    source: Key = UNKNOWN_KEY
    """The parsed `key`."""


NO_ARRIVAL = Arrival("nothing")
"""The result of `Inbox.next` after its timeout."""


class LineClosed(Exception):
    """The session of a Line is closed."""


class Line(Protocol):
    """The contract of a subscription from which the thread that empties the inbox takes frames itself."""

    def receive(self, *, wait: bool) -> Arrival | None:
        """Return the next frame; None after a call of `wake`, without a frame, or if the frame is refused.

        Raises LineClosed.
        """

    def wake(self) -> None:
        """End a wait in `receive`. This may be called from any thread and from a signal handler."""


class Inbox:
    """A queue that callbacks and signal handlers fill and one thread empties, with a timeout on each wait.

    Its size is limited. Each topic has ROOM_BYTES of its own, so a flood of one topic does not affect the
    others. A frame without room is refused. If the mission needs it, it is repeated, as after any loss.

    The frames that set the pace of a mission do not pass through the queue, but come over a Line. With a
    callback, each of them would wake a thread that only wakes another one.
    """

    def __init__(self, owner: str, clock: Clock | None = None) -> None:
        self.clock = clock or Clock()
        """The clock by which the owner waits, in s."""
        self.refused = Counter[Topic]()
        """The number of refused frames by topic.

        A frame is refused if it is malformed, has an invalid key, a wrong sender or an unexpected tick, or if
        the queue is full.
        """
        self._owner = owner
        self._queue: SimpleQueue[Arrival] = SimpleQueue()
        self._complaints: set[tuple[str, str]] = set()
        self._waiting = Counter[Topic]()
        """The bytes of the queued frames, by topic."""
        self._turned_away = Counter[tuple[Topic, str, str]]()
        """The number of frames refused by `turn_away` since the last `next`, by topic, key and reason."""
        self._lock = threading.RLock()  # a signal handler may interrupt its holder
        self._line: Line | None = None
        self._line_is_next = True
        """True if the line comes first when both have an event, so that neither starves the other."""
        self._timer = Timer(self._wake, self.clock)
        self._asleep = 0.0
        """The s that `awake` does not count."""

    def take_from(self, line: Line) -> None:
        """Take frames from `line`, too, until its session is closed. It replaces an earlier line."""
        self._line = line

    def put(self, topic: Topic, key: str = "", frame: bytes = b"", source: Key = UNKNOWN_KEY) -> None:
        """Add an event. This may be called from any thread and from a signal handler."""
        arrival = Arrival(topic, key, frame, source)
        with self._lock:
            waiting = self._waiting[topic]
            if waiting and waiting + _size(arrival) > ROOM_BYTES:
                self.turn_away(topic, key, "the queue is full")
                return
            self._waiting[topic] = waiting + _size(arrival)
        self._queue.put(arrival)
        self._wake()

    def _wake(self) -> None:
        line = self._line  # another thread may be the one that drops it
        if line is not None:
            line.wake()

    def turn_away(self, topic: Topic, key: str, why: str) -> None:
        """Refuse a frame without queueing it, from any thread. `next` then counts and prints it."""
        with self._lock:
            entry = topic, key[:COMPLAINT], why
            if entry not in self._turned_away and len(self._turned_away) >= COMPLAINTS:
                entry = topic, "other keys", why
            self._turned_away[entry] += 1

    def awake(self) -> float:
        """Return the time in s without jumps of the clock, and without suspensions of the process, in waits.

        It tells for how long others have been silent.
        """
        return self.clock() - self._asleep

    def waited(self, began: float, longest: float) -> None:
        """Note that a wait, which was to last for at most `longest` s from `began` on, is over."""
        late = self.clock() - began - longest
        self._asleep += late if late > SIGNAL_S else 0.0

    def next(self, timeout: float | None) -> Arrival:
        """Return the next event, or NO_ARRIVAL after `timeout` s. Raises Interrupted for the topic "stop"."""
        arrival = self._queued(timeout) if self._line is None else self._from(self._line, timeout)
        if self._turned_away:
            self._count_turned_away()
        return arrival

    def _queued(self, timeout: float | None) -> Arrival:
        """Return the next event of the queue, or NO_ARRIVAL after `timeout`. Raises Interrupted."""
        until = self.clock() + timeout if timeout is not None else math.inf
        while True:
            began = self.clock()
            try:
                arrival = self._queue.get(timeout=min(max(until - began, 0.0), SIGNAL_S))
            except Empty:
                if self.clock() >= until:
                    return NO_ARRIVAL
            else:
                break
            finally:
                self.waited(began, SIGNAL_S)
        with self._lock:
            self._waiting[arrival.topic] -= _size(arrival)
        if arrival.topic == "stop":
            raise Interrupted(arrival.key)
        return arrival

    def _from(self, line: Line, timeout: float | None) -> Arrival:
        """Return the next event of `line` or the queue, or NO_ARRIVAL after `timeout`. Raises Interrupted."""
        until = self.clock() + timeout if timeout is not None else math.inf
        while True:
            idle = self._queue.empty()
            if idle or self._line_is_next:
                self._line_is_next = False
                began = self.clock()
                wait = idle and began < until
                if wait:
                    self._timer.set(min(until, began + SIGNAL_S))
                try:
                    arrival = line.receive(wait=wait)
                except LineClosed:
                    self._line = None
                    return self._queued(until - self.clock() if timeout is not None else None)
                self.waited(began, SIGNAL_S)
                if arrival is not None:
                    return arrival
            if not idle:
                self._line_is_next = True
                return self._queued(0.0)
            if self._turned_away:
                self._count_turned_away()
            if self.clock() >= until:
                return NO_ARRIVAL

    def accepted(self, arrival: Arrival, kind: Any, limit: int = MAX_SENT_BYTES) -> Any:
        """Return the message in `arrival` if it is a `kind` of the robot of its key; None if refused."""
        try:
            message = decode(arrival.frame, kind, limit)
        except MalformedFrame as error:
            self.refuse(arrival, error)
            return None
        named = getattr(message, "robot", arrival.source.robot)  # a MissionEnd names none
        if named == arrival.source.robot:
            return message
        self.refuse(arrival, f"its robot is given as '{named}'")
        return None

    def refuse(self, arrival: Arrival, why: object) -> None:
        """Count a refused frame, and print a message for the first with this key and reason."""
        self.refused[arrival.topic] += 1
        self._complain(arrival.key, str(why)[:COMPLAINT])

    def _count_turned_away(self) -> None:
        with self._lock:
            turned_away, self._turned_away = self._turned_away, Counter()
        for (topic, key, why), frames in turned_away.items():
            self.refused[topic] += frames
            self._complain(key, why)

    def _complain(self, key: str, why: str) -> None:
        complaint = (key, why)
        if complaint not in self._complaints and len(self._complaints) < COMPLAINTS:
            self._complaints.add(complaint)
            self.say(f"refused a frame on {key}: {why}")

    def say(self, line: str) -> None:
        """Print `line` on standard error, with the name of the process."""
        say(f"{self._owner}: {line}", error=True)


def _size(arrival: Arrival) -> int:
    """Return the approximate memory in bytes that `arrival` takes in the queue."""
    return len(arrival.frame) + len(arrival.key) + ARRIVAL_BYTES
