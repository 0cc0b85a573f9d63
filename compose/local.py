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
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from compose.kill import WORLD, Kill, taken
from compose.status import ENDED
from protocol import limits
from protocol.inbox import Inbox
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from world.scenario import Scenario

FOLLOW_S = 2.0
"""how long the agents may outlast the world"""
STOP_S = 3.0
"""how long a process may take to end when told to; then it is killed"""
CHILD_FILES, SPARE_FILES = 2, 8
"""descriptors that the launcher takes for each process of a run, and for starting one"""
LISTENING_PORTS = range(20_000, 32_000)
"""below those that the system gives to outgoing connections, which could take one in between"""


class ChildFailed(RuntimeError):
    """A process of the run ended before the run did; says which, and how."""


def free_endpoint(protocol: str = "tcp") -> str:
    """An endpoint on loopback on which nobody listens."""
    ports = random.SystemRandom()
    while True:
        port = ports.choice(LISTENING_PORTS)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return f"{protocol}/127.0.0.1:{port}"


class Child:
    """A process of the run. It is in a session of its own: Ctrl-C reaches it only through the launcher."""

    def __init__(self, name: str, arguments: list[str], inbox: Inbox, kills: Sequence[Kill]) -> None:
        self.name = name
        self.kills = list(kills)
        """those that it is to take"""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # gone with the child
        # -P: the user's directory may hold a folder called world, or agent
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "compose", *arguments]
            + [word for kill in kills for word in ("--kill", kill.text)],
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

    def forget(self) -> None:
        """What it said is of no more use."""
        self._errors.close()


def handed() -> Scenario:
    """In a child: the scenario that its launcher has handed it."""
    size = int.from_bytes(sys.stdin.buffer.read(4), "big")
    return decode(sys.stdin.buffer.read(size), Scenario, MAX_FRAME_BYTES)


def play(
    scenario: Scenario,
    out: Path,
    inbox: Inbox,
    *,
    run: str,
    rate: float | None,
    patience: float,
    kills: Sequence[Kill] = (),
    keys: Path | None = None,
) -> list[Kill]:
    """Play `scenario`; journals go to `out`. A process takes its `kills` and is started again.

    With `keys`, the folder that `tandem keys` makes, links are encrypted, and access rules enforced.

    Returns those that never came. Raises ChildFailed, or Interrupted when `inbox` says so; no process is left
    then, either.
    """
    limits.need_files(CHILD_FILES * (1 + len(scenario.robots)) + SPARE_FILES, "a run as processes")
    launched = _Run(scenario, out, inbox, run=run, rate=rate, patience=patience, keys=keys)
    try:
        for name in launched.names:
            launched.start(name, [kill for kill in kills if kill.process == name])
        launched.watch()
    finally:
        launched.stop()
    return [kill for child in launched.children.values() for kill in child.kills]


class _Run:
    """The processes of one run, by name, and those that are to be started again."""

    def __init__(
        self,
        scenario: Scenario,
        out: Path,
        inbox: Inbox,
        *,
        run: str,
        rate: float | None,
        patience: float,
        keys: Path | None,
    ) -> None:
        self._scenario = scenario
        self._inbox = inbox
        self._arguments = self._named(out, run, rate, patience, keys)
        self.names = list(self._arguments)
        self.children: dict[str, Child] = {}
        self._due: dict[str, float] = {}
        """when to start again who has been killed"""

    def _named(
        self, out: Path, run: str, rate: float | None, patience: float, keys: Path | None
    ) -> dict[str, list[str]]:
        endpoint = free_endpoint("tcp" if keys is None else "tls")
        shared = ["--launched", "--run", run, "--out", str(out), "--patience", str(patience)]
        real_time = ["--rate", str(rate)] if rate is not None else []

        def keyed(who: str) -> list[str]:
            return ["--keys", str(keys / who)] if keys is not None else []

        world = ["world", self._scenario.name, "--listen", endpoint, *keyed("world"), *shared, *real_time]
        return {WORLD: world} | {
            f"agent {robot.id}": [
                *("agent", robot.id, "--connect", endpoint),
                *keyed(f"agent-{robot.id}"),
                *shared,
            ]
            for robot in self._scenario.robots
        }

    def start(self, name: str, kills: Sequence[Kill]) -> None:
        """Start it, for the first time or again."""
        if name in self.children:
            self.children[name].forget()
        self.children[name] = Child(name, self._arguments[name], self._inbox, kills)
        if name == WORLD:
            self.children[name].hand(encode(self._scenario))

    def watch(self) -> None:
        """Until all have ended; the agents have FOLLOW_S to follow the world. Raises ChildFailed."""
        running = set(self.names)
        while running:
            arrival = self._inbox.next(self._patience(WORLD in running))
            if arrival.topic == "nothing" and not self._due:
                return
            if arrival.topic == "ended":
                child = self.children[arrival.key]
                if child.status != ENDED:
                    self._bury(child)
                    continue
                running.discard(child.name)
                if child.name == WORLD:
                    self._due.clear()
            for name in [name for name, due in self._due.items() if time.monotonic() >= due]:
                del self._due[name]
                self.start(name, self.children[name].kills)

    def _patience(self, world_runs: bool) -> float | None:
        """How long to wait for what comes next."""
        if self._due:
            return min(self._due.values()) - time.monotonic()
        return None if world_runs else FOLLOW_S

    def _bury(self, child: Child) -> None:
        """It is to be started again if it took a kill. Raises ChildFailed if not, or if it is never to be."""
        said = child.said()
        kill = taken(child.kills, said) if child.status == -signal.SIGKILL else None
        if kill is None:
            raise ChildFailed(f"{child.name} {_how(child.status)}{said and ': ' + said}")
        if kill.after is None:
            raise ChildFailed(f"{child.name} was killed at tick {kill.tick} (--kill {kill.text})")
        child.kills.remove(kill)
        child.end(0.0)
        when = f" in {kill.after:g} s" if kill.after else ""
        self._inbox.say(f"{child.name} was killed at tick {kill.tick}, and is started again{when}")
        self._due[child.name] = time.monotonic() + kill.after

    def stop(self) -> None:
        """Leave nobody behind."""
        _stop(self.children.values())
        for child in self.children.values():
            if child.status == ENDED and (said := child.said()):
                print(said, file=sys.stderr)
            child.forget()


def _how(status: int) -> str:
    return f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"


def _stop(children: Iterable[Child]) -> None:
    for child in children:
        if child.running:
            child.stop()
    give_up = time.monotonic() + STOP_S
    for child in children:
        child.end(give_up - time.monotonic())
