"""A mission as OS processes on this machine: one world, one agent per robot, and their launcher."""

from __future__ import annotations

import random
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from compose.errors import ENDED
from compose.launch import forked
from compose.launch.forked import ForkServer
from compose.scenario.kills import WORLD, Kill, taken
from protocol import limits
from protocol.network.inbox import Inbox
from protocol.output import say
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from world.scenario import Scenario

FOLLOW_S = 2.0
"""Time in s that the agents have to end after the world has ended."""
STOP_S = 3.0
"""Time in s that a process has to end after SIGTERM; then it is killed."""
JOIN_S = 60.0
"""The connection timeout of an agent in s, before JOIN_EACH_S is added."""
JOIN_EACH_S = 0.5
"""Time in s added for each robot of the run, because all start at once."""
CHILD_FILES, SPARE_FILES = 2, 12
"""The number of descriptors that the launcher needs for each process of a run, and for starting one."""
LISTENING_PORTS = range(20_000, 32_000)
"""The ports for `free_endpoint`. They are below the ephemeral ports, which outgoing connections may take."""


class ChildFailed(RuntimeError):
    """A process ended before the run did; the text says which one, and how."""


def free_endpoint(protocol: str = "tcp") -> str:
    """Return a loopback endpoint on which no process listens."""
    ports = random.SystemRandom()
    while True:
        port = ports.choice(LISTENING_PORTS)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return f"{protocol}/127.0.0.1:{port}"


def fork_server() -> ForkServer:
    """Return the fork server of this process's worlds and agents."""
    return forked.fork_server("compose.cli.warm_up:missions")


class MissionProcess:
    """A process of the run. It has its own session, so Ctrl-C reaches it only through the launcher."""

    def __init__(self, name: str, arguments: list[str], inbox: Inbox, kills: Sequence[Kill]) -> None:
        self.name = name
        self.kills = list(kills)
        """Scheduled kills that have not happened yet."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed by `forget`
        self._server = fork_server()
        self._process = self._server.start(
            "compose.cli.main:main",
            "tandem",
            *arguments,
            *[word for kill in kills for word in ("--kill", kill.text)],
            errors=self._errors.fileno(),
            on_end=lambda: inbox.put("ended", name),
        )

    @property
    def running(self) -> bool:
        """True if the process has not ended yet."""
        return self._process.running

    @property
    def status(self) -> int:
        """Wait for the process to end, and return its exit status; negative is the signal that killed it."""
        return self._process.status

    def stderr_text(self) -> str:
        """Return what the process has written to its standard error."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip()

    def how_ended(self) -> str:
        """Return how the process ended, as part of an error message."""
        if self._server.gone:
            return f"was killed: {self._server.why_gone()}"
        ending = (
            f"was killed by signal {-self.status}" if self.status < 0 else f"ended with status {self.status}"
        )
        return f"{ending}: {'; '.join(errors.splitlines())}" if (errors := self.stderr_text()) else ending

    def send(self, frame: bytes) -> None:
        """Send `frame`, preceded by its length, to the standard input of the process."""
        self._process.send(len(frame).to_bytes(4, "big") + frame)

    def stop(self) -> None:
        """Send SIGTERM, and SIGCONT in case the process is suspended."""
        self._process.signal(signal.SIGTERM)
        self._process.signal(signal.SIGCONT)

    def end(self, timeout: float) -> None:
        """Wait `timeout` seconds for the process to end, then kill it."""
        self._process.end(timeout)

    def forget(self) -> None:
        """Close the file that stores its standard error."""
        self._errors.close()


def scenario_from_launcher() -> Scenario:
    """Return the scenario that the launcher sent to the standard input of this child process."""
    size = int.from_bytes(sys.stdin.buffer.read(4), "big")
    return decode(sys.stdin.buffer.read(size), Scenario, MAX_FRAME_BYTES)


def run_mission(
    scenario: Scenario,
    out: Path,
    inbox: Inbox,
    *,
    run: str,
    rate: float | None,
    timeout: float,
    kills: Sequence[Kill] = (),
    keys: Path | None = None,
    agents_journal: bool = True,
) -> list[Kill]:
    """Run `scenario`, write its journals to `out`, and return the kills that did not happen.

    `rate` is the speed relative to real time, None for lockstep; `timeout` is in s. A process is killed at
    its points in `kills`, and restarted.

    Without `agents_journal`, only the world writes a journal. The outcome follows from that one alone, and
    with many robots the other files take a noticeable part of the run time.

    `keys` is the folder that `tandem keys` writes. With it, links are encrypted and access rules enforced.

    Raises ChildFailed, or Interrupted if `inbox` receives a signal. No process is left running in any case.
    """
    limits.need_files(CHILD_FILES * (1 + len(scenario.robots)) + SPARE_FILES, "a run as processes")
    arguments = _arguments(scenario, out, run, rate, timeout, keys, agents_journal=agents_journal)
    launched = _Run(scenario, inbox, arguments)
    try:
        for name in launched.names:
            launched.start(name, [kill for kill in kills if kill.process == name])
        launched.watch()
    finally:
        launched.stop()
    return [kill for child in launched.children.values() for kill in child.kills]


