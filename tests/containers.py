"""A measurement: a mission in containers of the compose file, one of which is killed and restarted.

    uv run python -m tests.containers [--base FILE]

This is a measurement, because it needs root, podman, and mmdebstrap unless `--base` is given (all packages of
Debian). If one is missing, it prints so and is skipped. It uses no image registry: the base image is made of
Debian packages, and the rest comes from PyPI. All images and containers are in a temporary folder that is
removed at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

from compose.launch.processes import free_endpoint
from tests.commands import TandemProcess, tandem, until
from tests.podman import DEPLOY, HOUSE, Podman, Unable

BASE, LEAN, LAB = (f"localhost/tandem-check{part}" for part in ("-base", "", "-lab"))
EPOCH = "1700000000"
"""The date of every file in an image, in s since 1970."""
RATE = 4.0
"""The factor of real time; a mission takes about 7 s."""
MIDDLE = 8
"""The first tick at which a container is killed."""
PORT = 7447
LINKS = 3
"""The number of links of the router during a mission: both agents and the world."""
ESTABLISHED = "01"
"""The state of an established connection in /proc/net/tcp."""
AWAY_S = 1.0
"""The least time in s between the kill and the restart of a container."""
ROUTER = """
import signal, zenoh
config = zenoh.Config()
for path, value in {
    "mode": '"router"',
    "listen/endpoints": '["tcp/0.0.0.0:7447"]',
    "connect/endpoints": '["tcp/world:7447"]',
    "connect/timeout_ms": "-1",
    "connect/exit_on_failure": "false",
    "scouting/multicast/enabled": "false",
}.items():
    config.insert_json5(path, value)
with zenoh.open(config):
    signal.pause()
"""
"""A program that replaces the router's official image, which only a registry has: the same configuration."""


class Mission:
    """A mission that runs in the containers of the compose file."""

    def __init__(self, podman: Podman, port: int, what: str) -> None:
        self._podman = podman
        self._project = f"tandem-{os.getpid()}-{what}"
        self._port = port
        self._options: tuple[str, ...] = ()

    def compose(self, *arguments: str) -> None:
        """Run podman-compose for this mission."""
        self._podman.compose(
            *("-p", self._project, *self._options, *arguments),
            TANDEM_IMAGE=LEAN,
            TANDEM_LAB_IMAGE=LAB,
            TANDEM_PORT=str(self._port),
            TANDEM_RATE=str(RATE),
        )

    def routed(self, folder: Path) -> None:
        """Use a router, which starts before the world."""
        stand_in = folder / "stand-in.json"
        service = {"image": LEAN, "entrypoint": ["python3", "-c", ROUTER], "command": []}
        stand_in.write_text(json.dumps({"services": {"zenoh": service}}))
        self._options = ("-f", str(stand_in), "--profile", "router")

    def container(self, service: str) -> str:
        """Return the name of the container of a service."""
        return f"{self._project}_{service}_1"

    def tick(self) -> int:
        """Return the latest tick that the page has received; -1 if none."""
        try:
            with urlopen(f"http://127.0.0.1:{self._port}/api/news", timeout=5.0) as news:
                shows = json.loads(news.readline().removeprefix(b"data: "))["list"]["shows"]
        except (URLError, ConnectionError, TimeoutError):
            return -1
        return max((show["last"] for show in shows), default=-1)

    def ended(self, service: str) -> int | None:
        """Return the exit status of a service; None while it runs."""
        state = self._podman(
            "inspect", "--format", "{{.State.Running}} {{.State.ExitCode}}", self.container(service)
        )
        running, status = state.split()
        return None if running == "true" else int(status)

    def healthy(self, service: str) -> bool:
        """Return true if the health check of a service passes."""
        try:
            self._podman("healthcheck", "run", self.container(service))
        except subprocess.CalledProcessError:
            return False
        return True

    def links(self, service: str) -> int:
        """Return the number of connections of a service on the router's port."""
        tables = self._podman("exec", self.container(service), "cat", "/proc/net/tcp", "/proc/net/tcp6")
        rows = [line.split() for line in tables.splitlines() if ":" in line.split()[0]]
        port = f":{PORT:04X}"
        return sum(row[3] == ESTABLISHED and (row[1].endswith(port) or row[2].endswith(port)) for row in rows)

    def logs(self, service: str) -> str:
        """Return the log of a service."""
        return self._podman("logs", self.container(service))

    def recording(self, folder: Path) -> Path:
        """Copy all journals to `folder`, and return it."""
        for name in ("world", "agent-a", "agent-b"):
            self._podman("cp", f"{self.container(name)}:/journal/{name}.journal", folder)
        return folder


