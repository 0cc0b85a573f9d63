"""The speed of exact missions in one process, beside their audit."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.table import Table

from compose.cli.benchmark.bench_table import add_row, new_table
from compose.launch import in_process
from compose.recording import run
from compose.scenario import scenario_file
from compose.sweep.trial_mission import run_in_process
from world.simulation import Simulation

MISSIONS_PER_ROUND = 200
"""The number of random missions per round, in one process."""
FIRST_SEED = 1000
"""The seed of the first of them."""


def missions_per_second(rounds: int, done: Callable[[], None]) -> Table:
    """Measure random missions in one process on one core, the world's share of them, and their audit."""
    scenarios = [scenario_file.load("random", seed=FIRST_SEED + i) for i in range(MISSIONS_PER_ROUND)]
    whole: list[float] = []
    world_part: list[float] = []
    audited: list[float] = []
    ticks = sum(len(in_process.run_mission(one).ticks) for one in scenarios)
    for _ in range(rounds):
        began = time.perf_counter()
        for one in scenarios:
            in_process.run_mission(one)
        whole.append(time.perf_counter() - began)
        world_part.append(sum(_world_s(in_process.run_mission(one)) for one in scenarios))
        began = time.perf_counter()
        for one in scenarios:
            run_in_process(one, audit=True)
        audited.append(time.perf_counter() - began)
        done()
    table = new_table("In-process, one core")
    add_row(
        table,
        f"{MISSIONS_PER_ROUND} random missions (at least 300)",
        [MISSIONS_PER_ROUND / s for s in whole],
        "missions/s",
    )
    add_row(
        table,
        f"one tick ({ticks / MISSIONS_PER_ROUND:.1f} per mission)",
        [1e6 * s / ticks for s in whole],
        "us",
    )
    add_row(table, "of that, the world", [1e6 * s / ticks for s in world_part], "us")
    add_row(table, "the same missions, audited", [MISSIONS_PER_ROUND / s for s in audited], "missions/s")
    add_row(table, "audited / not audited", [plain / s for plain, s in zip(whole, audited, strict=True)], "")
    return table


def _world_s(recording: run.Run) -> float:
    """Return the time (s) that the world takes to run `recording` again with the recorded Commands."""
    began = time.perf_counter()
    simulation = Simulation(recording.scenario)
    for moment in recording.ticks:
        simulation.observations()
        simulation.command(moment.commands)
    return time.perf_counter() - began