def _arguments(
    scenario: Scenario,
    out: Path,
    run: str,
    rate: float | None,
    timeout: float,
    keys: Path | None,
    *,
    agents_journal: bool,
) -> dict[str, list[str]]:
    """Return the command lines of the world and the agents, by process name."""
    endpoint = free_endpoint("tcp" if keys is None else "tls")
    shared = ["--launched", "--run", run, "--timeout", str(timeout)]
    journal = ["--out", str(out)]
    real_time = ["--rate", str(rate)] if rate is not None else []

    def keyed(participant: str) -> list[str]:
        return ["--keys", str(keys / participant)] if keys is not None else []

    wait = ["--connect-timeout", str(JOIN_S + JOIN_EACH_S * len(scenario.robots))]
    world = ["world", scenario.name, "--listen", endpoint, *keyed("world"), *shared, *journal, *real_time]
    return {WORLD: world} | {
        f"agent {robot.id}": [
            *("agent", robot.id, "--connect", endpoint),
            *keyed(f"agent-{robot.id}"),
            *shared,
            *(journal if agents_journal else []),
            *wait,
        ]
        for robot in scenario.robots
    }


class _Run:
    """The processes of one run, by name, and when to restart those that were killed."""

    def __init__(self, scenario: Scenario, inbox: Inbox, arguments: Mapping[str, list[str]]) -> None:
        """`arguments` are the command lines, by process name."""
        self._scenario = scenario
        self._inbox = inbox
        self._arguments = arguments
        self.names = list(arguments)
        self.children: dict[str, MissionProcess] = {}
        self._due: dict[str, float] = {}
        """Monotonic time in s at which a killed process is restarted, by name."""

    def start(self, name: str, kills: Sequence[Kill]) -> None:
        """Start or restart the process `name`, which will be killed at `kills`."""
        if name in self.children:
            self.children[name].forget()
        self.children[name] = MissionProcess(name, self._arguments[name], self._inbox, kills)
        if name == WORLD:
            self.children[name].send(encode(self._scenario))

    def watch(self) -> None:
        """Wait until all processes have ended, the agents at most FOLLOW_S after the world.

        Raises ChildFailed.
        """
        running = set(self.names)
        while running:
            arrival = self._inbox.next(self._timeout(WORLD in running))
            if arrival.topic == "nothing" and not self._due:
                return
            if arrival.topic == "ended":
                child = self.children[arrival.key]
                if child.status != ENDED:
                    self._schedule_restart(child)
                    continue
                running.discard(child.name)
                if child.name == WORLD:
                    self._due.clear()
            for name in [name for name, due in self._due.items() if time.monotonic() >= due]:
                del self._due[name]
                self.start(name, self.children[name].kills)

    def _timeout(self, world_runs: bool) -> float | None:
        """Return the timeout in s for the next message of the inbox; None is no timeout."""
        if self._due:
            return min(self._due.values()) - time.monotonic()
        return None if world_runs else FOLLOW_S

    def _schedule_restart(self, child: MissionProcess) -> None:
        """Schedule the restart of a killed child.

        Raises ChildFailed if the child did not end by one of its kills, or by a kill without a restart.
        """
        kill = taken(child.kills, child.stderr_text()) if child.status == -signal.SIGKILL else None
        if kill is None:
            raise ChildFailed(f"{child.name} {child.how_ended()}")
        if kill.after is None:
            raise ChildFailed(f"{child.name} was killed at tick {kill.tick} (--kill {kill.text})")
        child.kills.remove(kill)
        child.end(0.0)
        when = f" in {kill.after:g} s" if kill.after else ""
        self._inbox.say(f"{child.name} was killed at tick {kill.tick}, and is restarted{when}")
        self._due[child.name] = time.monotonic() + kill.after

    def stop(self) -> None:
        """End all processes, and print what those that ended well wrote to standard error."""
        _stop(self.children.values())
        for child in self.children.values():
            if child.status == ENDED and (errors := child.stderr_text()):
                say(*errors.splitlines(), error=True)
            child.forget()


def _stop(children: Iterable[MissionProcess]) -> None:
    for child in children:
        if child.running:
            child.stop()
    give_up = time.monotonic() + STOP_S
    for child in children:
        child.end(give_up - time.monotonic())
