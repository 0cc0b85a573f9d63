"""The noise of sensors and motion, as the robots assume it (`Mission.noise`), and profiles of common sensors.

The robots are told how large white errors are. What they are not told, such as the bias of a radio or the
scale of a wheel, has a prior, and is estimated together with the poses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple, get_args

import msgspec
from msgspec import Meta

from protocol.units import Fraction, Probability, Sigma

Floor = Annotated[float, Meta(ge=0.0, le=1e4)]
Bias = Annotated[float, Meta(ge=0.0, le=1e6)]
Degrees = Annotated[float, Meta(ge=0.0, le=1e6)]
GyroBias = Annotated[float, Meta(ge=0.0, le=1e4)]
Delay = Annotated[float, Meta(ge=0.0, le=1e4)]
Correlation = Annotated[float, Meta(ge=1e-6, le=1e6)]

ProfileName = Literal["uwb", "uwb-calibrated", "wheels", "camera"]
"""The name of a set of values for `Noise`; see PROFILES."""


class VelocityNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """White Gaussian noise on the v and omega of each tick, with a proportional and an absolute part.

    The variances of the two parts are added.
    """

    v: Fraction = 0.0
    """The proportional standard deviation of v, as a fraction of v."""
    omega: Fraction = 0.0
    """The proportional standard deviation of omega, as a fraction of omega."""
    v_floor: Floor = 0.0
    """The absolute standard deviation of v, in m/s."""
    omega_floor: Floor = 0.0
    """The absolute standard deviation of omega, in rad/s."""

    def variances(self, v: float, omega: float) -> tuple[float, float]:
        """Return the variances of v and omega for a manoeuvre, in (m/s)^2 and (rad/s)^2."""
        return (self.v * v) ** 2 + self.v_floor**2, (self.omega * omega) ** 2 + self.omega_floor**2


YAW = 0.3
"""The prior (rad) of the angle between the axis of a camera and the heading of its robot."""


class Priors(NamedTuple):
    """The standard deviations of the constant and slow errors that a robot estimates with its poses.

    All of them are 0 if the robot takes its sensors as they were told.
    """

    range_bias: float
    pair_bias: float
    range_scale: float
    slow_sigma: float
    slow_time: float
    wheel_scale: float
    gyro_bias: float
    survey_error: float
    range_delay: float
    range_depth: float

    @property
    def range_aside(self) -> float:
        """The prior of the share of ranges that is aside: a camera may look past the heading."""
        return YAW * self.range_depth

    @property
    def of_odometry(self) -> bool:
        """True if the odometry may have a scale or a bias."""
        return self.wheel_scale > 0.0 or self.gyro_bias > 0.0


SIZES = tuple([name for name in Priors._fields if name != "slow_time"])
"""The fields of Priors, and of Noise, that are sizes of errors: 0 stands for none."""

UNTOLD = Priors(0.02, 0.01, 0.005, 0.0, 2.0, 0.005, 0.003, 0.0, 0.0, 0.0)
"""The priors of whoever tells none, for ranges with a sigma of UNTOLD_SIGMA or more.

They are as wide as costs at most 5 % more ticks if the noise is as told: see docs/assumptions.md.
"""

UNTOLD_SIGMA = 0.05
"""The sigma (m) of ranges below which UNTOLD becomes narrower, with the square of the sigma.

