"""What arrives at a process: frames, signs of life, the word to stop; and what of it was refused."""

from __future__ import annotations

import sys
from collections import Counter
from queue import Empty, SimpleQueue
from typing import Literal, NamedTuple

Topic = Literal["sense", "drive", "report", "alive", "gone", "ended", "stop", "nothing"]

COMPLAINTS = 100
"""kinds of malformed frames that are told, each once; the rest is only counted"""


class Interrupted(Exception):
    """The process was told to stop; its text is the signal."""


class Arrival(NamedTuple):
    """One thing that has arrived."""

    topic: Topic
    key: str = ""
    frame: bytes = b""


NOTHING = Arrival("nothing")


class Inbox:
    """A queue that callbacks and signal handlers fill, and one thread empties, with a bound on each wait."""

    def __init__(self, owner: str) -> None:
        self.refused = Counter[Topic]()
        """frames that were malformed, or not from whom they said"""
        self._owner = owner
        self._queue: SimpleQueue[Arrival] = SimpleQueue()
        self._complaints: set[tuple[str, str]] = set()

    def put(self, topic: Topic, key: str = "", frame: bytes = b"") -> None:
        """From any thread, and from a signal handler."""
        self._queue.put(Arrival(topic, key, frame))

    def next(self, timeout: float | None) -> Arrival:
        """The next arrival; NOTHING after `timeout` seconds without. Raises Interrupted on "stop"."""
        try:
            arrival = self._queue.get(timeout=max(timeout, 0.0) if timeout is not None else None)
        except Empty:
            return NOTHING
        if arrival.topic == "stop":
            raise Interrupted(arrival.key)
        return arrival

    def refuse(self, arrival: Arrival, why: object) -> None:
        """Count a frame that cannot be used; tell of each kind once."""
        self.refused[arrival.topic] += 1
        complaint = (arrival.key, str(why))
        if complaint not in self._complaints and len(self._complaints) < COMPLAINTS:
            self._complaints.add(complaint)
            self.say(f"refused a frame on {arrival.key}: {why}")

    def say(self, line: str) -> None:
        """Tell whoever watches the process."""
        print(one_line(f"{self._owner}: {line}"), file=sys.stderr, flush=True)


def one_line(text: str) -> str:
    """`text` with whatever would break or garble a line escaped."""
    return "".join([char if char.isprintable() else repr(char)[1:-1] for char in text])
