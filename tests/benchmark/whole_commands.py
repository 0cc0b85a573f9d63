"""The wall time of whole commands."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.benchmark.in_process import FIRST_SEED

ROBOTS = 200
"""The number of robots in the scenario of many pairs."""
STARTED = 20
"""The number of robots from whose start and end the CPU time of one robot is computed."""
MANY_MISSION = """
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.141592653589793
"""
"""The mission of section IV of the paper, as TOML."""
COMMAND_S = 300.0
"""The maximum wall time of a whole command (s). The longest takes some seconds on a quiet machine."""
TANDEM = (sys.executable, "-P", "-m", "compose.cli")
BARE_IMPORTS = "import zenoh, numpy, scipy.optimize, msgspec"
"""The program whose run time is the baseline of `tandem run`: the imports of Tandem's dependencies."""


def start_of_a_command(_: int) -> dict[str, float]:
    """Measure `tandem run paper-1 -q`; the baseline is a process that only imports the dependencies."""
    run_s, _cpu_s = _used([*TANDEM, "run", "paper-1", "-q"])
    imports_s, _cpu_s = _used([sys.executable, "-c", BARE_IMPORTS])
    return {
        "tandem run paper-1 -q, s": run_s,
        f"python -c '{BARE_IMPORTS}', s": imports_s,
        "run / imports (at most 4)": run_s / imports_s,
    }


def many_robots(_: int) -> dict[str, float]:
    """Measure `tandem run` with ROBOTS robots, as processes and in one, and the CPU time of one robot."""
    with tempfile.TemporaryDirectory() as folder:
        many, some, two = [Path(folder, f"{name}.toml") for name in ("many", "some", "two")]
        many.write_text(_pairs(ROBOTS))
        some.write_text(f"max_ticks = 1\n{_pairs(STARTED)}")
        two.write_text(f"max_ticks = 1\n{_pairs(2)}")
        processes_s, _cpu_s = _used([*TANDEM, "run", str(many), "-q"], (0, 1))
        one_s, _cpu_s = _used([*TANDEM, "run", str(many), "-q", "--in-process"], (0, 1))
        some_cpu_s, two_cpu_s = (_used([*TANDEM, "run", str(file), "-q"], (0, 1))[1] for file in (some, two))
    return {
        "tandem run, as processes (at most 6), s": processes_s,
        "the same with --in-process, s": one_s,
        "as processes / in-process": processes_s / one_s,
        "CPU of a robot's start, first tick and end, ms": 1e3 * (some_cpu_s - two_cpu_s) / (STARTED - 2),
    }


def _pairs(robots: int) -> str:
    """Return a scenario file of so many robots, in which each pair has its own line in the plane."""
    tables = [
        f'[[robot]]\nid = "r{i}"\npeer = "r{i ^ 1}"\nanchor = [{10.0 * (i % 2)}, {40.0 * (i // 2)}]\n'
        for i in range(robots)
    ]
    return f'name = "pairs"\nseed = {FIRST_SEED}\n{MANY_MISSION}' + "".join(tables)


def _used(command: Sequence[str], statuses: Sequence[int] = (0,)) -> tuple[float, float]:
    """Return the wall time and the CPU time (s) of a command with all its processes.

    Raises TimeoutExpired after COMMAND_S, and RuntimeError if the exit status is none of `statuses`.
    """
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    status = subprocess.run(command, check=False, stdout=subprocess.DEVNULL, timeout=COMMAND_S).returncode
    wall_s, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if status not in statuses:
        raise RuntimeError(f"{' '.join(command)} ended with exit status {status}")
    return wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