def base(podman: Podman, given: Path | None, folder: Path) -> str:
    """Import the base image, and return how it was made. Raises Unable."""
    file, how = given, f"of {given}"
    if file is None:
        if shutil.which("mmdebstrap") is None:
            raise Unable("no command `mmdebstrap`; it is Debian's package of that name, or --base FILE")
        began = time.monotonic()
        file = folder / "base.tar"
        leave_out = [f"--dpkgopt=path-exclude=/usr/share/{one}/*" for one in ("doc", "man", "locale", "info")]
        _checked(
            ["mmdebstrap", "--variant=minbase", "--include=python3,python3-venv", *leave_out]
            + ["bookworm", str(file)]
        )
        how = f"made with mmdebstrap in {time.monotonic() - began:.0f} s"
    podman.load(file, BASE)
    return how


def build(podman: Podman, folder: Path) -> None:
    """Build both images, and print a line for each. Raises CalledProcessError."""
    python = podman("run", "--rm", "--network=none", BASE, "python3", "-V").split()[1].rpartition(".")[0]
    project = tomllib.loads((HOUSE / "pyproject.toml").read_text())
    wanted = project["build-system"]["requires"] + project["project"]["dependencies"]
    wanted += project["project"]["optional-dependencies"]["lab"]
    wheels = folder / "wheels"
    options = ["-q", "-d", str(wheels), "--python-version", python, "--only-binary=:all:"]
    _checked(["uv", "tool", "run", "pip", "download", *options, *wanted])
    for image, extras in ((LEAN, ""), (LAB, "lab")):
        arguments = {
            "BASE": BASE, "EXTRAS": extras, "SOURCE_DATE_EPOCH": EPOCH,
            "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": "/wheels", "PIP_INDEX_URL": "",
        }  # fmt: skip
        given = [part for name, value in arguments.items() for part in ("--build-arg", f"{name}={value}")]
        began = time.monotonic()

        def once(image: str = image, given: list[str] = given) -> str:
            flags = ["--no-cache", "--network=none", "--timestamp", EPOCH, "-v", f"{wheels}:/wheels:ro"]
            podman("build", *flags, "-t", image, "-f", DEPLOY / "Containerfile", *given, HOUSE)
            return podman("inspect", "--format", "{{json .RootFS.Layers}}", image)

        layers, took = once(), time.monotonic() - began
        size = int(podman("inspect", "--format", "{{.Size}}", image)) / 1e6
        own = size - int(podman("inspect", "--format", "{{.Size}}", BASE)) / 1e6
        again = "" if extras else f"; identical when built again: {'yes' if once() == layers else 'NO'}"
        sizes = f"{size:.0f} MB, {own:.0f} without its base"
        print(f"image {extras or 'lean'}: {sizes}; built in {took:.0f} s{again}", flush=True)
    began = time.monotonic()
    podman("run", "--rm", "--network=none", "--read-only", LEAN, "scenarios")
    print(f"start: `scenarios`, container included, {time.monotonic() - began:.2f} s", flush=True)


