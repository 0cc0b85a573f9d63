"""The speed of noisy missions in one process, beside the same with exact ranges."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from msgspec.structs import replace
from rich.table import Table

from agent.process.robot import Robot
from compose.cli.benchmark.bench_table import add_row, new_table
from compose.cli.benchmark.exact_missions import FIRST_SEED
from compose.launch.planner_loader import planner_of
from compose.scenario import scenario_file
from protocol.messages import RobotConfig
from protocol.noise import Noise
from protocol.orbits import rendezvous, tick_budget
from world.scenario import Scenario
from world.simulation import Simulation

NOISY_SIGMA = 0.1
"""The standard deviation of all ranges in the noisy missions (m)."""
NOISY_MISSIONS = 20
"""The number of random missions with such ranges per round, in one process."""
RANGES = 322
"""The number of ranges of each kind in the measured search."""


def noisy_missions(rounds: int, done: Callable[[], None]) -> Table:
    """Measure random missions with range noise of NOISY_SIGMA in one process on one core, by their parts."""
    noise = Noise(anchor_sigma=NOISY_SIGMA, mutual_sigma=NOISY_SIGMA)
    scenarios = [
        _with_noise(scenario_file.load("random", seed=FIRST_SEED + i), noise) for i in range(NOISY_MISSIONS)
    ]
    exact = [scenario_file.load("random", seed=FIRST_SEED + i) for i in range(NOISY_MISSIONS)]
    parts: list[tuple[float, float, float]] = []
    baseline: list[float] = []
    searches: list[float] = []
    for draw in range(rounds):
        baseline.append(sum(_parts(exact)))
        parts.append(_parts(scenarios))
        searches.append(_search_s(draw))
        done()
    table = new_table(f"In-process, one core, ranges of sigma {NOISY_SIGMA:g} m")
    scale = 1e3 / NOISY_MISSIONS
    add_row(table, "one mission, both robots (at most 150)", [scale * sum(part) for part in parts], "ms")
    for k, what in enumerate(
        ("observations (phases 1 and 2)", "decisions in contact (phase 3)", "the world")
    ):
        add_row(table, f"of that, {what}", [scale * part[k] for part in parts], "ms")
    ratios = [sum(part) / s for part, s in zip(parts, baseline, strict=True)]
    add_row(table, "the same with exact ranges (baseline)", [scale * s for s in baseline], "ms")
    add_row(table, "noisy / exact", ratios, "")
    add_row(table, f"a search over {3 * RANGES} ranges (at most 200)", [1e3 * s for s in searches], "ms")
    return table


def _search_s(draw: int) -> float:
    """Return the time (s) of a search with RANGES ranges of each kind, between robots that circle.

    Ranges that were searched before are not searched again, so each `draw` has others.
    """
    import numpy as np  # noqa: PLC0415  # the command line starts without it

    from agent.estimation.gaussian.hypotheses import search  # noqa: PLC0415  # likewise
    from agent.estimation.gaussian.odometry_noise import track  # noqa: PLC0415  # likewise
    from agent.estimation.gaussian.range_model import PairRanges, Ranges, predict  # noqa: PLC0415  # likewise

    noise = Noise(anchor_sigma=NOISY_SIGMA, mutual_sigma=NOISY_SIGMA)
    every, ticks = [(tick, 0.0) for tick in range(RANGES)], np.arange(RANGES - 1)
    paths = [track(np.full(RANGES - 1, 0.5), turn + 0.2 * np.sin(ticks), 1.0) for turn in (0.5, -0.35)]
    ranges = Ranges.of_lists(every, every, every, noise)
    apart, none = (1.5, 0.0), np.empty(0, np.intp)
    true = predict(np.array((0.4, 0.9, 0.3, -0.2, 1.0, -0.8)), paths, ranges, apart).distance
    errors = NOISY_SIGMA * np.random.default_rng(draw).normal(size=3 * RANGES)
    pair = PairRanges(
        (paths[0], paths[1]), ranges._replace(rho=true + errors), (none, none, none), apart, 10.0, noise
    )
    began = time.perf_counter()
    search(pair)
    return time.perf_counter() - began


def _with_noise(exact: Scenario, noise: Noise) -> Scenario:
    """Return `exact` with `noise`, and with the orbits and the tick budget that follow from it."""
    mission = replace(exact.mission, noise=noise)
    first, second = (robot.anchor for robot in exact.robots)
    plan = rendezvous(mission, math.dist((first.x, first.y), (second.x, second.y)), exact.planner_name)
    robots = tuple([replace(robot, rendezvous=plan) for robot in exact.robots])
    return replace(exact, mission=mission, robots=robots, max_ticks=tick_budget(mission, plan))


def _parts(scenarios: Sequence[Scenario]) -> tuple[float, float, float]:
    """Return the time (s) of the robots' observations, of their decisions, and of the world."""
    sensing = deciding = world = 0.0
    for one in scenarios:
        simulation = Simulation(one)
        robots = {robot.id: _robot(one.config(robot.id)) for robot in one.robots}
        end = None
        while end is None:
            began = time.perf_counter()
            observations = simulation.observations()
            sensed = time.perf_counter()
            own_reports = {
                observation.robot: robots[observation.robot].observation(observation)
                for observation in observations
            }
            observed = time.perf_counter()
            commands = {}
            for observation in observations:
                commands[observation.robot] = robots[observation.robot].decide(
                    [
                        own_reports[contact.peer][observation.robot]
                        for contact in observation.contacts
                        for _ in contact.heard or ()
                    ]
                )
            decided = time.perf_counter()
            end = simulation.command(commands)
            world += sensed - began + time.perf_counter() - decided
            sensing += observed - sensed
            deciding += decided - observed
    return sensing, deciding, world


def _robot(config: RobotConfig) -> Robot:
    return Robot(config, planner_of(config))
