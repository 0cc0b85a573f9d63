"""What the robots can do and see, and what follows from it (Section II)."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from protocol.motion import TAU
from protocol.noise import Noise
from protocol.rounding import EPSILON, SAME, SURE, required_anchor_error, rounding
from protocol.units import Clearance, Coordinate, Duration, Length, Speed, TurnRate

PlannerName = Literal["assured", "paper"]
"""`paper` plays the paper to the letter; `assured` also cures what fails in it."""

Role = Literal["a", "b"]
"""a moves first when the two meet, b stands (Section III.C)."""

OPTIMAL_TURN = 2.331122370414423
"""rad: omega_1 T_s that maximises eq. (4); the positive root of tan(u / 2) = u."""

RANGE_MARGIN = 1e-6
"""m: how far inside R a point must lie to count on its range; eq. (5) puts one exactly on R."""

FIRST_STRAIGHT_LIMIT = 0.9
"""A_0 / R at most: a longer first straight could lead to a circle that never touches the disc."""


SHORTEST_STEP = 1e-4
"""m: with manoeuvres A_0 that are shorter, places would be no farther apart than RANGE_MARGIN leaves of
them"""

AMPLIFIED = 500.0
"""EPSILON of the size, in a range of the encounter, that A_0 (D + R) / max(1, R / D) must be able to bear:
found on random settings, where `assured` gets on with any that it allows"""

MOST_RANGES = 1e4
"""(sigma / accuracy)^2 at most: so many ranges it takes to average sigma down to the accuracy, each of them
in a tick of its own; a mission has some hundred"""


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
    accuracy: Length = 0.1
    """m: how well both robots must know where they are before they claim to: the root of the trace of the
    covariance of their position"""
    confidence: Annotated[float, Meta(ge=0.5, lt=1.0)] = 0.9999
    """how probable the hypothesis must be that they claim"""
    safety_distance: Clearance = 0.0
    """m: two robots that range each other come no nearer"""
    noise: Noise = Noise()

    @property
    def first_straight(self) -> float:
        """A_0 in m: one tick at full speed, shortened where it would come near R."""
        return min(self.max_speed * self.period, FIRST_STRAIGHT_LIMIT * self.sensing_range)

    @property
    def foothold(self) -> float:
        """m: how well a robot has to know where its anchor is before it goes to meet the peer.

        The root of the trace of the covariance. The anchors are the two points that fix both robots in <W>.
        """
        return min(self.accuracy, FOOTHOLD * self.sensing_range)


HEADING_ACCURACY = 0.2
"""rad: how well they must know their headings before they claim to, as a standard deviation; with a heading
less well known than this the ellipse is no likeness of what is possible"""

FOOTHOLD = 0.05
"""of R: with a worse one, the orbit's margin would take too much of R"""


def infeasibility(mission: Mission, distance: float) -> str | None:
    """Why robots with anchors `distance` m (D) apart could not be sure of their poses; None if they can."""
    step, reach = mission.first_straight, mission.sensing_range
    if step < SHORTEST_STEP * (1.0 - EPSILON):
        return (
            f"a tick moves a robot by {step:.3g} m at most; from less than {SHORTEST_STEP:g} m, ranges tell "
            "nothing for sure: raise max_speed or period"
        )
    size = distance + reach
    if AMPLIFIED * EPSILON * size * max(1.0, reach / distance) * max(1.0, size) / step > SURE:
        which = "mutual"
    elif MARGIN * _anchor_error(mission, size) > required_anchor_error(size, distance, reach):
        which = "anchor"
    else:
        return None
    return (
        f"with {distance:.6g} m between the anchors and ranges up to {reach:.6g} m, manoeuvres of "
        f"{step:.3g} m are too short for a pose to be sure to a micrometre in double precision, by the "
        f"{which} ranges: raise max_speed or period"
    )


MARGIN = 1.2
"""by which phase 1 must be able to find an anchor better than it has to: its manoeuvres are not the best
ones"""


