"""Teams without anchors: `uv run python -m tests.relative_teams [TEAMS]` prints the table of docs/results.md.

TEAMS (100 by default) of 2, 3 and 4 robots start at random in a square of 10 m, connected by ranges of at
most 5 m; a fifth as many of 8, and a twentieth of 16. Their ticks are paired with those of the same robots
that drive at random, and their claims are beside the Cramér-Rao bound for the same measurements.
"""

from __future__ import annotations

import math
import random
import sys
from collections import Counter
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
from protocol.noise import UNTOLD
from tests.plans import table

SIZES = {2: 1, 3: 1, 4: 1, 8: 5, 16: 20}
"""The numbers of robots, and the number of teams of 2 for one of them."""
SIGMA = 0.05
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


def drawn_errors(seed: int) -> str:
    """Return the tables of a world whose errors are drawn from the priors of those that nobody has told."""
    draw = random.Random(f"drawn{seed}").gauss
    return f"""
        [world.noise]
        mutual_bias = {draw(0.0, UNTOLD.range_bias)}
        mutual_scale = {draw(0.0, UNTOLD.range_scale)}
        radio_bias_sigma = {UNTOLD.pair_bias / math.sqrt(2.0)}
        [world.noise.odometry]
        scale_sigma = {UNTOLD.wheel_scale}
        gyro_bias_sigma = {UNTOLD.gyro_bias}
        """


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
        return state.doing_next("localised", REST)
    if math.hypot(here.x, here.y) >= mission.sensing_range:
        return state.doing_next(
            "homing", towards((0.0, 0.0), here, mission, team_tasks.ARRIVED, backward=True)
        )
    draw = random.Random(f"{seed}/{state.config.robot}/{state.tick}").uniform
    turn = draw(-mission.max_turn_rate, mission.max_turn_rate)
    return state.doing_next("circling", Controls(draw(0.0, mission.max_speed), turn))


def result_of(robots: int, sigma: float, seed: int, task: Task, errors: str = "") -> Result:
    """Return the result of a mission whose robots choose what to do by `task`, in a world with `errors`."""
    measured = dict[str, JointMeasurements]()

    def chosen(state: TeamState) -> TeamState:
        if isinstance(state.verdict, Localised) and state.following.part is not None:
            measured.setdefault(state.config.robot, state.following.part)
        return task(state)

    with mock.patch("agent.planning.team.next_task", chosen):
        run = run_mission(parse(scenario_of(robots, sigma, seed) + errors, "relative"))
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


def cell_of_ticks(planned: Sequence[Result], drawn: Sequence[Result]) -> str:
    """Return the median ticks, and the mean ratio to those at random with its 95 % interval."""
    counted = [
        [one.ticks if one.outcome == "localised" else MOST_TICKS for one in each] for each in (planned, drawn)
    ]
    logs = [math.log(one / other) for one, other in zip(*counted, strict=True)]
    spread = 1.96 * stdev(logs) / math.sqrt(len(logs))
    low, ratio, high = [math.exp(fmean(logs) + side * spread) for side in (-1, 0, 1)]
    return f"{median(counted[0]):g}, {ratio:.2f} ({low:.2f} to {high:.2f})"


def nees_of(found: Sequence[Result]) -> str:
    """Return the mean NEES of the claims."""
    return f"{fmean([each for one in found for each in one.nees]):.2f}"


def main(teams: int) -> None:
    """Print the table, and how the missions have ended."""
    rows, ended = [], Counter[str]()
    for robots, share in SIZES.items():
        seeds = range(1, 1 + max(teams // share, 2))
        planned, drawn = (
            [[result_of(robots, sigma, seed, task(seed)) for seed in seeds] for sigma in (0.0, SIGMA)]
            for task in (lambda _: team_tasks.next_task, lambda seed: partial(at_random, seed))
        )
        noisy = planned[1]
        off = [result_of(robots, SIGMA, seed, team_tasks.next_task, drawn_errors(seed)) for seed in seeds]
        error = rms([each for one in noisy for each in one.errors])
        row = [
            *(f"{robots} ({len(seeds)})", *map(cell_of_ticks, planned, drawn), f"{error:.2g} m"),
            f"{error / rms([each for one in noisy for each in one.bounds]):.2f}",
            *(nees_of(noisy), nees_of(off)),
        ]
        rows.append(row)
        ended.update([one.outcome for each in (*planned, off) for one in each])
        print(row, dict(ended), file=sys.stderr, flush=True)
    head = [
        *("robots (missions)", "exact: median ticks, ratio (95 %)", f"{SIGMA} m: median ticks, ratio (95 %)"),
        *("RMS error", "over Cramér-Rao", "NEES (3)", "NEES, errors drawn"),
    ]
    print(table(head, rows), end="\n\n")
    print("Planned motion:", ", ".join([f"{count} {name}" for name, count in ended.items()]))


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 100)
