"""The noise that the simulated sensors have: the table `[world.noise]`, and the checks of it.

The robots assume `Mission.noise`, and no message to them contains anything of this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta
from msgspec.structs import asdict, replace

from protocol.mission import Mission
from protocol.noise import Bias, Delay, Floor, Noise, VelocityNoise
from protocol.units import Fraction, Probability, RobotId, Sigma

Offset = Annotated[float, Meta(ge=-1e4, le=1e4)]
RelativeError = Annotated[float, Meta(ge=-0.5, le=0.5)]
GyroBias = Annotated[float, Meta(ge=-1e4, le=1e4)]
Unit = Annotated[float, Meta(ge=0.0, le=1.0)]
Distribution = Literal["gaussian", "laplace", "student-t", "exponential"]
"""The name of a distribution of range errors."""

T = TypeVar("T")


class WorldVelocityNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """White noise of v and omega. A field that is left out has the value that the robots are told."""

    v: Fraction | None = None
    """The proportional standard deviation of v, as a fraction of v."""
    omega: Fraction | None = None
    """The proportional standard deviation of omega, as a fraction of omega."""
    v_floor: Floor | None = None
    """The absolute standard deviation of v, in m/s."""
    omega_floor: Floor | None = None
    """The absolute standard deviation of omega, in rad/s."""


class WorldOdometryNoise(WorldVelocityNoise, frozen=True, forbid_unknown_fields=True):
    """The noise of odometry: white noise, errors that are constant or slow, a delay, and strays."""

    scale: RelativeError | dict[RobotId, RelativeError] = 0.0
    """The relative error of the measured v, constant over the mission: of all robots, or by robot."""
    scale_sigma: Fraction = 0.0
    """The standard deviation of a further relative error of v, drawn for each robot."""
    gyro_bias: GyroBias | dict[RobotId, GyroBias] = 0.0
    """The bias of the measured omega in rad/s while the robot moves: of all robots, or by robot."""
    gyro_bias_sigma: Floor = 0.0
    """The standard deviation in rad/s of a further bias of omega, drawn for each robot."""
    gyro_walk: Floor = 0.0
    """The standard deviation of the change of the bias of omega in one second, in rad/s: a random walk."""
    delay: Unit = 0.0
    """The fraction of a tick by which the odometry is late: it measures that part of the tick before."""
    strays: Probability = 0.0
    """The probability of a stray in a tick in which the robot moves."""
    stray_turn: Floor = 0.1
    """The standard deviation of the heading error of a stray in rad."""
    stray_distance: Floor = 0.2
    """The standard deviation of the error of its distance, as a fraction of the distance."""


class WorldNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The noise of the simulated sensors.

    One of the first seven fields that is left out has the value of `[mission.noise]`.
    """

    anchor_sigma: Sigma | None = None
    """The standard deviation of a range to an anchor, in m."""
    mutual_sigma: Sigma | None = None
    """The standard deviation of a range between robots, in m."""
    outliers: Probability | None = None
    """The probability that a range is too long by `outlier_bias`."""
    outlier_bias: tuple[Bias, Bias] | None = None
    """The minimum and maximum of the uniformly distributed bias of an outlier, in m."""
    drop_outs: Probability | None = None
    """The probability that a range within R is not measured."""
    actuation: WorldVelocityNoise = WorldVelocityNoise()
    """The difference between commanded and executed velocities."""
    odometry: WorldOdometryNoise = WorldOdometryNoise()
    """The difference between executed and measured velocities."""
    distribution: Distribution = "gaussian"
    """The distribution of range errors. Each has the standard deviation of its sigma; `exponential` is never
    negative, and its mean is also sigma."""
    degrees_of_freedom: Annotated[int, Meta(ge=3, le=100)] = 3
    """The degrees of freedom of the distribution `student-t`."""
    correlation: Annotated[float, Meta(ge=0.0, le=0.99)] = 0.0
    """The AR(1) coefficient a tick of the Gaussian numbers from which the range errors of a sensor follow."""
    short_outliers: Probability = 0.0
    """The probability that a range is too short by `short_outlier_bias`."""
    short_outlier_bias: tuple[Bias, Bias] = (0.3, 2.0)
    """The minimum and maximum of the uniformly distributed amount by which it is too short, in m."""
    anchor_bias: Offset | dict[RobotId, Offset] = 0.0
    """The bias of ranges to anchors in m: of all anchors, or by the robot that the anchor ranges."""
    mutual_bias: Offset | dict[RobotId, Offset] = 0.0
    """The bias of ranges between robots in m: of all pairs, or by one of the robots of the pair."""
    anchor_scale: RelativeError | dict[RobotId, RelativeError] = 0.0
    """The relative error of ranges to anchors: of all anchors, or by the robot that the anchor ranges."""
    mutual_scale: RelativeError | dict[RobotId, RelativeError] = 0.0
    """The relative error of ranges between robots: of all pairs, or by one of the robots of the pair."""
    radio_bias_sigma: Sigma = 0.0
    """The standard deviation in m of a bias drawn for each radio; a range has those of its two radios."""
    radio_scale_sigma: Fraction = 0.0
    """The standard deviation of a relative error drawn for each radio; a range has both radios'."""
    range_delay: Delay = 0.0
    """The time in s by which all ranges are late: they are those of the poses before. At most a tick."""
    sensing_range_factor: Annotated[float, Meta(ge=0.1, le=10.0)] = 1.0
    """The true sensing range, as a multiple of `mission.sensing_range`."""
    detection_exponent: Annotated[float, Meta(ge=0.1, le=1000.0)] | None = None
    """The exponent p of the probability 1 - (r / R)^p that two radios at distance r detect each other in a
    tick. Without detection there is no range and no contact. Left out: they always do."""
    lobe_depth: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """The depth of the lobes of each radio: its range is between 1 - `lobe_depth` and 1 times R. The range of
    two robots is the mean of both."""
    lobes: Annotated[int, Meta(ge=1, le=64)] = 3
    """The number of lobes. They turn with a robot and stand still with an anchor; their angle is drawn."""
    survey_error: Sigma | dict[RobotId, Sigma] = 0.0
    """The distance in m between an anchor and the position that the robots are told, in a direction that is
    drawn: of all anchors, or by the robot that the anchor ranges."""

    def shared(self, told: Noise) -> Noise:
        """Return the noise of the sensors as far as robots can assume it: `told` with the given fields."""
        given = {name: getattr(self, name) for name in RANGE_FIELDS}
        return replace(
            told,
            **_known(given),
            actuation=replace(told.actuation, **_known(asdict(self.actuation))),
            odometry=replace(
                told.odometry, **_known({name: getattr(self.odometry, name) for name in VELOCITY_FIELDS})
            ),
        )

    @property
    def is_shared(self) -> bool:
        """True if robots can assume all of it: only the fields of `[mission.noise]` are set."""
        odometry = replace(self.odometry, **dict.fromkeys(VELOCITY_FIELDS))
        rest = replace(self, **dict.fromkeys(RANGE_FIELDS), actuation=WorldVelocityNoise())
        return replace(rest, odometry=odometry) == WorldNoise()

    def changes_nothing(self, told: Noise) -> bool:
        """Return whether the sensors have the noise that the robots are told."""
        return self.is_shared and self.shared(told) == told


