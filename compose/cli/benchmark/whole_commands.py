"""The wall time of whole commands."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.table import Table

from compose.cli.benchmark.bench_table import add_row, new_table
from compose.cli.benchmark.exact_missions import FIRST_SEED

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
BARE_IMPORTS = "import zenoh, numpy, scipy.optimize, msgspec"
"""The program whose run time is the baseline of `tandem run`: the imports of Tandem's dependencies."""


def start_of_a_command(rounds: int, done: Callable[[], None]) -> Table:
    """Measure `tandem run paper-1 -q`; the baseline is a process that only imports the dependencies."""
    command = [sys.executable, "-P", "-m", "compose.cli", "run", "paper-1", "-q"]
    bare = [sys.executable, "-c", BARE_IMPORTS]
    runs: list[float] = []
    imports: list[float] = []
    for _ in range(rounds):
        runs.append(_wall(command))
        imports.append(_wall(bare))
        done()
    table = new_table("Wall time of a whole command")
    add_row(table, "tandem run paper-1 -q", runs, "s")
    add_row(table, f"python -c '{BARE_IMPORTS}'", imports, "s")
    add_row(table, "run / imports (at most 4)", [a / b for a, b in zip(runs, imports, strict=True)], "")
    return table


def _wall(command: Sequence[str]) -> float:
    """Return the wall time (s) of a command.

    Raises CalledProcessError if it fails, and TimeoutError after COMMAND_S.
    """
    began = time.perf_counter()
    _run(command, check=True)
    return time.perf_counter() - began


def _run(command: Sequence[str], *, check: bool) -> None:
    """Run a command without its output, for at most COMMAND_S.

    Raises TimeoutError after that, and with `check` CalledProcessError if the command fails.
    """
    try:
        subprocess.run(command, check=check, stdout=subprocess.DEVNULL, timeout=COMMAND_S)
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"{' '.join(command)} has not ended after {COMMAND_S:g} s") from None


def many_robots(rounds: int, done: Callable[[], None]) -> Table:
    """Measure `tandem run` with ROBOTS robots, as processes and in one, and the CPU time of one robot."""
    many_processes: list[float] = []
    one: list[float] = []
    starts: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        many, some, two = [Path(folder, f"{name}.toml") for name in ("many", "some", "two")]
        many.write_text(_pairs(ROBOTS))
        some.write_text(f"max_ticks = 1\n{_pairs(STARTED)}")
        two.write_text(f"max_ticks = 1\n{_pairs(2)}")
        for _ in range(rounds):
            many_processes.append(_used(["run", str(many), "-q"])[0])
            one.append(_used(["run", str(many), "-q", "--in-process"])[0])
            more_s = _used(["run", str(some), "-q"])[1] - _used(["run", str(two), "-q"])[1]
            starts.append(1e3 * more_s / (STARTED - 2))
            done()
    table = new_table(f"Wall time of a whole command, {ROBOTS} robots")
    add_row(table, "tandem run, as processes (at most 6)", many_processes, "s")
    add_row(table, "the same with --in-process", one, "s")
    add_row(table, "as processes / in-process", [a / b for a, b in zip(many_processes, one, strict=True)], "")
    add_row(table, "CPU of a robot's start, first tick and end", starts, "ms")
    return table


def _pairs(robots: int) -> str:
    """Return a scenario file of so many robots, in which each pair has its own line in the plane."""
    tables = [
        f'[[robot]]\nid = "r{i}"\npeer = "r{i ^ 1}"\nanchor = [{10.0 * (i % 2)}, {40.0 * (i // 2)}]\n'
        for i in range(robots)
    ]
    return f'name = "pairs"\nseed = {FIRST_SEED}\n{MANY_MISSION}' + "".join(tables)


def _used(arguments: Sequence[str]) -> tuple[float, float]:
    """Return the wall time and the CPU time (s) of a `tandem` command with all its processes.

    Raises TimeoutError after COMMAND_S.
    """
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-P", "-m", "compose.cli", *arguments]
    _run(command, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, cpu
