"""The speed of missions in one process on one core: exact, noisy, in groups, and through the Python API."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import cache
from statistics import median
from typing import Any

import tandem
from agent.process.robot import Robot
from compose.launch import in_process
from compose.launch.planner_loader import planner_of
from compose.recording.run import Run
from compose.scenario import scenario_file
from compose.sweep.trial_mission import run_in_process
from world.scenario import Scenario
from world.simulation import Simulation

FIRST_SEED = 1000
"""The seed of the first of all random missions."""
SIGMA = 0.1
"""The standard deviation of all ranges in the noisy missions (m)."""
GROUP_SIZES = (8, 32)
"""The numbers of robots of the groups."""
BY_API = {"random": 50, "noisy": 5}
"""The scenarios of the API, with their missions per round: more than the robots' caches of searches hold."""


@cache
def random_missions(count: int, sigma: float = 0.0) -> list[Scenario]:
    """Return the first `count` random missions, with ranges of `sigma` m."""
    table = scenario_file.scenario_table("random")
    table["mission"]["noise"] = {"anchor_sigma": sigma, "mutual_sigma": sigma}
    template = scenario_file.validate(table, "random")
    return [template.seeded(FIRST_SEED + i) for i in range(count)]


def seconds(work: Callable[[Any], object], over: Sequence[Any]) -> float:
    """Return the processor time in s that `work` takes for all values of `over`."""
    began = time.process_time()
    for value in over:
        work(value)
    return time.process_time() - began


def exact_missions(_: int) -> dict[str, float]:
    """Measure 200 random missions, the world's share of them, and their audit."""
    missions = random_missions(200)
    whole_s = seconds(in_process.run_mission, missions)
    recordings = [in_process.run_mission(mission) for mission in missions]
    world_s = seconds(_play_world, recordings)
    audited_s = seconds(lambda mission: run_in_process(mission, audit=True), missions)
    ticks = sum(len(recording.ticks) for recording in recordings)
    return {
        "random missions (at least 300), missions/s": len(missions) / whole_s,
        f"one tick ({ticks / len(missions):.1f} per mission), us": 1e6 * whole_s / ticks,
        "of that, the world, us": 1e6 * world_s / ticks,
        "audited / not audited": whole_s / audited_s,
    }


def _play_world(recording: Run) -> None:
    """Run the world of `recording` again with the recorded Commands."""
    simulation = Simulation(recording.scenario)
    for moment in recording.ticks:
        simulation.observations()
        simulation.command(moment.commands)


def missions_by_api(number: int) -> dict[str, float]:
    """Measure `tandem.run(scenario, seed=...)` with journals; the baseline is the engine without them."""
    values = {}
    for name, count in BY_API.items():
        scenario = tandem.Scenario.load(name)
        tandem.run(scenario, seed=FIRST_SEED)  # imports and warms up
        seeds = range(FIRST_SEED + 1 + number * count, FIRST_SEED + 1 + (number + 1) * count)
        engine_s = seconds(in_process.run_mission, [scenario.template.seeded(seed) for seed in seeds])
        api_s = seconds(lambda seed: tandem.run(scenario, seed=seed), seeds)  # noqa: B023  # called at once
        values[f"one mission {name}, the engine (baseline), ms"] = 1e3 * engine_s / count
        limit = " (at most 1.6)" if name == "random" else ""
        values[f"tandem.run / engine{limit}, {name}"] = api_s / engine_s
    return values


def noisy_missions(_: int) -> dict[str, float]:
    """Measure random missions with ranges of SIGMA by their parts."""
    exact, noisy = _parts(random_missions(20)), _parts(random_missions(20, SIGMA))
    return {
        "one mission, both robots (at most 150), ms": 50.0 * sum(noisy),
        "of that, observations (phases 1 and 2), ms": 50.0 * noisy[0],
        "of that, decisions in contact (phase 3), ms": 50.0 * noisy[1],
        "of that, the world, ms": 50.0 * noisy[2],
        "noisy / exact": sum(noisy) / sum(exact),
    }


def _parts(scenarios: Sequence[Scenario]) -> tuple[float, float, float]:
    """Return the time (s) of the robots' observations, of their decisions, and of the world."""
    sensing = deciding = world = 0.0
    for scenario in scenarios:
        simulation = Simulation(scenario)
        configs = [scenario.config(robot.id) for robot in scenario.robots]
        robots = {config.robot: Robot(config, planner_of(config)) for config in configs}
        end = None
        while end is None:
            began = time.process_time()
            observations = simulation.observations()
            sensed = time.process_time()
            reports = {seen.robot: robots[seen.robot].observation(seen) for seen in observations}
            observed = time.process_time()
            commands = {
                seen.robot: robots[seen.robot].decide(
                    [
                        reports[contact.peer][seen.robot]
                        for contact in seen.contacts
                        for _ in contact.heard or ()
                    ]
                )
                for seen in observations
            }
            decided = time.process_time()
            end = simulation.command(commands)
            world += sensed - began + time.process_time() - decided
            sensing += observed - sensed
            deciding += decided - observed
    return sensing, deciding, world


def groups(_: int) -> dict[str, float]:
    """Measure the time of a tick of groups of two sizes, and how it grows; the baseline are random pairs."""
    pair_s = _tick_s(random_missions(4 * GROUP_SIZES[0]))
    fewer_s, more_s = (_tick_s([_group(robots, FIRST_SEED + i) for i in range(4)]) for robots in GROUP_SIZES)
    fewer, more = GROUP_SIZES
    return {
        "one tick of a random pair (baseline), us": 1e6 * pair_s,
        f"one tick of a random group of {fewer}, us": 1e6 * fewer_s,
        f"one tick of a random group of {more}, us": 1e6 * more_s,
        f"a robot of {fewer} / a robot of a pair": 2.0 * fewer_s / fewer / pair_s,
        "growth, as a power of n (at most 1.5)": math.log(more_s / fewer_s) / math.log(more / fewer),
    }


@cache
def _group(robots: int, seed: int) -> Scenario:
    """Return a random group of so many robots."""
    table = scenario_file.scenario_table("random-group")
    table["group"]["robots"] = robots
    return scenario_file.validate(table, "random-group").seeded(seed)


def _tick_s(scenarios: Sequence[Scenario]) -> float:
    """Return the time (s) of a tick, the median over `scenarios`."""
    times = []
    for scenario in scenarios:
        began = time.process_time()
        ticks = len(in_process.run_mission(scenario).ticks)
        times.append((time.process_time() - began) / ticks)
    return median(times)
