"""The noise of sensors and motion. The world draws from it, and every robot knows it (`Mission.noise`)."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated

import msgspec
from msgspec import Meta

from protocol.units import Fraction, Probability, Sigma

Floor = Annotated[float, Meta(ge=0.0, le=1e4)]
Bias = Annotated[float, Meta(ge=0.0, le=1e6)]


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


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The noise of ranges, actuation and odometry. By default, everything is exact."""

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

    @cached_property
    def exact(self) -> bool:
        """True if there is no noise. Then each range is exact, and no detection means out of range."""
        ranges = self.anchor_sigma or self.mutual_sigma or self.outliers or self.drop_outs
        return not ranges and self.actuation == self.odometry == VelocityNoise()

    @cached_property
    def standstill_bound(self) -> tuple[float, float]:
        """The bounds in m/s and rad/s that the odometry of a robot at rest hardly ever exceeds."""
        return (
            STANDSTILL_SIGMAS * math.hypot(self.actuation.v_floor, self.odometry.v_floor),
            STANDSTILL_SIGMAS * math.hypot(self.actuation.omega_floor, self.odometry.omega_floor),
        )


STANDSTILL_SIGMAS = 6.0
"""The number of standard deviations in `standstill_bound`."""
