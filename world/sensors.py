"""The sensor models: ranges to anchors and between peers, up to and including R, and odometry.

Without noise, measurements are exact, and no random numbers are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from protocol.motion import Controls
from protocol.noise import VelocityNoise
from world.random_streams import gaussian, uniform
from world.scenario import Scenario
from world.truth import Truth


def anchor_ranges(truth: Truth, scenario: Scenario) -> list[float | None]:
    """Return the measured range of each robot to its own anchor (eq. (1b)), in m; None if there is none."""
    noise, reach = scenario.mission.noise, scenario.mission.sensing_range
    ranges: list[float | None] = []
    for pose, origin, robot in zip(truth.local, truth.origins, scenario.robots, strict=True):
        anchor = robot.anchor
        rho = math.hypot(pose.x - (anchor.x - origin.x), pose.y - (anchor.y - origin.y))
        if rho > reach:
            ranges.append(None)
        elif noise.exact:
            ranges.append(rho)
        else:
            ranges.append(measured(rho, noise.anchor_sigma, scenario, "anchor", robot.id, truth.tick))
    return ranges


class Mutual(NamedTuple):
    """The measurement of a pair whose robots are in range of each other."""

    range: float | None
    """The measured range in m, the same for both robots; None for a drop-out."""


def mutual_ranges(truth: Truth, scenario: Scenario, pairs: Sequence[tuple[int, int]]) -> list[Mutual | None]:
    """Return the measurement of each pair; None if its robots are out of range of each other."""
    reach, sigma = scenario.mission.sensing_range, scenario.mission.noise.mutual_sigma
    ranges: list[Mutual | None] = []
    for i, j in pairs:
        one, other = truth.local[i], truth.local[j]
        rho = math.hypot(one.x - other.x, one.y - other.y)
        if rho <= reach:
            robot = scenario.robots[i].id
            ranges.append(Mutual(measured(rho, sigma, scenario, "mutual", robot, truth.tick)))
        else:
            ranges.append(None)
    return ranges


def measured(
    rho: float, sigma: float, scenario: Scenario, sensor: str, robot: str, tick: int
) -> float | None:
    """Return the range in m that is measured at the true distance `rho` m; None for a drop-out."""
    noise, seed = scenario.mission.noise, scenario.seed
    if not (sigma or noise.outliers or noise.drop_outs):
        return rho
    if noise.drop_outs and uniform(seed, f"{sensor}-drop-out", robot, tick) < noise.drop_outs:
        return None
    if noise.outliers and uniform(seed, f"{sensor}-outlier", robot, tick) < noise.outliers:
        least, most = noise.outlier_bias
        rho += least + (most - least) * uniform(seed, f"{sensor}-bias", robot, tick)
    if sigma:
        rho = max(0.0, rho + sigma * gaussian(seed, sensor, robot, tick))
    return rho


def executed(limited_controls: Controls, scenario: Scenario, robot: str, tick: int) -> Controls:
    """Return the controls that the robot executes over [tick, tick + 1], given the commanded ones."""
    return _disturbed(
        limited_controls, scenario.mission.noise.actuation, scenario.seed, "actuation", robot, tick
    )


def odometry(driven: Controls, scenario: Scenario, robot: str, tick: int) -> Controls:
    """Return the odometry at `tick`, given the controls that were executed over [tick - 1, tick]."""
    return _disturbed(driven, scenario.mission.noise.odometry, scenario.seed, "odometry", robot, tick)


def _disturbed(
    controls: Controls, noise: VelocityNoise, seed: int, sensor: str, robot: str, tick: int
) -> Controls:
    v, omega = noise.variances(controls.v, controls.omega)
    return Controls(
        controls.v + math.sqrt(v) * gaussian(seed, f"{sensor}-v", robot, tick) if v else controls.v,
        controls.omega + math.sqrt(omega) * gaussian(seed, f"{sensor}-omega", robot, tick)
        if omega
        else controls.omega,
    )
