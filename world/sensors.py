"""The sensor models: ranges to anchors and between peers, up to and including R, and odometry.

Without noise, measurements are exact, and no random numbers are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from protocol.messages import NamedRange
from protocol.mission import Anchor
from protocol.motion import REST, Controls
from protocol.noise import VelocityNoise
from world.near_pairs import near_pairs
from world.random_streams import gaussian
from world.scenario import Scenario
from world.sensor_model import LONGEST_RANGE, RangeSensor
from world.truth import Truth
from world.world_models import Point, Radios


def anchor_ranges(truth: Truth, scenario: Scenario) -> list[list[NamedRange]]:
    """Return the measured ranges of each robot to its anchors (eq. (1b)), of those in range."""
    return [
        [
            NamedRange(name, rho)
            for name, anchor in ranged
            if (rho := _anchor_range(truth, scenario, i, name, anchor)) is not None
        ]
        for i, ranged in enumerate(scenario.ranged)
    ]


def _anchor_range(truth: Truth, scenario: Scenario, i: int, name: str, anchor: Anchor) -> float | None:
    """Return the measured range of robot `i` to the anchor called `name`, in m; None if there is none."""
    sensors, robot, pose, origin = scenario.sensors, scenario.robots[i].id, truth.local[i], truth.origins[i]
    if sensors.exact and scenario.ranging is None:
        return _exact_range(pose.x - (anchor.x - origin.x), pose.y - (anchor.y - origin.y), sensors.reach)
    sensor, (off_x, off_y) = sensors.anchors[robot, name], sensors.survey[name]
    x, y = pose.x - (anchor.x - origin.x) - off_x, pose.y - (anchor.y - origin.y) - off_y
    rho = math.hypot(x, y)
    pattern = sensors.anchor_lobes[name].reach(math.atan2(y, x)) if sensors.world.lobe_depth else 1.0
    surveyed, before = (anchor.x + off_x, anchor.y + off_y), truth.before(sensors.world.range_delay)[i]
    at, late = (x + surveyed[0], y + surveyed[1]), (x + (before.x - pose.x), y + (before.y - pose.y))
    found = _measured(scenario, truth.tick, sensor, (at, surveyed), (rho, pattern), late)
    return None if found is None else found.range


class Mutual(NamedTuple):
    """The measurement of a pair whose robots are in range of each other."""

    range: float | None
    """The measured range in m, the same for both robots; None for a drop-out."""


def in_contact(
    truth: Truth, scenario: Scenario, pairs: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], Mutual]:
    """Return the measurements of those of `pairs` whose robots are in range of each other, in their order.

    `pairs` are all that may measure each other. In a group, those that are too far apart are not tried, and
    none with a dead robot.
    """
    if not scenario.in_pairs and scenario.range_model is None:
        pairs = near_pairs([(pose.x, pose.y) for pose in truth.local], scenario.sensors.reach)
    if scenario.deaths:
        dead = [scenario.is_dead(robot.id, truth.tick) for robot in scenario.robots]
        pairs = [pair for pair in pairs if not (dead[pair[0]] or dead[pair[1]])]
    mutuals = mutual_ranges(truth, scenario, pairs)
    return {pair: mutual for pair, mutual in zip(pairs, mutuals, strict=True) if mutual is not None}


def mutual_ranges(truth: Truth, scenario: Scenario, pairs: Sequence[tuple[int, int]]) -> list[Mutual | None]:
    """Return the measurement of each pair; None if its robots are out of range of each other."""
    sensors = scenario.sensors
    ranges: list[Mutual | None] = []
    if sensors.exact and scenario.ranging is None:
        for i, j in pairs:
            one, other = truth.local[i], truth.local[j]
            exact = _exact_range(one.x - other.x, one.y - other.y, sensors.reach)
            ranges.append(None if exact is None else Mutual(exact))
        return ranges
    lobed, before = sensors.world.lobe_depth, truth.before(sensors.world.range_delay)
    places = [(pose.x, pose.y) for pose in truth.poses]
    for i, j in pairs:
        one, other = truth.local[i], truth.local[j]
        x, y = one.x - other.x, one.y - other.y
        rho, pattern = math.hypot(x, y), 1.0
        if lobed:
            to_one, to_other = math.atan2(y, x), math.atan2(-y, -x)
            of_one = sensors.robot_lobes[i].reach(to_other - one.heading)
            of_other = sensors.robot_lobes[j].reach(to_one - other.heading)
            pattern = 0.5 * (of_one + of_other)
        late, ends = (before[i].x - before[j].x, before[i].y - before[j].y), (places[i], places[j])
        ranges.append(_measured(scenario, truth.tick, sensors.mutual[i, j], ends, (rho, pattern), late))
    return ranges


def _exact_range(x: float, y: float, reach: float) -> float | None:
    """Return the range that exact sensors measure along (x, y) in m; None beyond `reach`."""
    rho = math.hypot(x, y)
    return rho if rho <= reach else None


def _measured(
    scenario: Scenario,
    tick: int,
    sensor: RangeSensor,
    places: tuple[Point, Point],
    detection: tuple[float, float],
    late: Point,
) -> Mutual | None:
    """Return the measurement of two radios at `places`; None if they do not detect each other.

    `detection` has their distance in m, and the relative range of their patterns in this direction. `late` is
    the vector between them in m at the time of the measurement.
    """
    sensors, model, (rho, pattern), radios = scenario.sensors, scenario.ranging, detection, None
    if model is not None:
        radios = Radios(f"{sensor.sensor}/{sensor.robot}", *places, tick, scenario.seed)
    if not sensors.detects(sensor, tick, rho, pattern, model, radios):
        return None
    if sensors.exact:
        return Mutual(rho)
    measured = sensors.measured(sensor, math.hypot(*late), tick)
    if measured is not None and model is not None and radios is not None:
        modelled = model.measured(radios, measured)
        measured = None if modelled is None else min(max(0.0, float(modelled)), LONGEST_RANGE)
    return Mutual(measured)


def executed(limited_controls: Controls, scenario: Scenario, robot: str, tick: int) -> Controls:
    """Return the controls that the robot executes over [tick, tick + 1], given the commanded ones."""
    actuation = scenario.sensors.noise.actuation
    return _disturbed(limited_controls, actuation, scenario.seed, "actuation", robot, tick)


def odometry(
    driven: Controls, scenario: Scenario, robot: str, tick: int, before: Controls = REST
) -> Controls:
    """Return the odometry at `tick`, given the controls that were executed over [tick - 1, tick].

    `before` are those that were executed over the tick before.
    """
    sensors = scenario.sensors
    turned = driven if sensors.shared else sensors.turned(driven, before, robot, tick)
    return _disturbed(turned, sensors.noise.odometry, scenario.seed, "odometry", robot, tick)


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