def _anchor_error(mission: Mission, size: float) -> float:
    """Return how exactly (m) phase 1 finds the anchor from the worst starts, both on the rim.

    The ranges are off by `rounding`, and the fit of the heading (`belief.anchor_error`) by that over the
    way off the radius. Heading along the radius, the first two ranges tell nothing of it, and each further
    tick leads A_0 on and turns by as much as it can. Heading along the tangent, the second range is that at
    the end of a circle of radius A_0, after a quarter turn on the spot and at most two thirds of the way
    round.
    """
    step, reach = mission.first_straight, mission.sensing_range
    turn = min(third_point_turn_rate(mission) * mission.period, math.pi)
    radial, y, across, moment = math.inf, 0.0, 0.0, 0.0
    for k in range(1, math.ceil(math.pi / turn) + 1):
        y = min(y + step * math.sin((k - 0.5) * turn) * math.sin(0.5 * turn) / (0.5 * turn), 0.5 * reach)
        across, moment = across + 2.0 * reach * y, moment + y * y
        floor = rounding(size, k + 2, (k + 2) * step, k * turn)
        radial = min(radial, floor * (1.0 + SAME + across / moment))
    round_it = 0.5 * math.pi + 2.0 * TAU / 3.0
    floor = rounding(size, 6, (TAU + 4.0) * step, round_it)
    return max(radial, floor * (1.0 + SAME + 2.0 * reach / step))


def safety_infeasibility(mission: Mission) -> str | None:
    """The field, and why `safety_distance` could not be kept; None if it can."""
    warned = mission.sensing_range - 2.0 * mission.max_speed * mission.period
    if mission.safety_distance <= max(0.0, warned):
        return None
    return (
        f"safety_distance: {mission.safety_distance:.6g} m, where two robots that come into range of each "
        f"other at max_speed may be {max(0.0, warned):.6g} m apart before they know "
        "(sensing_range - 2 max_speed period)"
    )


MOST_OUTLIERS = 0.25
"""of all ranges: with half of them, 2 claims of 23 tried were wrong"""


def noise_infeasibility(mission: Mission) -> str | None:
    """The field, and why no robot could be sure of its pose with such noise; None if it can."""
    noise, reach, accuracy = mission.noise, mission.sensing_range, mission.accuracy
    if noise.exact:
        return None
    for name, sigma in (("anchor_sigma", noise.anchor_sigma), ("mutual_sigma", noise.mutual_sigma)):
        if sigma > reach:
            return (
                f"noise.{name}: a range that errs by {sigma:.6g} m says less than that there is one, up to "
                f"mission.sensing_range = {reach:.6g} m"
            )
        if (sigma / accuracy) ** 2 > MOST_RANGES:
            return (
                f"accuracy: {accuracy:.3g} m is the mean of more than {MOST_RANGES:g} ranges with "
                f"mission.noise.{name} = {sigma:.3g} m"
            )
    if noise.outliers > MOST_OUTLIERS:
        return f"noise.outliers: with more than {MOST_OUTLIERS:g} of them, those that agree may all be wrong"
    if accuracy > reach * math.sqrt(0.5):  # the root of the trace, of a point anywhere in a disc of radius R
        return (
            f"accuracy: a robot anywhere in range of its anchor knows where it is to {accuracy:.3g} m, where "
            f"mission.sensing_range = {reach:.3g} m"
        )
    for wheels, drift in (("actuation", noise.actuation), ("odometry", noise.odometry)):
        if drift.v_floor > mission.max_speed:
            return f"noise.{wheels}.v_floor: more than mission.max_speed = {mission.max_speed:.6g} m/s"
        if drift.omega_floor > mission.max_turn_rate:
            return (
                f"noise.{wheels}.omega_floor: more than mission.max_turn_rate = "
                f"{mission.max_turn_rate:.6g} rad/s"
            )
    return None


def third_point_turn_rate(mission: Mission) -> float:
    """omega_1 in rad/s: the best of eq. (4) within omega_max."""
    return min(OPTIMAL_TURN / mission.period, mission.max_turn_rate)
