"""How far sensors and wheels are to be trusted: what the world draws from, and what every robot is told."""

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
    """White noise on the v and omega of each tick: a fraction of each, and an absolute part."""

    v: Fraction = 0.0
    """of v, a standard deviation"""
    omega: Fraction = 0.0
    """of omega"""
    v_floor: Floor = 0.0
    """m/s, added in squares"""
    omega_floor: Floor = 0.0
    """rad/s, added in squares"""

    def variances(self, v: float, omega: float) -> tuple[float, float]:
        """Of the noise on a manoeuvre, in (m/s)^2 and (rad/s)^2."""
        return (self.v * v) ** 2 + self.v_floor**2, (self.omega * omega) ** 2 + self.omega_floor**2


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """Of ranges: Gaussian, outliers and drop-outs; of wheels: how they move the robot, and are measured.

    Left out, everything is exact.
    """

    anchor_sigma: Sigma = 0.0
    """m, of a range to an anchor"""
    mutual_sigma: Sigma = 0.0
    """m, of a range between robots"""
    outliers: Probability = 0.0
    """that a range has no line of sight, and is too long"""
    outlier_bias: tuple[Bias, Bias] = (0.3, 2.0)
    """m: by how much then, uniform between these, the least and the most"""
    drop_outs: Probability = 0.0
    """that a range within R is not measured"""
    actuation: VelocityNoise = VelocityNoise()
    """how what is executed differs from what was asked for"""
    odometry: VelocityNoise = VelocityNoise()
    """how what the odometry measures differs from what was executed"""

    @cached_property
    def exact(self) -> bool:
        """Whether there is none: then a range is a fact, and so is silence."""
        ranges = self.anchor_sigma or self.mutual_sigma or self.outliers or self.drop_outs
        return not ranges and self.actuation == self.odometry == VelocityNoise()

    @property
    def standstill_bound(self) -> tuple[float, float]:
        """m/s and rad/s: more than this is hardly ever measured by a robot that was told to stand."""
        return (
            UNREST * math.hypot(self.actuation.v_floor, self.odometry.v_floor),
            UNREST * math.hypot(self.actuation.omega_floor, self.odometry.omega_floor),
        )


UNREST = 6.0
"""standard deviations"""
