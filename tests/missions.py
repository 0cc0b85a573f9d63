"""Missions in which robot a has a given start, and its anchor is at the origin."""

from __future__ import annotations

import math

from compose.launch.in_process import run_mission
from compose.recording.run import Run
from compose.scenario.scenario_file import parse
from world.scenario import Scenario
from world.sensors import anchor_ranges
from world.truth import Truth


def mission_of(
    start: tuple[float, float, float],
    *,
    planner_name: str = "assured",
    reach: float = 3.0,
    speed: float = 1.0,
    turn_rate: float = math.pi,
) -> Run:
    """Run such a mission in this process. The peer starts half a metre from its own anchor."""
    text = f"""
        name = "mission"
        planner = {{name = "{planner_name}"}}
        [mission]
        sensing_range = {reach}
        period = 1.0
        max_speed = {speed}
        max_turn_rate = {turn_rate!r}
        [[robot]]
        id = "a"
        anchor = [0.0, 0.0]
        start = {list(start)}
        [[robot]]
        id = "b"
        anchor = [10.0, 0.0]
        start = [10.4, 0.3, 3.6]
        """
    return run_mission(parse(text, "mission"))


def own_ranges(truth: Truth, scenario: Scenario) -> list[float | None]:
    """Return the measured range of each robot to its own anchor in m; None if it has none."""
    return [ranges[0].range if ranges else None for ranges in anchor_ranges(truth, scenario)]
