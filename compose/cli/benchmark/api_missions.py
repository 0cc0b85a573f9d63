"""The speed of missions through the Python API, beside the engine that runs them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from rich.table import Table

from compose.cli.benchmark.bench_table import add_row, new_table
from compose.cli.benchmark.exact_missions import FIRST_SEED
from compose.launch import in_process

API = "tandem"
"""The package that is measured. It is found by its name, because it is above this one."""
MISSIONS_PER_SCENARIO = {"random": 50, "noisy": 5}
"""The scenarios, with the number of missions per round: more than the robots' caches of searches hold."""


def missions_by_api(rounds: int, done: Callable[[], None]) -> Table:
    """Measure `tandem.run(scenario, seed=...)`, journals included; the baseline is the engine without them.

    Processor times are compared: this process does nothing else.
    """
    api = import_module(API)
    scenarios = {name: api.Scenario.load(name) for name in MISSIONS_PER_SCENARIO}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in MISSIONS_PER_SCENARIO}
    for draw in range(-1, rounds):
        for name, scenario in scenarios.items():
            seeds = range(
                FIRST_SEED + draw * MISSIONS_PER_SCENARIO[name],
                FIRST_SEED + (draw + 1) * MISSIONS_PER_SCENARIO[name],
            )
            if draw < 0:  # imports and warms up
                _by_engine(scenario, seeds[:1]), _by_api(api, scenario, seeds[:1])
            else:
                found[name].append((_by_engine(scenario, seeds), _by_api(api, scenario, seeds)))
        if draw >= 0:
            done()
    table = new_table("In-process, one core, through the Python API")
    for name, pairs in found.items():
        limit = " (at most 1.6)" if name == "random" else ""
        add_row(table, f"one mission {name}, the engine (baseline)", [1e3 * one for one, _ in pairs], "ms")
        add_row(table, "the same, tandem.run", [1e3 * other for _, other in pairs], "ms")
        add_row(table, f"tandem.run / engine{limit}", [other / one for one, other in pairs], "")
    return table


def _by_engine(scenario: Any, seeds: Sequence[int]) -> float:
    """Return the processor time in s of a mission without journals, the mean over `seeds`."""
    missions = [scenario.template.seeded(seed) for seed in seeds]
    began = time.process_time()
    for mission in missions:
        in_process.run_mission(mission)
    return (time.process_time() - began) / len(seeds)


def _by_api(api: Any, scenario: Any, seeds: Sequence[int]) -> float:
    """Return the processor time in s of a mission as a user of the API runs it, the mean over `seeds`."""
    began = time.process_time()
    for seed in seeds:
        api.run(scenario, seed=seed)
    return (time.process_time() - began) / len(seeds)
