"""Missions with noise and random starts, at the parameters of Section IV."""

from __future__ import annotations

import math
from functools import cache

from compose.launch.in_process import run_mission
from compose.recording.run import Run
from compose.recording.summary_json import summary
from compose.scenario.scenario_file import parse
from world.scenario import Scenario

SIGMA = "anchor_sigma = 0.1\nmutual_sigma = 0.1"
WHEELS = "actuation = {v = 0.01, omega = 0.01}"
ODOMETRY = "odometry = {v = 0.01, omega = 0.01}"


def scenario_of(
    noise: str,
    seed: int,
    *,
    planner_name: str = "assured",
    reach: float = 3.0,
    period: float = 1.0,
    turn_rate: float = math.pi,
    accuracy: float = 0.1,
    max_ticks: int | None = None,
) -> Scenario:
    """Return a scenario with the given noise table; the anchors are 10 m apart."""
    text = f"""
        name = "survey"
        {f"max_ticks = {max_ticks}" if max_ticks is not None else ""}
        planner = {{name = "{planner_name}"}}
        [mission]
        sensing_range = {reach}
        period = {period}
        max_speed = 1.0
        max_turn_rate = {turn_rate!r}
        accuracy = {accuracy}
        [mission.noise]
        {noise}
        [[robot]]
        id = "a"
        anchor = [0.0, 0.0]
        [[robot]]
        id = "b"
        anchor = [10.0, 0.0]
        """
    return parse(text, "survey", seed=seed)


@cache
def survey(noise: str, seed: int, planner_name: str = "assured", accuracy: float = 0.1) -> Run:
    """Return the recording of the mission of `scenario_of`, run in this process."""
    return run_mission(scenario_of(noise, seed, planner_name=planner_name, accuracy=accuracy))


def assert_localised(recording: Run) -> None:
    """Check that both robots localise in the same tick, to mission.accuracy and within the claimed sigmas."""
    result = summary(recording, "in-process", None)
    assert result["outcome"] == "localised", (recording.scenario.seed, result["reason"])
    robots = result["robots"]
    assert robots["a"]["localised_tick"] == robots["b"]["localised_tick"] == result["ticks"]
    accuracy = recording.scenario.mission.accuracy
    for robot in robots.values():
        off, sigma = robot["position_error_m"], robot["position_sigma_m"]
        assert sigma <= accuracy
        assert off <= min(3.0 * accuracy, 5.0 * sigma + ROUNDING), (recording.scenario.seed, off, sigma)
        assert robot["heading_error_rad"] <= 5.0 * robot["heading_sigma_rad"] + ROUNDING


ROUNDING = 1e-6
"""The tolerance of the referee, in m and rad."""


def states(recording: Run, robot: str) -> list[str]:
    """Return the state of the robot at every tick."""
    return [moment.commands[robot].task for moment in recording.ticks]
