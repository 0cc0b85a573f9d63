"""The speed of groups in one process, beside random pairs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from statistics import median

from rich.table import Table

from compose.cli.benchmark.bench_table import add_row, new_table
from compose.cli.benchmark.exact_missions import FIRST_SEED
from compose.launch import in_process
from compose.scenario import scenario_file
from world.scenario import Scenario

SIZES = (8, 32)
"""The numbers of robots of the groups."""
GROUPS = 4
"""The number of random groups of each size per round."""


def missions_of_groups(rounds: int, done: Callable[[], None]) -> Table:
    """Measure the time of a tick of groups of two sizes, and how it grows; the baseline are random pairs."""
    groups = [[_group(robots, FIRST_SEED + i) for i in range(GROUPS)] for robots in SIZES]
    pairs = [scenario_file.load("random", seed=FIRST_SEED + i) for i in range(GROUPS * SIZES[0])]
    of_pairs: list[float] = []
    of_groups: list[list[float]] = [[] for _ in SIZES]
    for _ in range(rounds):
        of_pairs.append(_tick_s(pairs))
        for values, some in zip(of_groups, groups, strict=True):
            values.append(_tick_s(some))
        done()
    table = new_table("In-process, one core, groups")
    add_row(table, "one tick of a random pair (baseline)", [1e6 * s for s in of_pairs], "us")
    for robots, values in zip(SIZES, of_groups, strict=True):
        add_row(table, f"one tick of a random group of {robots}", [1e6 * s for s in values], "us")
    per_robot = [2.0 * s / SIZES[0] / pair for s, pair in zip(of_groups[0], of_pairs, strict=True)]
    add_row(table, f"a robot of {SIZES[0]} / a robot of a pair", per_robot, "")
    growth = [
        math.log(more / fewer) / math.log(SIZES[1] / SIZES[0]) for fewer, more in zip(*of_groups, strict=True)
    ]
    add_row(table, "growth, as a power of n (at most 1.5)", growth, "")
    return table


def _group(robots: int, seed: int) -> Scenario:
    """Return a random group of so many robots."""
    table = scenario_file.scenario_table("random-group")
    table["group"]["robots"] = robots
    return scenario_file.validate(table, "random-group").seeded(seed)


def _tick_s(scenarios: list[Scenario]) -> float:
    """Return the time (s) of a tick, the median over `scenarios`."""
    found = []
    for one in scenarios:
        began = time.perf_counter()
        ticks = len(in_process.run_mission(one).ticks)
        found.append((time.perf_counter() - began) / ticks)
    return median(found)
