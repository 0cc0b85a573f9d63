"""What arrives at a process: frames, signs of life, the word to stop; and what of it was refused."""

from __future__ import annotations

import threading
from collections import Counter
from queue import Empty, SimpleQueue
from typing import Literal, NamedTuple

from protocol.network.keys import NOWHERE, Key
from protocol.output import say

Topic = Literal["observation", "command", "report", "tick-start", "alive", "gone", "ended", "stop", "nothing"]

COMPLAINTS = 100
"""kinds of malformed frames that are told, each once; the rest is only counted"""
COMPLAINT = 300
"""characters that are told of each"""
ROOM_BYTES = 1 << 22
"""what may wait of one topic: thousands of frames, more than any mission has waiting"""
ARRIVAL_BYTES = 200
"""what a frame takes beside its own bytes, about"""


class Interrupted(Exception):
    """The process was told to stop; its text is the signal."""


class Arrival(NamedTuple):
    """One thing that has arrived."""

    topic: Topic
    key: str = ""
    frame: bytes = b""
    source: Key = NOWHERE
    """what `key` names"""


NOTHING = Arrival("nothing")


class Inbox:
    """A queue that callbacks and signal handlers fill, and one thread empties, with a bound on each wait.

    What comes faster than it is emptied must not grow without end. Each topic has ROOM_BYTES of its own, so a
    flood of one leaves the others their room; a frame for which there is none is refused. Should that be one
    that the mission needs, it is lost as on any bad link, and said again.
    """

    def __init__(self, owner: str) -> None:
        self.refused = Counter[Topic]()
        """frames that were malformed, under no key, not from whom they said, out of step, or without room"""
        self._owner = owner
        self._queue: SimpleQueue[Arrival] = SimpleQueue()
        self._complaints: set[tuple[str, str]] = set()
        self._waiting = Counter[Topic]()
        """bytes"""
        self._turned_away = Counter[tuple[Topic, str, str]]()
        """by topic, key and reason: frames that never waited here, until they are counted as refused"""
        self._lock = threading.RLock()  # a signal handler may interrupt its holder

    def put(self, topic: Topic, key: str = "", frame: bytes = b"", source: Key = NOWHERE) -> None:
        """From any thread, and from a signal handler."""
        arrival = Arrival(topic, key, frame, source)
        with self._lock:
            waiting = self._waiting[topic]
            if waiting and waiting + _size(arrival) > ROOM_BYTES:
                self.turn_away(topic, key, "too many wait")
                return
            self._waiting[topic] = waiting + _size(arrival)
        self._queue.put(arrival)

    def turn_away(self, topic: Topic, key: str, why: str) -> None:
        """Refuse, from any thread, a frame that is not to wait here; `next` counts and tells it."""
        with self._lock:
            told = topic, key[:COMPLAINT], why
            if told not in self._turned_away and len(self._turned_away) >= COMPLAINTS:
                told = topic, "other keys", why
            self._turned_away[told] += 1

    def next(self, timeout: float | None) -> Arrival:
        """The next arrival; NOTHING after `timeout` seconds without. Raises Interrupted on "stop"."""
        try:
            arrival = self._queue.get(timeout=max(timeout, 0.0) if timeout is not None else None)
        except Empty:
            arrival = NOTHING
        if self._turned_away:
            self._count_turned_away()
        if arrival is NOTHING:
            return NOTHING
        with self._lock:
            self._waiting[arrival.topic] -= _size(arrival)
        if arrival.topic == "stop":
            raise Interrupted(arrival.key)
        return arrival

    def refuse(self, arrival: Arrival, why: object) -> None:
        """Count a frame that cannot be used; tell of each kind once."""
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
        """Tell whoever watches the process."""
        say(f"{self._owner}: {line}", error=True)


def _size(arrival: Arrival) -> int:
    """About what it takes while it waits."""
    return len(arrival.frame) + len(arrival.key) + ARRIVAL_BYTES
