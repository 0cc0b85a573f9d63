"""Teams without anchors in numbers: `uv run python -m tests.relative_teams [TEAMS]` prints two tables.

TEAMS (100 by default) of 2, 3 and 4 robots start at random in a square of 10 m, connected by ranges of at
most 5 m, and a fifth as many of 8. The first table has their claims, beside the Cramér-Rao bound for the same
measurements. The second one has their ticks, paired with those of the same robots that drive at random.
"""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Callable, Sequence
from functools import partial
from statistics import fmean, median, stdev
from typing import NamedTuple
from unittest import mock

import numpy as np
from msgspec.structs import replace

from agent.estimation.fit import AS_IT_IS, Start, fits
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.planning import team_tasks
from agent.planning.drive import towards
from agent.planning.team_state import TeamState
from compose.launch.in_process import run_mission
from compose.recording.run import Run
from compose.scenario.scenario_file import parse
from protocol.messages import Localised, Undecided
from protocol.motion import REST, Controls
from tests.plans import table

SIZES = (2, 3, 4, 8)
SIGMAS = (0.0, 0.05)
MOST_TICKS = 400
"""The ticks of a mission, and those that count for one that has not ended."""

Task = Callable[[TeamState], TeamState]


class Result(NamedTuple):
    """The claims of a mission. The first robot is left out: its pose follows from its odometry."""

    outcome: str
    ticks: int
    errors: list[float]
    """The errors of the positions in m."""
    nees: list[float]
    bounds: list[float]
    """The Cramér-Rao bounds of the positions in m; without sigma, none."""


def scenario_of(robots: int, sigma: float, seed: int) -> str:
    """Return the file of a mission."""
    return f"""
        name = "relative"
        seed = {seed}
        max_ticks = {MOST_TICKS}
        [mission]
        sensing_range = 5.0
        period = 1.0
        max_speed = 0.5
        max_turn_rate = 1.0
        accuracy = 0.2
        frame = "relative"
        area = [0.0, 0.0, 10.0, 10.0]
        noise = {{anchor_sigma = {sigma}, mutual_sigma = {sigma}}}
        """ + "".join([f'\n[[robot]]\nid = "r{i}"\n' for i in range(robots)])


def at_random(seed: int, state: TeamState) -> TeamState:
    """Return `state` with v and omega drawn uniformly; at R from its start, a robot turns back there."""
    mission, here = state.config.mission, state.odometry
    if isinstance(state.verdict, Undecided) or (state.verdict is not None and not state.waiting):
        return state.doing_next("localised", 3, REST)
    if math.hypot(here.x, here.y) >= mission.sensing_range:
        return state.doing_next(
            "homing", 1, towards((0.0, 0.0), here, mission, team_tasks.ARRIVED, backward=True)
        )
    draw = random.Random(f"{seed}/{state.config.robot}/{state.tick}").uniform
    turn = draw(-mission.max_turn_rate, mission.max_turn_rate)
    return state.doing_next("circling", 1, Controls(draw(0.0, mission.max_speed), turn))


def result_of(robots: int, sigma: float, seed: int, task: Task) -> Result:
    """Return the result of a mission whose robots choose what to do by `task`."""
    measured = dict[str, JointMeasurements]()

    def chosen(state: TeamState) -> TeamState:
        if isinstance(state.verdict, Localised) and state.following.part is not None:
            measured.setdefault(state.config.robot, state.following.part)
        return task(state)

    with mock.patch("agent.planning.team.next_task", chosen):
        run = run_mission(parse(scenario_of(robots, sigma, seed), "relative"))
    assert run.end is not None
    others = run.robots[1:]
    claims = [claim for robot in others if (claim := run.claim(robot)) is not None]
    return Result(
        run.end.outcome,
        run.length - 1,
        [one.position_error for one in claims],
        [one.nees for one in claims if one.nees is not None],
        [bound(run, robot, measured[robot]) for robot in others if robot in measured] if sigma else [],
    )


