"""A measurement: a world and two agents on separate hosts, while links go down or a router is killed.

    uv run python -m tests.namespaces

This is a measurement, because it needs root and `ip` (Debian's iproute2); without them it is skipped. Each
host is a network namespace; one more, the switch, contains a bridge. Nothing else is changed, and all are
removed at the end.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from compose.network import KEYED
from protocol.journal import journal_file
from protocol.messages import Command, DeadlineMissed, Environment, FinalReport, MissionEnd
from protocol.network import session
from protocol.network.endpoints import Endpoints, configured
from protocol.wire import MAX_FRAME_BYTES, decode
from tests.commands import LONGER, PAPER_1, Ended, TandemProcess, decided, in_one_process, size, tandem, until
from world.scenario import Scenario

HOSTS = {"world": "10.77.0.1", "a": "10.77.0.2", "b": "10.77.0.3", "router": "10.77.0.4"}
PORT = 7447
DOWN_S = (0.5, 3.0, 20.0)
RATE = "10"
MIDDLE = {False: 20_000, True: 1_500}
"""The size in bytes of the world's journal at the interruption, in lockstep and in real time."""
ASSURED = PAPER_1.replace('"paper"', '"assured"').replace("10.0, 0.0", "20.0, 0.0").replace("11.3", "21.3")
"""The scenario for real time, in which the `paper` planner fails if a robot misses a deadline."""


class Case(NamedTuple):
    """An interruption in the middle of a run."""

    what: str
    real_time: bool
    routed: bool
    """true if the agents reach the world through a router"""
    happens: Callable[[Network, Run], None]
    """function that causes the interruption, and returns when it is over"""

    secured: bool = False
    """true to use TLS; the world and the agents are clients of a router that enforces access rules"""

    @property
    def by(self) -> str:
        """The part of the name of the case that describes its connection."""
        if self.secured:
            return ", through a router, secured"
        return ", through a router" if self.routed and self.what.startswith("link") else ""


class Network:
    """The hosts and the switch between them."""

    def __init__(self, stack: ExitStack) -> None:
        self._prefix = f"tandem-{os.getpid()}-"
        self._switch = self._namespace("switch", stack)
        _ip("-n", self._switch, "link", "add", "bridge", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "bridge", "up")
        for host, address in HOSTS.items():
            name = self._namespace(host, stack)
            veth = ("type", "veth", "peer", "name", "eth", "netns", name)
            _ip("link", "add", "name", host, "netns", self._switch, *veth)
            _ip("-n", self._switch, "link", "set", "dev", host, "master", "bridge", "up")
            _ip("-n", name, "address", "add", f"{address}/24", "dev", "eth")
            _ip("-n", name, "link", "set", "lo", "up")
            _ip("-n", name, "link", "set", "eth", "up")

    def _namespace(self, host: str, stack: ExitStack) -> str:
        name = self._prefix + host
        _ip("netns", "add", name)
        stack.callback(_ip, "netns", "delete", name)
        return name

    def link(self, host: str, state: str) -> None:
        """Set the link between `host` and the switch "up" or "down"."""
        _ip("-n", self._switch, "link", "set", "dev", host, state)

    def on(self, host: str) -> list[str]:
        """Return a command prefix that runs a command on `host`."""
        return ["ip", "netns", "exec", self._prefix + host]


class Run:
    """A running mission."""

    def __init__(self, case: Case, network: Network, folder: Path, stack: ExitStack) -> None:
        self.out = folder / "out"
        self._network = network
        self._stack = stack
        self.scenario = folder / "scenario.toml"
        self.scenario.write_text(ASSURED if case.real_time else LONGER)
        self._keys = folder / "keys" if case.secured else None
        if self._keys is not None:
            made = tandem("keys", self._keys, "--robots", "a,b", "--host", HOSTS["router"])
            assert made.status == 0, made
        protocol = "tls" if case.secured else "tcp"
        clock, router = (f"{protocol}/{HOSTS[host]}:{PORT}" for host in ("world", "router"))
        rate = ["--rate", RATE] if case.real_time else []
        self._route = ["--router", router, *([] if case.secured else [clock])]
        if self._keys is not None:
            self._route += ["--keys", str(self._keys / "router")]
            self.start_router()
        reach = ["--connect", router] if case.secured else ["--listen", clock]
        self.parts = {"world": self._part("world", "world", str(self.scenario), *reach, *rate)}
        self.parts["world"].until_written(self.out / "world.journal", 1)  # when it listens
        if case.routed and not case.secured:
            self.start_router()
        for robot in ("a", "b"):
            self.parts[robot] = self._part(
                robot, "agent", robot, "--connect", router if case.routed else clock
            )

    def _part(self, host: str, *arguments: str) -> TandemProcess:
        through = self._network.on(host)
        name = host if host == "world" else f"agent-{host}"
        keys = ["--keys", str(self._keys / name)] if self._keys is not None else []
        return self._stack.enter_context(
            TandemProcess(*arguments, *keys, "--out", self.out, "-q", through=through)
        )

    def start_router(self) -> None:
        """Start the router between the world and the agents."""
        arguments = [sys.executable, "-m", "tests.namespaces", *self._route]
        self.router = subprocess.Popen([*self._network.on("router"), *arguments])
        self._stack.callback(_end, self.router)

    def written(self) -> int:
        """Return the size of the world's journal in bytes."""
        return size(self.out / "world.journal")

    def answered(self) -> int:
        """Return the latest tick in which both robots have answered; -1 if none."""
        kinds = Environment | Scenario | Command | DeadlineMissed | MissionEnd | FinalReport
        both: dict[int, int] = {}
        for frame in journal_file.read(self.out / "world.journal"):
            message = decode(frame, kinds, MAX_FRAME_BYTES)
            if isinstance(message, Command):
                both[message.tick] = both.get(message.tick, 0) + 1
        return max([tick for tick, number in both.items() if number == 2], default=-1)

    @property
    def running(self) -> bool:
        """True while the world runs."""
        return self.parts["world"].running


