"""The Zenoh baseline of the benchmark: the duration of a tick's message exchange without a mission.

The processes, topology, quality of service and sizes of messages are those of a mission. The world sends a
frame to each robot and waits for a frame from each. Nothing is encoded, checked or stored.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from queue import SimpleQueue

import zenoh

from protocol.network import keys, session
from protocol.network.endpoints import at
from protocol.network.inbox import Inbox

BASELINE_TIMEOUT_S = 30.0
"""Time in s without an answer before giving up."""
RUN = "barrier"
"""The run name in the keys."""


def drop(frames: SimpleQueue[bytes], sample: zenoh.Sample) -> None:
    """Put the payload of a received sample into `frames`."""
    frames.put(sample.payload.to_bytes())


def world(link: zenoh.Session, robots: Sequence[str], size: int, ticks: int) -> float:
    """Wait for all robots, and return the time in s that `ticks` rounds with frames of `size` bytes take.

    Raises queue.Empty after BASELINE_TIMEOUT_S without an answer.
    """
    frames: SimpleQueue[bytes] = SimpleQueue()
    there = Inbox("barrier")
    link.declare_subscriber(keys.command(RUN, "*"), lambda sample: drop(frames, sample))
    publishers = [session.publisher(link, keys.observation(RUN, robot)) for robot in robots]
    session.watch_liveliness(link, keys.robot_alive(RUN, "*"), there)
    for _ in robots:
        there.next(BASELINE_TIMEOUT_S)
    frame = bytes(size)
    began = time.perf_counter()
    for _ in range(ticks):
        for publisher in publishers:
            publisher.put(frame)
        for _ in publishers:
            frames.get(timeout=BASELINE_TIMEOUT_S)
    return time.perf_counter() - began


def robot(endpoint: str, name: str, size: int, ticks: int) -> None:
    """Answer each of `ticks` frames with one of `size` bytes."""
    frames: SimpleQueue[bytes] = SimpleQueue()
    give_up = time.monotonic() + BASELINE_TIMEOUT_S

    def unanswered() -> None:
        if time.monotonic() > give_up:
            sys.exit(1)

    with session.open_client(at(endpoint), unanswered) as link:
        link.declare_subscriber(keys.observation(RUN, name), lambda sample: drop(frames, sample))
        publisher = session.publisher(link, keys.command(RUN, name))
        _token = session.show_alive(link, keys.robot_alive(RUN, name))
        frame = bytes(size)
        for _ in range(ticks):
            frames.get(timeout=BASELINE_TIMEOUT_S)
            publisher.put(frame)


def main() -> None:
    """Run the robot that sys.argv describes."""
    robot(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
