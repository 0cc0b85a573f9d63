"""Podman for measurements, with its own storage and networks, and a container runtime that works here."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

HOUSE = Path(__file__).parents[1]
DEPLOY = HOUSE / "compose" / "hardware" / "deploy"
RUNTIMES: tuple[dict[str, str], ...] = (
    {},
    {"runtime": "crun", "cgroup_manager": "cgroupfs"},
    {"runtime": "runc", "cgroup_manager": "cgroupfs"},
)
"""The runtimes to try, in order: podman's default, then some for systems without systemd or new cgroups."""


class Unable(Exception):
    """Containers cannot run here. The text gives the reason."""


class Podman:
    """The command podman, with separate storage and networks that are removed at the end."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder = folder
        self._environment = os.environ | {
            "CONTAINERS_STORAGE_CONF": str(folder / "storage.conf"),
            "CONTAINERS_CONF": str(folder / "containers.conf"),
        }
        (folder / "storage.conf").write_text(
            f'[storage]\ndriver = "overlay"\ngraphroot = "{folder}/graph"\nrunroot = "{folder}/run"\n'
        )
        stack.callback(self._leave)

    def load(self, base: Path, image: str) -> None:
        """Import the base image, and select a runtime that starts containers. Raises Unable without one."""
        for engine in RUNTIMES:
            self._configure(engine)
            self("import", base, image)
            with_what = " ".join(engine.values()) or "its defaults"
            try:
                self("run", "--rm", "--network=none", image, "true")
            except subprocess.CalledProcessError as error:
                print(f"podman with {with_what}: {error.stderr.strip().splitlines()[-1]}", flush=True)
                continue
            print(f"{self('--version')}, with {with_what}", flush=True)
            return
        raise Unable("podman starts no container here")

    def _configure(self, engine: dict[str, str]) -> None:
        settings = "".join(f'{name} = "{value}"\n' for name, value in engine.items())
        (self._folder / "networks").mkdir(exist_ok=True)
        (self._folder / "containers.conf").write_text(
            '[containers]\ndefault_ulimits = ["nofile=1024:1024", "nproc=1024:1024"]\n'
            f'[network]\nnetwork_backend = "netavark"\nnetwork_config_dir = "{self._folder}/networks"\n'
            f'[engine]\ntmp_dir = "{self._folder}/tmp"\n{settings}'
        )

    def __call__(self, *arguments: str | Path, check: bool = True) -> str:
        """Run podman, and return its standard output. Raises CalledProcessError."""
        return self._run(["podman", *map(str, arguments)], check)

    def compose(self, *arguments: str, **environment: str) -> None:
        """Run podman-compose with the project's compose file. Raises CalledProcessError."""
        command = [sys.executable, "-m", "podman_compose", "-f", str(DEPLOY / "compose.yaml"), *arguments]
        self._run(command, check=True, environment=environment)

    def _run(self, command: list[str], check: bool, environment: dict[str, str] | None = None) -> str:
        done = subprocess.run(
            command,
            check=False,
            capture_output=True,
            text=True,
            env=self._environment | (environment or {}),
            timeout=900.0,
        )
        if check and done.returncode:
            raise subprocess.CalledProcessError(done.returncode, command, done.stdout, done.stderr)
        return done.stdout.strip()

    def _leave(self) -> None:
        self("rm", "--force", "--all", "--time", "0", check=False)
        self("network", "prune", "--force", check=False)
        self("umount", "--all", "--force", check=False)
        subprocess.run(["umount", self._folder / "graph" / "overlay"], check=False, capture_output=True)