Whoever tells that ranges are accurate to a millimetre has calibrated the radios, and the odometry with them.
In proportion to sigma, priors hid false data: at 0.01 m, none of 5 robots that reported an orbit rotated by 5
degrees was found.
"""


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The noise of ranges, actuation and odometry. By default, everything is exact.

    The fields from `range_bias` on are priors: standard deviations of errors that are the same in every
    tick, and that the robots estimate. None stands for the value in UNTOLD.
    """

    anchor_sigma: Sigma = 0.0
    """The standard deviation of a range to an anchor, in m."""
    mutual_sigma: Sigma = 0.0
    """The standard deviation of a range between robots, in m."""
    outliers: Probability = 0.0
    """The probability that a range is an outlier: without line of sight, and therefore too long."""
    outlier_bias: tuple[Bias, Bias] = (0.3, 2.0)
    """The minimum and maximum of the uniformly distributed bias of an outlier, in m."""
    drop_outs: Probability = 0.0
    """The probability that a range within R is not measured."""
    actuation: VelocityNoise = VelocityNoise()
    """The difference between commanded and executed velocities."""
    odometry: VelocityNoise = VelocityNoise()
    """The difference between executed and measured velocities."""
    profile: ProfileName | None = None
    """The profile whose values hold for all fields that are not set; `camera` is for recordings only."""
    range_bias: Sigma | None = None
    """The prior of a bias that all ranges have in common, in m."""
    pair_bias: Sigma | None = None
    """The prior of a further bias of each pair of radios, in m."""
    range_scale: Fraction | None = None
    """The prior of the relative scale error of all ranges."""
    slow_sigma: Sigma = 0.0
    """The standard deviation of a slowly varying error of the ranges of each pair of radios, in m."""
    slow_time: Correlation = 2.0
    """The time in s in which the correlation of this error falls to 1 / e."""
    wheel_scale: Fraction | None = None
    """The prior of the relative scale errors of a robot's odometry, of v and of omega."""
    gyro_bias: GyroBias | None = None
    """The prior of the bias of omega, in rad/s, while the robot moves."""
    sigma_degrees: Degrees = 4.0
    """The degrees of freedom of the prior of the factor of all sigmas; 0: the sigmas are exactly as told."""
    survey_error: Sigma = 0.0
    """The prior of the difference of each anchor from its surveyed position along each axis, in m."""
    range_delay: Delay = 0.0
    """The prior of the delay in s of all ranges: of their stamps after the time of the measurement."""
    range_depth: Fraction = 0.0
    """The prior of the share of depth in all ranges, 1 for those of a camera; for recordings only."""
    strays: Probability = 1e-3
    """The probability that a range has an error of any size and sign; without noise, there are none."""
    odometry_strays: Probability = 0.0
    """The probability that the odometry of a tick in motion is a stray: off by far more than its noise."""

    @cached_property
    def exact(self) -> bool:
        """True if there is no noise. Then each range is exact, and no detection means out of range."""
        ranges = self.anchor_sigma or self.mutual_sigma or self.outliers or self.drop_outs
        told = self.range_bias or self.pair_bias or self.range_scale or self.slow_sigma or self.survey_error
        if ranges or told or self.wheel_scale or self.gyro_bias or self.range_delay or self.range_depth:
            return False
        return self.actuation == VelocityNoise() and not self.wanders

    @property
    def wanders(self) -> bool:
        """True if the errors of odometry differ from tick to tick: white noise, or strays."""
        return self.odometry != VelocityNoise() or self.odometry_strays > 0.0

    @cached_property
    def untold_share(self) -> float:
        """The factor of the priors that nobody has told: 1, or less if ranges are accurate (UNTOLD_SIGMA)."""
        return min(1.0, max(self.anchor_sigma, self.mutual_sigma) / UNTOLD_SIGMA) ** 2

    @cached_property
    def priors(self) -> Priors:
        """The priors, with those of UNTOLD for those that were not told."""
        share, told = self.untold_share, [getattr(self, name) for name in Priors._fields]
        return Priors._make(
            [share * untold if one is None else one for one, untold in zip(told, UNTOLD, strict=True)]
        )

    @cached_property
    def as_told(self) -> Noise:
        """This noise without any prior: the sigmas are exact, and there are no further errors."""
        told = (*SIZES, "sigma_degrees", "strays", "odometry_strays")
        return msgspec.structs.replace(self, **dict.fromkeys(told, 0.0))

    @cached_property
    def standstill_bound(self) -> tuple[float, float]:
        """The bounds in m/s and rad/s that the odometry of a robot at rest hardly ever exceeds."""
        return (
            STANDSTILL_SIGMAS * math.hypot(self.actuation.v_floor, self.odometry.v_floor),
            STANDSTILL_SIGMAS * math.hypot(self.actuation.omega_floor, self.odometry.omega_floor),
        )


STANDSTILL_SIGMAS = 6.0
"""The number of standard deviations in `standstill_bound`."""


PROFILES: Mapping[ProfileName, Mapping[str, Any]] = {
    "uwb": {
        "anchor_sigma": 0.05,
        "mutual_sigma": 0.05,
        "range_bias": 0.4,
        "pair_bias": 0.1,
        "range_scale": 0.05,
        "slow_sigma": 0.08,
        "slow_time": 2.0,
        "wheel_scale": 0.02,
        "gyro_bias": 0.005,
        "range_delay": 0.1,
        "strays": 0.05,
    },
    "uwb-calibrated": {
        "anchor_sigma": 0.05,
        "mutual_sigma": 0.05,
        "range_bias": 0.05,
        "pair_bias": 0.03,
        "range_scale": 0.005,
        "wheel_scale": 0.02,
        "gyro_bias": 0.005,
        "strays": 0.02,
    },
    "wheels": {
        "anchor_sigma": 0.05,
        "mutual_sigma": 0.05,
        "wheel_scale": 0.02,
        "gyro_bias": 0.005,
    },
    "camera": {
        "anchor_sigma": 0.05,
        "mutual_sigma": 0.05,
        "range_bias": 0.1,
        "range_scale": 0.03,
        "wheel_scale": 0.02,
        "gyro_bias": 0.005,
        "range_depth": 0.5,
        "strays": 0.02,
    },
}
"""The values of `Noise` for common sensors; docs/assumptions.md has their sources."""


def with_profile(noise: object) -> object:
    """Return the content of `[mission.noise]` with the values of its profile, which its own ones replace.

    A string is the name of a profile. What is not valid is returned as it is, for the decoder to report.
    """
    table = {"profile": noise} if isinstance(noise, str) else noise
    if not isinstance(table, Mapping) or table.get("profile") not in get_args(ProfileName):
        return table
    return {**PROFILES[table["profile"]], **table}
