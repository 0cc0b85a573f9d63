"""A mission as OS processes on this machine: one world, one agent per robot, and who watches over them."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from compose.status import ENDED
from protocol.inbox import Inbox
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from world.scenario import Scenario

FOLLOW_S = 2.0
"""how long the agents may outlast the world"""
STOP_S = 3.0
"""how long a process may take to end when told to; then it is killed"""
LISTENING_PORTS = range(20_000, 32_000)
"""below those that the system gives to outgoing connections, which could take one in between"""


class ChildFailed(RuntimeError):
    """A process of the run ended before the run did; says which, and how."""


def free_endpoint() -> str:
    """A TCP endpoint on loopback on which nobody listens."""
    ports = random.SystemRandom()
    while True:
        port = ports.choice(LISTENING_PORTS)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return f"tcp/127.0.0.1:{port}"


class _Child:
    """A process of the run. It is in a session of its own: Ctrl-C reaches it only through the launcher."""

    def __init__(self, name: str, arguments: list[str], inbox: Inbox) -> None:
        self.name = name
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # gone with the child
        # -P: the user's directory may hold a folder called world, or agent
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "compose", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            start_new_session=True,
        )
        self._inbox = inbox
        assert self._process.stdin is not None
        self._input = self._process.stdin  # open as long as the launcher lives: the child ends with it
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        self._process.wait()
        self._inbox.put("ended", self.name)

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    @property
    def status(self) -> int:
        """Its exit status, once it has ended; negative is the signal that killed it."""
        return self._process.wait()

    def said(self) -> str:
        """What it wrote to its standard error."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip()

    def hand(self, frame: bytes) -> None:
        """Give it `frame` to start from."""
        with suppress(BrokenPipeError):
            self._input.write(len(frame).to_bytes(4, "big") + frame)
            self._input.flush()

    def stop(self) -> None:
        """Tell it to end, even if it has been suspended."""
        self._process.terminate()
        self._process.send_signal(signal.SIGCONT)

    def end(self, timeout: float) -> None:
        """Wait `timeout` seconds for it to end; then kill it."""
        try:
            self._process.wait(max(timeout, 0.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with suppress(BrokenPipeError):
            self._input.close()


def handed() -> Scenario:
    """In a child: the scenario that its launcher has handed it."""
    size = int.from_bytes(sys.stdin.buffer.read(4), "big")
    return decode(sys.stdin.buffer.read(size), Scenario, MAX_FRAME_BYTES)


def play(
    scenario: Scenario, out: Path, inbox: Inbox, *, run: str, rate: float | None, patience: float
) -> None:
    """Play `scenario`; journals go to `out`.

    Raises ChildFailed, or Interrupted when `inbox` says so; no process is left then, either.
    """
    endpoint = free_endpoint()
    shared = ["--launched", "--run", run, "--out", str(out), "--patience", str(patience)]
    real_time = ["--rate", str(rate)] if rate is not None else []
    children = [_Child("world", ["world", scenario.name, "--listen", endpoint, *shared, *real_time], inbox)]
    children[0].hand(encode(scenario))
    try:
        for robot in scenario.robots:
            arguments = ["agent", robot.id, "--connect", endpoint, *shared]
            children.append(_Child(f"agent {robot.id}", arguments, inbox))
        _watch({child.name: child for child in children}, inbox)
    finally:
        _stop(children)
        for child in children:
            if child.status == ENDED and (said := child.said()):
                print(said, file=sys.stderr)


def _watch(children: Mapping[str, _Child], inbox: Inbox) -> None:
    """Until all have ended; the agents have FOLLOW_S to follow the world."""
    running = set(children)
    while running:
        arrival = inbox.next(None if "world" in running else FOLLOW_S)
        if arrival.topic == "nothing":
            return
        child = children[arrival.key]
        running.discard(child.name)
        if child.status != ENDED:
            raise ChildFailed(f"{child.name} {_how(child.status)}{child.said() and ': ' + child.said()}")


def _how(status: int) -> str:
    return f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"


def _stop(children: Sequence[_Child]) -> None:
    """Leave nobody behind."""
    for child in children:
        if child.running:
            child.stop()
    give_up = time.monotonic() + STOP_S
    for child in children:
        child.end(give_up - time.monotonic())