def play(podman: Podman, killed: str, folder: Path) -> bool:
    """Run a mission in which the service `killed` is killed and restarted.

    Print the result, and return true if it is as expected.
    """
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    mission = Mission(podman, port, killed)
    services = ["world", "agent-a", "agent-b"]
    up = ["up", "-d", "--no-build"]
    if killed == "zenoh":
        mission.routed(folder)
    try:
        if killed == "zenoh":
            mission.compose(*up, "zenoh")
        began = time.monotonic()
        mission.compose(*up)
        until(lambda: mission.tick() >= 0, "the page sees the mission")
        seen = time.monotonic() - began
        until(lambda: mission.tick() >= MIDDLE, "the mission is in its middle")
        sick = [one for one in (*services, "page") if not mission.healthy(one)]
        if killed == "zenoh":
            sick += [] if mission.links("zenoh") == LINKS else ["links of the router"]
        mission.compose("kill", killed)
        at, since = mission.tick(), time.monotonic()
        until(lambda: time.monotonic() >= since + AWAY_S, "the container is away")
        mission.compose(*up, killed)
        until(lambda: all(mission.ended(one) is not None for one in services), "all have ended", 120.0)
        statuses = {one: mission.ended(one) for one in services}
        outcome = next((line for line in mission.logs("agent-b").splitlines() if " after " in line), "?")
        audit = tandem("audit", mission.recording(Path(tempfile.mkdtemp(dir=folder))))
        page = mission.tick()
        mission.compose(*up)
        until(lambda: all(mission.ended(one) is not None for one in services), "all have ended again", 300.0)
        folded = {one: mission.ended(one) for one in services}
        well = not sick and {*statuses.values(), *folded.values(), audit.status} == {0} and page > MIDDLE
        print(
            f"{killed:8} killed at tick {at:2}, up again: {outcome}; on the page {seen:.1f} s after `up`; "
            f"unhealthy: {', '.join(sick) or 'none'}; audit: {audit.status}; "
            f"`up` when it was over: {', '.join(map(str, folded.values()))}",
            flush=True,
        )
        if not well:
            print("\n".join(f"    {one}: {statuses[one]}, {mission.logs(one)}" for one in services))
            print(audit.out)
        return well
    finally:
        mission.compose("down", "-v", "-t", "0")


def on_a_robot(podman: Podman, folder: Path) -> bool:
    """Run the image as an agent with keys; the world and the peer are processes.

    Print the result, and return true if it is as expected.
    """
    keys, journal, endpoint = folder / "keys", folder / "robot", free_endpoint("tls")
    assert tandem("keys", keys, "--robots", "a,b").status == 0
    journal.mkdir()
    for path in (keys / "agent-a", *(keys / "agent-a").iterdir(), journal):
        os.chown(path, 10001, 10001)
    with ExitStack() as stack:
        with_keys = ("--listen", endpoint, "--keys", keys / "world", "-q")
        world = stack.enter_context(TandemProcess("world", "random", *with_keys))
        peer = ("--connect", endpoint, "--keys", keys / "agent-b", "-q")
        stack.enter_context(TandemProcess("agent", "b", *peer))
        log = podman(
            *("run", "--rm", "--network=host", "--read-only", "--cap-drop=all"),
            *("-v", f"{keys}/agent-a:/keys:ro", "-v", f"{journal}:/journal"),
            *(LEAN, "agent", "a", "--connect", endpoint, "--keys", "/keys", "--out", "/journal", "--fsync"),
        )
        ended = world.ended()
    print(f"the image as a robot's agent, over TLS: {log.splitlines()[-1]}", flush=True)
    return ended.status == 0


@contextmanager
def containers() -> Iterator[tuple[Podman, Path]]:
    """Yield podman and a temporary folder. Raises Unable if containers cannot run."""
    if os.geteuid() != 0:
        raise Unable("not root")
    for command in ("podman", "uv"):
        if shutil.which(command) is None:
            raise Unable(f"no command `{command}`")
    with tempfile.TemporaryDirectory(prefix="tandem-containers-") as folder, ExitStack() as stack:
        yield Podman(Path(folder), stack), Path(folder)


def _checked(command: list[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)


def main(given: Path | None) -> int:
    """Build the images, run every case, and return 0 if all results are as expected."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))  # SIGTERM must clean up, too
    try:
        with containers() as (podman, folder):
            print(f"base: {base(podman, given, folder)}", flush=True)
            try:
                build(podman, folder)
                well = [play(podman, one, folder) for one in ("agent-a", "world", "zenoh")]
                return int(not all([*well, on_a_robot(podman, folder)]))
            except subprocess.CalledProcessError as error:
                print(f"failed: {' '.join(map(str, error.cmd))}\n{error.stderr}", flush=True)
                return 1
    except Unable as why:
        print(f"skipped: {why}")
        return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--base", type=Path, metavar="FILE", help="a root file system with Python, as a tar")
    sys.exit(main(parser.parse_args().base))
