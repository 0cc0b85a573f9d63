"""The environment that the last bits of a computation depend on: library versions and the processor.

A planner computes bit-identical results only in the same environment. The C library and numpy choose
instructions by processor, and other versions of them or of the linear algebra library round differently.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from protocol import PACKAGE
from protocol.messages import Environment

LONGEST_VERSION = 64
"""The maximum number of characters of a version."""
X86_LEVELS = (
    ("x86-64-v4", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    ("x86-64-v3", {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"}),
    ("x86-64-v2", {"sse4_1", "sse4_2", "ssse3", "popcnt"}),
)
"""The microarchitecture levels of x86-64, highest first, with the features that each adds to the next."""


@cache
def of_world() -> Environment:
    """Return the environment of a world's journal: its numbers depend only on the C library's functions."""
    return Environment(_version(), _c_library(), _instructions())


@cache
def of_robot() -> Environment:
    """Return the environment of an agent's journal, with numpy and its linear algebra library."""
    import numpy as np  # noqa: PLC0415  # a world does not import it

    built: Mapping[str, Any] = np.show_config(mode="dicts") or {}
    used = built.get("SIMD Extensions", {}).get("found") or ["baseline"]
    return Environment(
        _version(),
        _c_library(),
        _instructions(),
        f"{np.__version__} ({used[-1]})"[:LONGEST_VERSION],
        (_kernels(Path(np.__file__).parent.parent / "numpy.libs") or _library(built))[:LONGEST_VERSION],
    )


def otherwise(recorded: Environment, here: Environment) -> str | None:
    """Return how the two environments differ, in a line; None if they are equal."""
    fields = [name for name in here.__struct_fields__ if getattr(recorded, name) != getattr(here, name)]
    if not fields:
        return None
    there, now = (
        ", ".join([f"{name.replace('_', ' ')} {getattr(one, name)}" for name in fields])
        for one in (recorded, here)
    )
    return f"recorded with {there}; here is {now}"


def _version() -> str:
    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        return "not installed"


def _c_library() -> str:
    """Return the name and version, such as "glibc 2.36"."""
    try:
        return os.confstr("CS_GNU_LIBC_VERSION") or _system()
    except (AttributeError, OSError, ValueError):
        return _system()


def _system() -> str:
    return f"{platform.system()} {platform.release()}"[:LONGEST_VERSION]


def _instructions() -> str:
    """Return the instruction set of the processor, such as "x86-64-v3"."""
    try:
        with Path("/proc/cpuinfo").open(encoding="ascii", errors="replace") as file:
            flags = next((set(line.split()) for line in file if line.startswith("flags")), set[str]())
    except OSError:
        flags = set()
    below = set[str]()
    for i, (name, _) in enumerate(X86_LEVELS):
        below = set.union(*[wanted for _, wanted in X86_LEVELS[i:]])
        if below <= flags:
            return name
    return platform.machine()[:LONGEST_VERSION]


def _kernels(folder: Path) -> str | None:
    """Return numpy's bundled library and its kernels, such as "OpenBLAS 0.3.31 (Haswell)", or None."""
    import ctypes  # noqa: PLC0415  # a world does not import it

    for file in folder.glob("libscipy_openblas*"):
        for ending in ("64_", ""):
            try:
                get_config = getattr(ctypes.CDLL(str(file)), f"scipy_openblas_get_config{ending}")
            except (OSError, AttributeError):
                continue
            get_config.restype = ctypes.c_char_p
            words = get_config().decode(errors="replace").split()
            core = [word for word in words[2:] if not word.isupper() and "=" not in word]
            return f"{' '.join(words[:2])} ({' '.join(core) or 'one kernel'})"
    return None


def _library(built: Mapping[str, Any]) -> str:
    """Return the linear algebra library that numpy was built with, such as "lapack 3.12.0"."""
    library = built.get("Build Dependencies", {}).get("lapack", {})
    return f"{library.get('name', 'unknown')} {library.get('version', '')}".strip()
