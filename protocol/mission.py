"""What every robot is told before release, and what follows from it (Sections II and III.B)."""

from __future__ import annotations

import math
from typing import Literal

import msgspec

from protocol.motion import TAU
from protocol.units import (
    AngularVelocity,
    Coordinate,
    Duration,
    Length,
    Range,
    Speed,
    Time,
    TurnRate,
    Velocity,
)

Variant = Literal["assured", "paper"]
"""`paper` plays the paper to the letter; `assured` also cures what fails in it."""

Role = Literal["a", "b"]
"""a moves first when the two meet, b stands (Section III.C)."""

OPTIMAL_TURN = 2.331122370414423
"""rad: omega_1 T_s that maximises eq. (4); the positive root of tan(u / 2) = u."""

RANGE_MARGIN = 1e-6
"""m: how far inside R a point must lie to count on its range; eq. (5) puts one exactly on R."""

FIRST_STRAIGHT_LIMIT = 0.9
"""A_0 / R at most: a longer first straight could lead to a circle that never touches the disc."""


class Anchor(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Where a ranging anchor stands in the world frame."""

    x: Coordinate
    y: Coordinate


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the robots can do and see; the same for all of them (Section II)."""

    sensing_range: Length
    """R: anchors and robots are ranged up to this distance, bounds included"""
    period: Duration
    """T_s"""
    max_speed: Speed
    """v_max"""
    max_turn_rate: TurnRate
    """omega_max"""

    @property
    def first_straight(self) -> float:
        """A_0 in m: one tick at full speed, shortened where it would come near R."""
        return min(self.max_speed * self.period, FIRST_STRAIGHT_LIMIT * self.sensing_range)


class Orbit(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A circle about the robot's own anchor, driven without end (Section III.B)."""

    radius: Range
    v: Velocity
    omega: AngularVelocity
    """its sign is the sense"""


class Rendezvous(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """How the two robots of a pair orbit so that they meet; worked out once, then told to both."""

    a: Orbit
    b: Orbit
    bound: Time
    """s: T_max, the longest that both orbit before they are in range of each other"""


def half_arc(distance: float, sensing_range: float) -> float:
    """Omega in rad: half the angle, seen from an anchor, between the crossings of the paper's orbits."""
    return math.acos(distance / (distance + sensing_range))


def longest_meeting(mission: Mission, distance: float, omega_b: float) -> float:
    """T_max in s (Section III.B, in continuous time): b's way round, and twice over the arc 2 Omega."""
    return (TAU + 2.0 * half_arc(distance, mission.sensing_range)) / abs(omega_b)


def orbit_margin(mission: Mission, distance: float, speed: float) -> float:
    """m0 in m: how far inside (D + R) / 2 the orbits must be for sampling not to skip the encounter.

    The paper's orbits meet only tangentially; at `speed` (m/s) the robots pass each other with
    v (1 - Omega / pi). Empirical: T_max was never exceeded in any setting tried; not proved.
    """
    v = min(speed, mission.max_turn_rate * 0.5 * (distance + mission.sensing_range))
    return (v * mission.period * _closing(mission, distance)) ** 2 / (16.0 * mission.sensing_range)


def _closing(mission: Mission, distance: float) -> float:
    """1 - Omega / pi: the relative speed of the two orbits, over that of a."""
    return 1.0 - half_arc(distance, mission.sensing_range) / math.pi


def rendezvous(mission: Mission, distance: float, variant: Variant) -> Rendezvous:
    """The orbits of eq. (6) for anchors `distance` m (D) apart.

    The assured ones are smaller by the margin, and no faster than lets it be a quarter of R.
    """
    radius, speed = 0.5 * (distance + mission.sensing_range), mission.max_speed
    if variant == "assured":
        speed = min(speed, 2.0 * mission.sensing_range / (mission.period * _closing(mission, distance)))
        radius -= orbit_margin(mission, distance, speed)
    omega_a = min(mission.max_turn_rate, speed / radius)
    omega_b = -half_arc(distance, mission.sensing_range) / math.pi * omega_a
    return Rendezvous(
        a=Orbit(radius, omega_a * radius, omega_a),
        b=Orbit(radius, -omega_b * radius, omega_b),
        bound=longest_meeting(mission, distance, omega_b),
    )


def tick_budget(mission: Mission, plan: Rendezvous) -> int:
    """max_ticks where the scenario names none: twice T_max, and ample time for phases 1 and 3."""
    turn = math.ceil(TAU / (mission.max_turn_rate * mission.period))
    reach = max(plan.a.radius, plan.b.radius) + mission.sensing_range
    radial = math.ceil(reach / (mission.max_speed * mission.period))
    circle_rate = min(mission.max_turn_rate, mission.max_speed / mission.first_straight)
    circle = math.ceil(TAU / (circle_rate * mission.period))
    return 2 * math.ceil(plan.bound / mission.period) + 2 * circle + radial + 6 * turn + 50


def third_point_turn_rate(mission: Mission) -> float:
    """omega_1 in rad/s: the best of eq. (4) within omega_max."""
    return min(OPTIMAL_TURN / mission.period, mission.max_turn_rate)
