"""The build hook that compiles the library of the estimator when Tandem is installed.

It uses the C compiler of the machine, which `CC` or `cc` names; where there is none, that of the PyPI package
`ziglang`. An editable installation, as in a clone, finds the library beside its source.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = tuple([f"agent/estimation/{name}.c" for name in ("smoother", "elementary", "hypotheses")])
LIBRARY = "agent/estimation/libsmoother.so"
FLAGS = ("-O3", "-ffp-contract=off", "-fPIC", "-shared")
"""The options: without contraction and fast math, results follow from the source and the C library alone."""
COMPILER_PACKAGE = "ziglang>=0.13,<1"


def machine_compiler() -> list[str]:
    """Return the command of the machine's C compiler; empty if there is none."""
    command = os.environ.get("CC", "cc").split()
    return command if command and shutil.which(command[0]) else []


class KernelHook(BuildHookInterface):  # type: ignore[misc]  # hatchling has no types
    """Compiles the kernel for a wheel, which is tagged for its platform."""

    def dependencies(self) -> list[str]:
        """Return the package that brings a compiler, where the machine has none."""
        return [] if self.target_name != "wheel" or machine_compiler() else [COMPILER_PACKAGE]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the kernel; a source distribution contains its source alone."""
        if self.target_name != "wheel":
            return
        sources, library = [Path(self.root) / one for one in SOURCES], Path(self.root) / LIBRARY
        if version != "editable":
            self._folder = TemporaryDirectory()  # the sources may be read-only, or a clone that is in use
            library = Path(self._folder.name) / library.name
            build_data["force_include"][str(library)] = LIBRARY
        # By default, ziglang compiles for the processor of this machine; a wheel is for others, too.
        compiler = machine_compiler() or [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]
        digest = hashlib.sha256(b"".join([one.read_bytes() for one in sources])).hexdigest()
        part = library.with_name(f"{library.name}.{os.getpid()}")  # a process may have loaded the old one
        command = [*compiler, *FLAGS, f'-DSOURCE="{digest}"', "-o", str(part), *map(str, sources), "-lm"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode:
            files = " and ".join(SOURCES)
            what = f"{files} do not compile; set CC to a compiler that works, or to nothing for ziglang's"
            raise SystemExit(f"{what}: {' '.join(command)}\n{ended.stderr}")
        part.replace(library)
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