def down(seconds: float) -> Callable[[Network, Run], None]:
    """Return an interruption in which the link of a is down for `seconds`."""

    def happens(network: Network, _run: Run) -> None:
        network.link("a", "down")
        try:
            time.sleep(seconds)
        finally:
            network.link("a", "up")

    return happens


def killed(seconds: float) -> Callable[[Network, Run], None]:
    """Return an interruption in which the router is killed, and restarted after `seconds`."""

    def happens(_network: Network, run: Run) -> None:
        run.router.kill()
        run.router.wait()
        time.sleep(seconds)
        run.start_router()

    return happens


CASES = [
    *(
        Case(f"link of a down for {seconds:g} s", real_time, routed, down(seconds))
        for routed in (False, True)
        for real_time in (False, True)
        for seconds in DOWN_S
    ),
    *(
        Case(f"router killed for {seconds:g} s", real_time, True, killed(seconds))
        for real_time in (False, True)
        for seconds in (0.0, 3.0)
    ),
]


CASES += [
    Case("link of a down for 3 s", False, True, down(3.0), True),
    Case("link of a down for 3 s", True, True, down(3.0), True),
    Case("router killed for 0 s", False, True, killed(0.0), True),
    Case("router killed for 3 s", False, True, killed(3.0), True),
]


def play(case: Case, network: Network, expected: dict[str, bytes]) -> tuple[dict[str, Ended], float, str]:
    """Run a case.

    Return how each process ended, the time in s until both robots answered again, and whether the recording
    has the expected bytes.
    """
    with tempfile.TemporaryDirectory(prefix="tandem-hosts-") as folder, ExitStack() as stack:
        run = Run(case, network, Path(folder), stack)
        run.parts["world"].until_written(run.out / "world.journal", MIDDLE[case.real_time])
        case.happens(network, run)
        before, well = run.answered(), time.monotonic()
        if run.running:
            until(lambda: not run.running or run.answered() > before, "both answer again")
        resumed = time.monotonic() - well
        ended = {name: part.ended() for name, part in run.parts.items()}
        found = decided(run.out)
    if case.real_time:
        return ended, resumed, "-"
    return ended, resumed, "yes" if found == expected else "NO"


def local() -> dict[str, bytes]:
    """Return the recording of the lockstep mission, run in one process."""
    with tempfile.TemporaryDirectory(prefix="tandem-hosts-") as folder:
        scenario = Path(folder) / "scenario.toml"
        scenario.write_text(LONGER)
        return decided(in_one_process(scenario, Path(folder) / "out"))


def route(listen: str, connect: list[str], keys: Path | None) -> None:
    """Run the router until it is killed."""
    endpoints = Endpoints(tuple(connect), (listen,))
    if keys is not None:
        endpoints = configured(keys / KEYED, connect, [listen])
    with session.open_router(endpoints):
        signal.pause()


@contextmanager
def hosts() -> Iterator[Network]:
    """Yield the network. Raises Unable if network namespaces cannot be used."""
    if os.geteuid() != 0:
        raise Unable("not root")
    if shutil.which("ip") is None:
        raise Unable("no command `ip`; Debian's package is iproute2")
    with ExitStack() as stack:
        try:
            network = Network(stack)
        except subprocess.CalledProcessError as error:
            raise Unable(f"network namespaces are not permitted: {error.stderr.strip()}") from None
        yield network


class Unable(Exception):
    """Network namespaces cannot be used here. The text gives the reason."""


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def main(wanted: str) -> int:
    """Run the cases whose names contain `wanted`; return 0 if all results are as expected."""
    wrong = 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))  # SIGTERM must clean up, too
    try:
        with hosts() as network:
            expected = local()
            print(f"{'case':54} {'outcome':32} {'resumed after s':>16} {'same bytes':>11}", flush=True)
            for case in CASES:
                timing = f"--rate {RATE}" if case.real_time else "lockstep"
                name = f"{case.what}, {timing}{case.by}"
                if wanted not in name:
                    continue
                ended, resumed, same = play(case, network, expected)
                outcome = ended["world"].out.strip() or ended["world"].err.strip()
                print(f"{name:54} {outcome:32} {resumed:16.2f} {same:>11}", flush=True)
                if same == "NO" or any(end.status != 0 for end in ended.values()):
                    wrong += 1
                    print("\n".join(f"    {name}: {end}" for name, end in ended.items()), flush=True)
    except Unable as why:
        print(f"skipped: {why}")
    return int(wrong > 0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("wanted", nargs="?", default="", help="run only cases whose names contain this text")
    parser.add_argument("--router", nargs="+", metavar="LISTEN CONNECT", help=argparse.SUPPRESS)
    parser.add_argument("--keys", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.router is not None:
        route(arguments.router[0], arguments.router[1:], arguments.keys)
    sys.exit(main(arguments.wanted))
