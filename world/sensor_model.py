"""The sensors of a mission: the constants of each range and each odometry, and the models of their errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from protocol.mission import Mission
from protocol.motion import REST, Controls
from protocol.noise import Noise
from world.random_streams import correlated, gaussian, random_walk, uniform
from world.world_models import Radios, RangeModel
from world.world_noise import WorldNoise, of_robot

REACH_ROUNDING = 1e-12
"""The part by which the reach is longer than told: rounding must not put a start on the rim out of range."""

LONGEST_RANGE = 1e7
"""The largest measured range in m, which is the bound of `units.Range`."""


class RangeSensor(NamedTuple):
    """The constants of the ranges between two radios."""

    sensor: str
    """The name of its random streams, "anchor" or "mutual"."""
    robot: str
    """The robot in the key of its random streams."""
    sigma: float
    """The standard deviation of its errors in m."""
    bias: float
    """The bias in m."""
    scale: float
    """The relative error."""


class Lobes(NamedTuple):
    """The range pattern of one radio."""

    number: int
    """The number of lobes."""
    depth: float
    """The relative loss of range between two lobes."""
    angle: float
    """The direction of a lobe in rad, in the frame of the radio."""

    def reach(self, direction: float) -> float:
        """Return the relative range in a direction, in rad in the frame of the radio."""
        return 1.0 - 0.5 * self.depth * (1.0 - math.cos(self.number * (direction - self.angle)))


DISC = Lobes(1, 0.0, 0.0)
"""The range pattern of a radio with the same range in all directions."""


class Odometer(NamedTuple):
    """The constants of the odometry of one robot."""

    scale: float
    """The relative error of v."""
    gyro_bias: float
    """The bias of omega in rad/s."""


class SensorModel(msgspec.Struct, frozen=True):
    """The sensors of a mission."""

    seed: int
    """The seed of their errors."""
    noise: Noise
    """Their noise, as far as robots can assume it."""
    world: WorldNoise
    """The other parameters of their noise."""
    shared: bool
    """True if robots can assume all of it: `world` has nothing else."""
    exact: bool
    """True if they measure without errors."""
    reach: float
    """The true sensing range in m."""
    period: float
    """The duration of a tick in s."""
    survey: dict[str, tuple[float, float]]
    """The true position of each anchor less that of the scenario, in m, by its name."""
    anchors: dict[tuple[str, str], RangeSensor]
    """The ranges of each robot to each anchor that it may range, by their names."""
    mutual: dict[tuple[int, int], RangeSensor]
    """The ranges of each pair of robots that may measure each other, by their places in the scenario."""
    anchor_lobes: dict[str, Lobes]
    """The pattern of each anchor, by its name."""
    robot_lobes: tuple[Lobes, ...]
    """The pattern of each robot."""
    odometers: dict[str, Odometer]
    """The odometry of each robot, by its id."""

    def detects(
        self,
        ranging: RangeSensor,
        tick: int,
        rho: float,
        pattern: float,
        model: RangeModel | None = None,
        radios: Radios | None = None,
    ) -> bool:
        """Return whether two radios detect each other in a tick.

        `rho` is their distance in m, `pattern` the relative range of their patterns in this direction.
        `model` decides for `radios` instead of a disc.
        """
        reach = self.reach * pattern
        if model is not None and radios is not None:
            if not model.detects(radios, reach):
                return False
        elif rho > reach:
            return False
        exponent = self.world.detection_exponent
        if exponent is None:
            return True
        missed: float = (rho / reach) ** exponent
        return uniform(self.seed, f"{ranging.sensor}-detection", ranging.robot, tick) >= missed

    def measured(self, ranging: RangeSensor, rho: float, tick: int) -> float | None:
        """Return the range in m that is measured at the true distance `rho` m; None for a drop-out."""
        noise, world, seed = self.noise, self.world, self.seed
        sensor, robot, sigma, bias, scale = ranging
        if noise.drop_outs and uniform(seed, f"{sensor}-drop-out", robot, tick) < noise.drop_outs:
            return None
        rho += bias + scale * rho
        if noise.outliers and uniform(seed, f"{sensor}-outlier", robot, tick) < noise.outliers:
            least, most = noise.outlier_bias
            rho += least + (most - least) * uniform(seed, f"{sensor}-bias", robot, tick)
        shorts = world.short_outliers
        if shorts and uniform(seed, f"{sensor}-short-outlier", robot, tick) < shorts:
            least, most = world.short_outlier_bias
            rho -= least + (most - least) * uniform(seed, f"{sensor}-short-bias", robot, tick)
        if sigma:
            rho += sigma * self._error(sensor, robot, tick)
        return min(max(0.0, rho), LONGEST_RANGE)

    def _error(self, sensor: str, robot: str, tick: int) -> float:
        """Return the error of a range as a multiple of its sigma, with variance 1.

        Each distribution is a function of a Gaussian number, which may be correlated over time. Laplace and
        Student's t are Gaussian with a random variance (Andrews and Mallows 1974); the exponential
        distribution has the same quantile as the Gaussian number.
        """
        seed, world = self.seed, self.world
        if world.correlation:
            z = correlated(seed, sensor, robot, tick, world.correlation)
        else:
            z = gaussian(seed, sensor, robot, tick)
        match world.distribution:
            case "gaussian":
                return z
            case "laplace":
                return z * math.sqrt(-math.log(uniform(seed, f"{sensor}-laplace", robot, tick)))
            case "student-t":
                degrees = world.degrees_of_freedom
                squares = [gaussian(seed, f"{sensor}-student-{i}", robot, tick) ** 2 for i in range(degrees)]
                return z * math.sqrt((degrees - 2) / sum(squares))
            case "exponential":
                return -math.log(0.5 * math.erfc(z / math.sqrt(2.0)))

    def turned(self, driven: Controls, before: Controls, robot: str, tick: int) -> Controls:
        """Return the odometry of `robot` at `tick` without its white noise.

        `driven` are the controls that were executed over [tick - 1, tick], `before` those of the tick before.
        The gyro has no bias at rest, because a robot at rest knows that it does not turn.
        """
        table, (scale, bias) = self.world.odometry, self.odometers[robot]
        v, omega = driven.v, driven.omega
        if table.delay:
            v += table.delay * (before.v - v)
            omega += table.delay * (before.omega - omega)
        if v == omega == 0.0:
            return REST
        if table.gyro_walk:
            walked = random_walk(self.seed, "gyro-walk", robot, tick)
            bias += table.gyro_walk * math.sqrt(self.period) * walked
        v, omega = v + scale * v, omega + bias
        if table.strays and uniform(self.seed, "odometry-stray", robot, tick) < table.strays:
            v += table.stray_distance * gaussian(self.seed, "odometry-stray-v", robot, tick) * v
            turn = table.stray_turn * gaussian(self.seed, "odometry-stray-omega", robot, tick)
            omega += turn / self.period
        return Controls(v, omega)


def sensor_model(
    mission: Mission,
    world: WorldNoise,
    ids: Sequence[str],
    ranged: Sequence[tuple[str, str]],
    pairs: Sequence[tuple[int, int]],
    seed: int,
) -> SensorModel:
    """Return the sensors of a mission.

    `ids` are those of the robots; `ranged` are each robot with each anchor that it may range, where a robot's
    own anchor has its name. `pairs` are pairs of places in `ids`, those that may measure each other.
    """
    anchors = list(dict.fromkeys([anchor for _, anchor in ranged]))
    noise = world.shared(mission.noise)
    # A robot with one partner keys the errors of their ranges; in a group, both robots do.
    alone = len(dict(pairs)) == len(pairs)
    keys = [ids[i] if alone else f"{ids[i]}-{ids[j]}" for i, j in pairs]

    def drawn(name: str, robot: str, sigma: float) -> float:
        return sigma * gaussian(seed, name, robot, 0) if sigma else 0.0

    def radios(name: str, sigma: float, one: tuple[str, str], other: tuple[str, str]) -> float:
        return sum([drawn(f"{radio}-radio-{name}", robot, sigma) for radio, robot in (one, other)])

    def ranging(
        sensor: str, sigma: float, key: str, bias: float, scale: float, *ends: tuple[str, str]
    ) -> RangeSensor:
        return RangeSensor(
            sensor,
            key,
            sigma,
            bias + radios("bias", world.radio_bias_sigma, *ends),
            scale + radios("scale", world.radio_scale_sigma, *ends),
        )

    def lobes(radio: str, robot: str) -> Lobes:
        if not world.lobe_depth:
            return DISC
        return Lobes(world.lobes, world.lobe_depth, math.tau * uniform(seed, f"{radio}-lobes", robot, 0))

    def surveyed(robot: str) -> tuple[float, float]:
        if not (error := of_robot(world.survey_error, robot)):
            return 0.0, 0.0
        direction = math.tau * uniform(seed, "survey", robot, 0)
        return error * math.cos(direction), error * math.sin(direction)

    return SensorModel(
        seed=seed,
        noise=noise,
        world=world,
        shared=world.is_shared,
        exact=noise.exact and world.is_shared,
        reach=world.sensing_range_factor * mission.sensing_range * (1.0 + REACH_ROUNDING),
        period=mission.period,
        survey={anchor: surveyed(anchor) for anchor in anchors},
        anchors={
            (robot, anchor): ranging(
                "anchor",
                noise.anchor_sigma,
                robot if robot == anchor else f"{robot}-{anchor}",
                of_robot(world.anchor_bias, robot),
                of_robot(world.anchor_scale, robot),
                ("robot", robot),
                ("anchor", anchor),
            )
            for robot, anchor in ranged
        },
        mutual={
            (i, j): ranging(
                "mutual",
                noise.mutual_sigma,
                key,
                _of_pair(world.mutual_bias, ids[i], ids[j]),
                _of_pair(world.mutual_scale, ids[i], ids[j]),
                ("robot", ids[i]),
                ("robot", ids[j]),
            )
            for (i, j), key in zip(pairs, keys, strict=True)
        },
        anchor_lobes={anchor: lobes("anchor", anchor) for anchor in anchors},
        robot_lobes=tuple([lobes("robot", robot) for robot in ids]),
        odometers={
            robot: Odometer(
                of_robot(world.odometry.scale, robot)
                + drawn("wheel-scale", robot, world.odometry.scale_sigma),
                of_robot(world.odometry.gyro_bias, robot)
                + drawn("gyro-bias", robot, world.odometry.gyro_bias_sigma),
            )
            for robot in ids
        },
    )


def _of_pair(value: float | dict[str, float], one: str, other: str) -> float:
    """Return the value for a pair of a field that is a number or a table by one robot of each pair."""
    return of_robot(value, one if not isinstance(value, dict) or one in value else other)
