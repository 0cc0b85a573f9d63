"""A mission as OS processes on this machine: one world, one agent per robot, and who watches over them."""

from __future__ import annotations

import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO

from compose.stop import stops_into
from world.scenario import Scenario

STOP_S = 5.0
"""how long a process may take to end when told to; then it is killed"""
PROGRESS_S = 0.1
LISTENING_PORTS = range(20_000, 32_000)
"""below those that the system gives to outgoing connections, which could take one in between"""

ENDED = (0, 1)
"""exit statuses of a process whose mission came to an End"""


class ChildFailed(RuntimeError):
    """A process of the run ended before the run did; says which, and how."""


class Interrupted(Exception):
    """The launcher was told to stop."""


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

    def __init__(self, name: str, arguments: list[str], ended: SimpleQueue[tuple[str, str, bytes]]) -> None:
        self.name = name
        self._errors: IO[bytes] = tempfile.TemporaryFile()
        # -P: the user's directory may hold a folder called world, or agent
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "compose", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            start_new_session=True,
        )
        self._ended = ended
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        self._process.wait()
        self._ended.put(("ended", self.name, b""))

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    @property
    def status(self) -> int:
        return self._process.wait()

    def said(self) -> str:
        """What it wrote to its standard error."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip()

    def stop(self) -> None:
        self._process.terminate()

    def kill(self) -> None:
        self._process.kill()


def play(
    scenario: Scenario,
    source: list[str],
    run: str,
    out: Path,
    *,
    options: list[str],
    progress: Callable[[], None] | None = None,
) -> str:
    """Play `scenario`, which `tandem world` finds by the arguments `source`; journals go to `out`.

    `options` go to every process. Calls `progress` every PROGRESS_S. Returns what the processes
    complained of. Raises ChildFailed or Interrupted; no process is left then, either.
    """
    inbox: SimpleQueue[tuple[str, str, bytes]] = SimpleQueue()
    endpoint = free_endpoint()
    shared = ["--run", run, "--out", str(out), "-q", *options]
    children: dict[str, _Child] = {}
    with stops_into(inbox):
        try:
            children["world"] = _Child("world", ["world", *source, "--listen", endpoint, *shared], inbox)
            agent_options = [option for option in shared if not option.startswith("--rate")]
            for robot in scenario.robots:
                arguments = ["agent", robot.id, "--connect", endpoint, *agent_options]
                children[robot.id] = _Child(f"agent {robot.id}", arguments, inbox)
            _watch(children, inbox, progress)
        finally:
            _stop(children)
    return "\n".join(said for child in children.values() if (said := child.said()))


def _watch(
    children: dict[str, _Child],
    inbox: SimpleQueue[tuple[str, str, bytes]],
    progress: Callable[[], None] | None,
) -> None:
    """Until all have ended."""
    running = {child.name for child in children.values()}
    names = {child.name: child for child in children.values()}
    while running:
        try:
            topic, name, _ = inbox.get(timeout=PROGRESS_S if progress is not None else None)
        except Empty:
            if progress is not None:
                progress()
            continue
        if topic == "stop":
            raise Interrupted(name)
        running.discard(name)
        child = names[name]
        if child.status not in ENDED:
            raise ChildFailed(f"{name} {_how(child.status)}{': ' if child.said() else ''}{child.said()}")


def _how(status: int) -> str:
    return f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"


def _stop(children: dict[str, _Child]) -> None:
    """Leave nobody behind."""
    for child in children.values():
        if child.running:
            child.stop()
    give_up = time.monotonic() + STOP_S
    for child in children.values():
        while child.running and time.monotonic() < give_up:
            time.sleep(0.005)
        if child.running:
            child.kill()
        _ = child.status
