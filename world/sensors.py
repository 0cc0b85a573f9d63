"""What can be measured: ranges to anchors and between peers, within R, bounds included. Exact."""

from __future__ import annotations

import math
from collections.abc import Sequence

from world.scenario import Scenario
from world.truth import Truth


def anchor_ranges(truth: Truth, scenario: Scenario) -> list[float | None]:
    """m: every robot's range to its own anchor (eq. (1b)), none where that is out of range."""
    reach = scenario.mission.sensing_range
    ranges: list[float | None] = []
    for pose, origin, robot in zip(truth.local, truth.origins, scenario.robots, strict=True):
        anchor = robot.anchor
        rho = math.hypot(pose.x - (anchor.x - origin.x), pose.y - (anchor.y - origin.y))
        ranges.append(rho if rho <= reach else None)
    return ranges


def mutual_ranges(truth: Truth, pairs: Sequence[tuple[int, int]], sensing_range: float) -> list[float | None]:
    """m: the range of every pair; one measurement, told to both; none where that is out of range."""
    ranges: list[float | None] = []
    for i, j in pairs:
        one, other = truth.local[i], truth.local[j]
        rho = math.hypot(one.x - other.x, one.y - other.y)
        ranges.append(rho if rho <= sensing_range else None)
    return ranges
