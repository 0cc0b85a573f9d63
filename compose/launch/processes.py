"""A mission as OS processes on this machine: one world, one agent per robot, and their launcher."""

from __future__ import annotations

import os
import random
import signal
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from compose.errors import ENDED
from compose.launch.forked import launcher
from compose.launch.model_loader import trust_all
from compose.launch.planner_loader import is_shipped
from compose.launch.supervisor import ChildFailed, Supervisor
from compose.recording.kills_file import KILLS, add_kill
from compose.scenario.kills import WORLD, Kill, taken
from protocol import limits
from protocol.network.clock import ClockError
from protocol.network.inbox import Inbox
from protocol.output import say
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from world.scenario import Scenario

FOLLOW_S = 2.0
"""Time in s that the agents have to end after the world has ended."""
JOIN_S = 60.0
"""The connection timeout of an agent in s, before JOIN_EACH_S is added."""
JOIN_EACH_S = 0.5
"""Time in s added for each robot of the run, because all start at once."""
CHILD_FILES, SPARE_FILES = 2, 12
"""The number of descriptors that the launcher needs for each process of a run, and for starting one."""
LISTENING_PORTS = range(20_000, 32_000)
"""The ports for `free_endpoint`. They are below the ephemeral ports, which outgoing connections may take."""
RESERVED = 64
"""The number of latest ports that this process reserves, so that no other process is given one of them."""

_reservations: deque[int] = deque()
"""Their file descriptors. A socket that is still open would be warned of when this process ends."""


def free_endpoint(protocol: str = "tcp") -> str:
    """Return a loopback endpoint on which no process listens, and that no other call returns meanwhile.

    The port stays reserved also while nothing listens there, as after a crash of its process. A process that
    connects again would otherwise reach another run.
    """
    ports = random.SystemRandom()
    while True:
        port = ports.choice(LISTENING_PORTS)
        reservation = socket.socket()
        try:
            reservation.bind(("127.0.0.1", port))
        except OSError:
            reservation.close()
            continue
        reservation.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        _reservations.append(reservation.detach())
        if len(_reservations) > RESERVED:
            os.close(_reservations.popleft())
        return f"{protocol}/127.0.0.1:{port}"


def scenario_from_launcher() -> Scenario:
    """Return the scenario that the launcher has sent to this child process."""
    scenario: Scenario = decode(launcher().recv_bytes(), Scenario, MAX_FRAME_BYTES)
    trust_all(scenario)
    return scenario


def run_mission(
    scenario: Scenario,
    out: Path,
    inbox: Inbox,
    *,
    run: str,
    rate: float | None,
    timeout: float,
    kills: Sequence[Kill] = (),
    clocks: Mapping[str, ClockError] = MappingProxyType({}),
    keys: Path | None = None,
    agents_journal: bool = True,
    on_start: Callable[[], object] = lambda: None,
) -> list[Kill]:
    """Run `scenario`, write its journals to `out`, and return the kills that did not happen.

    `rate` is the speed relative to real time, None for lockstep; `timeout` is in s. A process is killed at
    its points in `kills`, and restarted. `clocks` are the errors of clocks, by robot or WORLD.

    Without `agents_journal`, only the world writes a journal. The outcome follows from that one alone, and
    with many robots the other files take a noticeable part of the run time.

    `keys` is the folder that `tandem keys` writes. With it, links are encrypted and access rules enforced.

    `on_start` is called when all processes are launched.

    Raises ChildFailed, or Interrupted if `inbox` receives a signal. No process is left running in any case.
    """
    limits.need_files(CHILD_FILES * (1 + len(scenario.robots)) + SPARE_FILES, "a run as processes")
    arguments = _arguments(scenario, out, run, rate, timeout, keys, agents_journal=agents_journal)
    since = time.monotonic()
    for who, error in clocks.items():
        arguments[WORLD if who == WORLD else f"agent {who}"] += error.arguments(since)
    mission = _Mission(scenario, arguments, kills, inbox, out if agents_journal else None)
    try:
        mission.start()
        on_start()
        mission.run()
    finally:
        mission.children.stop()
        mission.children.say_errors()
    return [kill for left in mission.kills.values() for kill in left]


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
            *([] if is_shipped(scenario.planner_name) else ["--planner", scenario.planner_name]),
            *wait,
        ]
        for robot in scenario.robots
    }


class _Mission:
    """The world and the agents of one run, restarted when they were killed."""

    def __init__(
        self,
        scenario: Scenario,
        arguments: Mapping[str, list[str]],
        kills: Sequence[Kill],
        inbox: Inbox,
        recording: Path | None,
    ) -> None:
        """`arguments` are the command lines, by process name; `recording` is the folder of all journals."""
        self._scenario = encode(scenario)
        self._arguments = arguments
        self._inbox = inbox
        self._recording = recording
        self.children = Supervisor(inbox)
        self.kills = {name: [kill for kill in kills if kill.process == name] for name in arguments}
        """Kills that have not happened yet, by process name."""

    def start(self) -> None:
        """Start all processes."""
        for name in self._arguments:
            self._start(name)

    def run(self) -> None:
        """Wait until all processes have ended, the agents at most FOLLOW_S after the world.

        Raises ChildFailed.
        """
        running = set(self._arguments)
        while running:
            ended = self.children.next_end(None if WORLD in running else FOLLOW_S)
            if ended is None:
                return
            if self.children[ended].status != ENDED:
                self._restart(ended)
                continue
            running.discard(ended)
            if ended == WORLD:
                self.children.cancel_starts()

    def _start(self, name: str) -> None:
        kills = [word for kill in self.kills[name] for word in ("--kill", kill.text)]
        child = self.children.start(name, *self._arguments[name], *kills)
        if name == WORLD:
            child.send(self._scenario)

    def _restart(self, name: str) -> None:
        """Restart a child that was killed.

        Raises ChildFailed if the child did not end by one of its kills, or by a kill without a restart.
        """
        child = self.children[name]
        kill = taken(self.kills[name], child.stderr_text) if child.status == -signal.SIGKILL else None
        if kill is None:
            raise self.children.failure(name)
        self._note(kill)
        if said := child.stderr_text.splitlines()[:-1]:  # since it was restarted itself
            say(*said, error=True)
        if kill.after is None:
            raise ChildFailed(f"{name} was killed at tick {kill.tick} (--kill {kill.text})")
        self.kills[name].remove(kill)
        when = f" in {kill.after:g} s" if kill.after else ""
        self._inbox.say(f"{name} was killed at tick {kill.tick}, and is restarted{when}")
        self.children.start_later(kill.after, lambda: self._start(name))

    def _note(self, kill: Kill) -> None:
        """Write `kill` to the recording; say why if that fails, which does not end the mission."""
        if self._recording is not None:
            try:
                add_kill(self._recording, kill)
            except (OSError, ValueError) as error:
                self._inbox.say(f"{KILLS} lacks --kill {kill.text}: {error}")
