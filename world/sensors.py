"""What can be measured: ranges to anchors and between peers, within R, bounds included. Exact."""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocol.motion import Pose
from world.scenario import Scenario


def anchor_ranges(poses: Sequence[Pose], scenario: Scenario) -> list[float | None]:
    """m: every robot's range to its own anchor (eq. (1b)), none where that is out of range."""
    reach = scenario.mission.sensing_range
    ranges: list[float | None] = []
    for pose, robot in zip(poses, scenario.robots, strict=True):
        rho = math.hypot(pose.x - robot.anchor.x, pose.y - robot.anchor.y)
        ranges.append(rho if rho <= reach else None)
    return ranges


def mutual_ranges(
    poses: Sequence[Pose], pairs: Sequence[tuple[int, int]], sensing_range: float
) -> list[float | None]:
    """m: the range of every pair; one measurement, told to both; none where that is out of range."""
    ranges: list[float | None] = []
    for one, other in pairs:
        rho = math.hypot(poses[one].x - poses[other].x, poses[one].y - poses[other].y)
        ranges.append(rho if rho <= sensing_range else None)
    return ranges
