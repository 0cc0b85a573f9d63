"""Scenarios of groups for tests."""

from __future__ import annotations

import random
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from compose.recording.run import Run
from compose.scenario.scenario_file import scenario_table, validate
from world.scenario import Scenario

R = 3.0
"""The sensing range in m."""
SIGMA = 0.05
"""The sigma of all ranges of `random_group` in m."""


def table_of(robots: int, seed: int, *, sigma: float = 0.0, side: float = 10.0) -> dict[str, Any]:
    """Return a scenario file of `robots` beside anchors in a square of `side` R sqrt(robots)."""
    rng, length = random.Random(f"{robots}/{seed}"), side * R * robots**0.5
    mission: dict[str, Any] = {
        "sensing_range": R,
        "period": 1.0,
        "max_speed": 1.0,
        "max_turn_rate": 3.141592653589793,
    }
    if sigma:
        noise = {"anchor_sigma": sigma, "mutual_sigma": sigma, "gyro_bias": 0.0003}
        mission |= {"noise": noise, "accuracy": 0.3}
    placed = [
        {"id": f"r{i}", "anchor": [rng.uniform(0.0, length), rng.uniform(0.0, length)]} for i in range(robots)
    ]
    return {"name": "group", "seed": seed, "mission": mission, "robot": placed}


def group_of(
    robots: int, seed: int, *, sigma: float = 0.0, attacker: int | None = None, attack: Mapping[str, Any] = {}
) -> Scenario:
    """Return a group, of which one robot may be an `attacker`."""
    table = table_of(robots, seed, sigma=sigma)
    if attacker is not None:
        table["robot"][attacker]["attack"] = dict(attack)
    return validate(table, "group.toml").seeded(None)


def random_table(seed: int, mission: Mapping[str, Any] = {}, **group: Any) -> dict[str, Any]:
    """Return the scenario file `random-group` under noise, with the fields `mission` and `group`."""
    table: dict[str, Any] = scenario_table("random-group")
    noise = {"anchor_sigma": SIGMA, "mutual_sigma": SIGMA, "gyro_bias": 0.0002}
    table["mission"] |= {"accuracy": 0.3, "noise": noise, **mission}
    return table | {"seed": seed, "group": {"spacing": 30.0} | group}


def random_group(seed: int, **group: Any) -> Scenario:
    """Return the scenario of `random_table`, with the fields `group`."""
    return validate(random_table(seed, **group), "group.toml").seeded(None)


def with_value(table: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return `table` with a value at a path such as `robot.0.attack`, or without it if that is None."""
    changed = deepcopy(table)
    *names, last = [int(name) if name.isdigit() else name for name in path.split(".")]
    place: Any = changed
    for name in names:
        place = place[name]
    place[last] = value
    if value is None:
        del place[last]
    return changed


def localised(run: Run) -> set[str]:
    """Return the robots that have claimed a pose."""
    return {robot for robot in run.robots if run.claim(robot) is not None}