RANGE_FIELDS = ("anchor_sigma", "mutual_sigma", "outliers", "outlier_bias", "drop_outs")
"""The fields of ranges that `Noise` has too."""
VELOCITY_FIELDS = VelocityNoise.__struct_fields__
"""The fields of odometry that `Noise` has too."""
OF_ANCHORS = ("anchor_bias", "anchor_scale", "survey_error")
"""The fields that can be tables by robot."""
OF_PAIRS = ("mutual_bias", "mutual_scale")
"""The fields that can be tables by one robot of each pair."""


def _known(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None}


def of_robot(value: float | dict[str, float], robot: str) -> float:
    """Return the value for `robot` of a field that is a number or a table by robot; 0 if it is not in it."""
    return value.get(robot, 0.0) if isinstance(value, dict) else value


def world_noise_mistake(
    noise: WorldNoise, mission: Mission, pairs: Sequence[tuple[str, str]]
) -> tuple[str, str] | None:
    """Return the field of `[world.noise]` that is invalid, and why; None if all are valid.

    `pairs` are the ids of the robots of each pair.
    """
    if noise.range_delay > mission.period:
        return "range_delay", f"it is longer than a tick (mission.period), {mission.period:g} s"
    for name, (least, most) in (
        ("outlier_bias", noise.shared(mission.noise).outlier_bias),
        ("short_outlier_bias", noise.short_outlier_bias),
    ):
        if least > most:
            return name, f"the lower bound {least:.6g} m is above the upper bound {most:.6g} m"
    ids = list(dict.fromkeys([robot for pair in pairs for robot in pair]))
    tables = {name: getattr(noise, name) for name in (*OF_ANCHORS, *OF_PAIRS)}
    tables |= {f"odometry.{name}": getattr(noise.odometry, name) for name in ("scale", "gyro_bias")}
    for name, table in tables.items():
        for robot in table if isinstance(table, dict) else ():
            if robot not in ids:
                return name, f"there is no robot '{robot}'; there are {', '.join(ids)}"
    for name in OF_PAIRS:
        for one, other in pairs:
            if isinstance(tables[name], dict) and {one, other} <= tables[name].keys():
                return name, f"'{one}' and '{other}' are one pair; name one of them"
    return None


def world_noise_infeasibility(noise: WorldNoise, told: Noise) -> str | None:
    """Return why robots that are told `told` cannot localise themselves with this noise; None if they may."""
    if not told.exact or noise.changes_nothing(told):
        return None
    return (
        "the robots are told that all sensors are exact, and cannot localise themselves with others: "
        "set mission.noise"
    )