def bound(run: Run, robot: str, measured: JointMeasurements) -> float:
    """Return the Cramér-Rao bound (m) of a robot's position by what it has measured, at the true poses."""
    paths = np.array([[(one.x, one.y, one.heading) for one in run.truth(name)] for name in measured.robots])
    ranges, place = measured.ranges, measured.robots.index(robot)
    apart = paths[ranges.first, ranges.tick, :2] - paths[ranges.second, ranges.tick, :2]
    exact = replace(measured, ranges=replace(ranges, rho=np.hypot(*apart.T)))
    (fit,) = fits(exact, [Start(paths[:, 0])], AS_IT_IS)
    own = fit.linear.step.ends[3 * place : 3 * place + 2, 3 * place : 3 * place + 2]
    return math.sqrt(np.trace(own))


def rms(values: Sequence[float]) -> float:
    """Return the root mean square of `values`."""
    return math.sqrt(fmean([one * one for one in values]))


def row_of_claims(robots: int, sigma: float, found: Sequence[Result]) -> list[str]:
    """Return the row of the first table."""
    errors = [each for one in found for each in one.errors]
    nees = [each for one in found for each in one.nees]
    bounds = [each for one in found for each in one.bounds]
    ticks = [one.ticks for one in found if one.outcome == "localised"]
    return [
        *(str(robots), f"{sigma:g}", str(len(found))),
        *[str(sum(one.outcome == name for one in found)) for name in ("localised", "wrong")],
        f"{median(ticks):.0f} / {max(ticks)}" if ticks else "",
        f"{rms(errors):.2g} / {max(errors):.2g}" if errors else "",
        f"{fmean(nees):.2f}" if nees else "",
        f"{rms(errors) / rms(bounds):.2f}" if bounds else "",
    ]


def row_of_ticks(robots: int, sigma: float, pairs: Sequence[tuple[Result, Result]]) -> list[str]:
    """Return the row of the second table: planned and random motion."""
    counted = [
        [one.ticks if one.outcome == "localised" else MOST_TICKS for one in each]
        for each in zip(*pairs, strict=True)
    ]
    logs = [math.log(planned / drawn) for planned, drawn in zip(*counted, strict=True)]
    spread = 1.96 * stdev(logs) / math.sqrt(len(logs))
    low, ratio, high = [math.exp(fmean(logs) + side * spread) for side in (-1, 0, 1)]
    ended = [sum(one.outcome == "localised" for one in each) for each in zip(*pairs, strict=True)]
    return [
        *(str(robots), f"{sigma:g}", str(len(pairs)), *map(str, ended)),
        *[f"{median(each):.0f} / {fmean(each):.1f}" for each in counted],
        f"{fmean(counted[0]) / fmean(counted[1]):.2f}",
        f"{ratio:.2f} ({low:.2f} to {high:.2f})",
    ]


def main(teams: int) -> None:
    """Print both tables."""
    claims, ticks = [], []
    for robots in SIZES:
        for sigma in SIGMAS:
            seeds = range(1, 1 + max(teams if robots < 8 else teams // 5, 2))
            planned = [result_of(robots, sigma, seed, team_tasks.next_task) for seed in seeds]
            drawn = [result_of(robots, sigma, seed, partial(at_random, seed)) for seed in seeds]
            claims.append(row_of_claims(robots, sigma, planned))
            ticks.append(row_of_ticks(robots, sigma, list(zip(planned, drawn, strict=True))))
            print(claims[-1], ticks[-1], file=sys.stderr, flush=True)
    head = [
        *("robots", "sigma, m", "missions", "localised", "wrong", "ticks, median / most"),
        *("error in m, RMS / largest", "NEES (3)", "RMS error over Cramér-Rao"),
    ]
    print(table(head, claims), end="\n\n")
    head = [
        *("robots", "sigma, m", "pairs", "localised", "at random", "ticks, median / mean", "at random"),
        *("ratio of means", "mean ratio (95 %)"),
    ]
    print(table(head, ticks))


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 100)
