"""The parameters of a mission (Section II), and the checks whether a robot can localise itself with them."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from protocol.motion import TAU
from protocol.noise import Noise
from protocol.rounding import EPSILON, SAME_ANCHORS, SURE, required_anchor_error, rounding
from protocol.units import Clearance, Coordinate, Duration, Finite, Integer, Length, Speed, TurnRate

PlannerName = Annotated[
    str, Meta(pattern=r"\A[A-Za-z_][A-Za-z0-9_.-]*(:[A-Za-z_][A-Za-z0-9_]*)?\Z", max_length=64)
]
"""The name of a planner: of one that is shipped or installed, or MODULE:CLASS.

`paper` is the algorithm as published, `assured` also handles its failure cases.
"""

Option = Annotated[str, Meta(pattern=r"\A[A-Za-z_][A-Za-z0-9_]*\Z", max_length=64)]
"""The name of an option of a planner or of a model."""
OptionValue = bool | Integer | Finite | Annotated[str, Meta(max_length=300)]
"""The value of an option."""
Options = Annotated[dict[Option, OptionValue], Meta(max_length=32)]
"""The options of a planner or of a model: the keyword arguments of its class."""

Role = Literal["a", "b"]
"""The role of a robot in its pair: when the two meet, a moves first, and b stops (Section III.C)."""
ROLES: tuple[Role, Role] = ("a", "b")
"""The two roles."""

OPTIMAL_TURN = 2.331122370414423
"""The angle omega_1 T_s in rad that maximises eq. (4): the positive root of tan(u / 2) = u."""

RANGE_MARGIN = 1e-6
"""The distance inside R, in m, from which a range is expected. Eq. (5) puts a point exactly on R."""

FIRST_STRAIGHT_LIMIT = 0.9
"""The maximum of A_0 / R. After a longer first straight, the circle about q_0 might never be in range."""


SHORTEST_STEP = 1e-4
"""The minimum of A_0 in m. Positions closer to each other are hardly distinct beside RANGE_MARGIN."""

AMPLIFIED = 500.0
"""The assumed rounding error of a mutual range, in units of EPSILON (D + R).

`infeasibility` divides it by the length A_0 of a manoeuvre, which gives an error of the pose. The value was
found on random settings: `assured` localises in all settings that it allows.
"""

MOST_RANGES_NEEDED = 1e4
"""The maximum of (sigma / accuracy)^2, the number of ranges whose mean has the required accuracy.

Each range takes a tick. A typical mission has about a hundred.
"""


class Anchor(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The position of a ranging anchor in the world frame <W>."""

    x: Coordinate
    """The x coordinate, in m."""
    y: Coordinate
    """The y coordinate, in m."""


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The limits, sensors and required accuracy of the robots; the same for all of them (Section II)."""

    sensing_range: Length
    """The sensing range R in m: the largest distance, inclusive, at which anchors and robots are ranged."""
    period: Duration
    """The sampling period T_s in s, the duration of a tick."""
    max_speed: Speed
    """The maximum forward speed v_max in m/s."""
    max_turn_rate: TurnRate
    """The maximum turn rate omega_max in rad/s."""
    accuracy: Length = 0.1
    """The accuracy in m that both robots need for a claim: the maximum square root of the trace of the
    covariance of their position."""
    confidence: Annotated[float, Meta(ge=0.5, lt=1.0)] = 0.9999
    """The minimum probability of a hypothesis that is claimed."""
    safety_distance: Clearance = 0.0
    """The minimum distance in m between two robots that are in contact."""
    noise: Noise = Noise()
    """The noise of sensors and motion."""

    @cached_property
    def first_straight(self) -> float:
        """The length A_0 in m of the first manoeuvre: one tick at v_max, at most FIRST_STRAIGHT_LIMIT R."""
        return min(self.max_speed * self.period, FIRST_STRAIGHT_LIMIT * self.sensing_range)

    @property
    def required_anchor_sigma(self) -> float:
        """The accuracy in m to which a robot must know its anchor's position before phase 2.

        This is the maximum square root of the trace of the covariance. The anchors are the two points that
        fix both robots in <W>.
        """
        return min(self.accuracy, MAX_ANCHOR_SIGMA * self.sensing_range)

    @property
    def orienting_distance(self) -> float:
        """The distance in m of two anchors from which on noisy ranges determine the headings of their robots.

        It is ORIENTING sigmas of the less accurate ranges, and 0 for exact ones.
        """
        return ORIENTING * max(self.noise.anchor_sigma, self.noise.mutual_sigma)


ORIENTING = 3.0
"""The least distance of two anchors whose robots meet in a group, in sigmas of a range.

Two robots determine their headings in <W> only from the vector between their anchors: with D = 0, both could
be turned about the common anchor, and no range would change. With sigma = 0.05 m, 3, 7 and 11 of 12 pairs
were localised within 600 ticks at 0.03, 0.06 and 0.10 m, and all within 44 ticks at 0.15 m. With more, plans
are longer for nothing.
"""

HEADING_ACCURACY = 0.2
"""The maximum standard deviation in rad of a claimed heading.

With a larger one, the linearised covariance no longer describes the distribution of the position.
"""

MAX_ANCHOR_SIGMA = 0.05
"""The maximum of `required_anchor_sigma`, as a fraction of R.

A larger one makes the margin of the orbit too large.
"""


def infeasibility(mission: Mission, distance: float) -> str | None:
    """Return why robots with anchors `distance` m (D) apart cannot localise themselves, or None if they can.

    This is about rounding errors. `noise_infeasibility` checks the noise.
    """
    step, reach = mission.first_straight, mission.sensing_range
    if step < SHORTEST_STEP * (1.0 - EPSILON):
        return (
            f"a robot moves at most {step:.3g} m in a tick, and ranges are only distinct from "
            f"{SHORTEST_STEP:g} m on: raise max_speed or period"
        )
    size = distance + reach
    if AMPLIFIED * EPSILON * size * max(1.0, reach / distance) * max(1.0, size) / step > SURE:
        which = "mutual"
    elif PHASE_1_MARGIN * _anchor_error(mission, size) > required_anchor_error(size, distance, reach):
        which = "anchor"
    else:
        return None
    return (
        f"with {distance:.6g} m between the anchors and ranges up to {reach:.6g} m, manoeuvres of "
        f"{step:.3g} m are too short to compute a pose from {which} ranges to a micrometre in double "
        "precision: raise max_speed or period"
    )


PHASE_1_MARGIN = 1.2
"""The factor by which the best anchor error of phase 1 must be below the required one.

The manoeuvres of phase 1 are not optimal, so it does not reach the best error.
"""


def _anchor_error(mission: Mission, size: float) -> float:
    """Return the anchor error in m that phase 1 reaches from the worst starts, which are on the rim of range.

    Each range has an error of `rounding`. The fitted heading has that error divided by the distance driven
    across the radius. There are two worst cases:

    - The robot heads along the radius. Its first two ranges contain no information about its heading. In each
      further tick it drives A_0, and turns as much as it can.
    - The robot heads along the tangent. It measures its second range on a circle of radius A_0, after a
      quarter turn on the spot and at most two thirds of the circle.
    """
    step, reach = mission.first_straight, mission.sensing_range
    turn = min(third_point_turn_rate(mission) * mission.period, math.pi)
    radial, y, across, moment = math.inf, 0.0, 0.0, 0.0
    for k in range(1, math.ceil(math.pi / turn) + 1):
        y = min(y + step * math.sin((k - 0.5) * turn) * math.sin(0.5 * turn) / (0.5 * turn), 0.5 * reach)
        across, moment = across + 2.0 * reach * y, moment + y * y
        floor = rounding(size, k + 2, (k + 2) * step, k * turn)
        radial = min(radial, floor * (1.0 + SAME_ANCHORS + across / moment))
        if floor * (1.0 + SAME_ANCHORS + 4.0) > radial:  # y is at most R / 2, so the ratio stays above 4
            break
    round_it = 0.5 * math.pi + 2.0 * TAU / 3.0
    floor = rounding(size, 6, (TAU + 4.0) * step, round_it)
    return max(radial, floor * (1.0 + SAME_ANCHORS + 2.0 * reach / step))


def safety_infeasibility(mission: Mission) -> str | None:
    """Return the field name and why robots cannot keep `safety_distance`, or None if they can."""
    warned = mission.sensing_range - 2.0 * mission.max_speed * mission.period
    if mission.safety_distance <= max(0.0, warned):
        return None
    return (
        f"safety_distance: {mission.safety_distance:.6g} m, but robots that approach each other at max_speed "
        f"may be {max(0.0, warned):.6g} m apart at their first contact (sensing_range - 2 max_speed period)"
    )


MOST_OUTLIERS = 0.25
"""The maximum fraction of outliers among all ranges. With 0.5, 2 of 23 claims were wrong."""


SMALLEST_NOISE = 1e-300
"""The smallest positive value of a field of the noise: half of the smallest floating-point number is 0."""


def too_small(noise: Noise) -> str | None:
    """Return the field of `noise` that is too small to compute with, and why; None if there is none."""
    for name, value in (("sigma_degrees", noise.sigma_degrees), ("strays", noise.strays)):
        if 0.0 < value < SMALLEST_NOISE:
            return f"noise.{name}: set 0 or at least {SMALLEST_NOISE:g}: {value:g} is too small to divide"
    return None


def noise_infeasibility(mission: Mission) -> str | None:
    """Return the field and why robots cannot localise themselves with this noise, or None if they can."""
    noise, reach, accuracy = mission.noise, mission.sensing_range, mission.accuracy
    if noise.exact:
        return None
    for name, sigma in (("anchor_sigma", noise.anchor_sigma), ("mutual_sigma", noise.mutual_sigma)):
        if sigma > reach:
            return (
                f"noise.{name}: a range with an error of {sigma:.6g} m contains no more information than its "
                f"detection within mission.sensing_range = {reach:.6g} m"
            )
        if (sigma / accuracy) ** 2 > MOST_RANGES_NEEDED:
            return (
                f"accuracy: {accuracy:.3g} m takes the mean of more than {MOST_RANGES_NEEDED:g} ranges with "
                f"mission.noise.{name} = {sigma:.3g} m"
            )
    if noise.outliers > MOST_OUTLIERS:
        return f"noise.outliers: with more than {MOST_OUTLIERS:g}, all ranges that agree may be outliers"
    if accuracy > reach * math.sqrt(0.5):  # the root of the trace for a uniform distribution on the disc of R
        return (
            f"accuracy: any robot in range of its anchor knows its position to {accuracy:.3g} m, as "
            f"mission.sensing_range = {reach:.3g} m"
        )
    for field, velocity in (("actuation", noise.actuation), ("odometry", noise.odometry)):
        if velocity.v_floor > mission.max_speed:
            return f"noise.{field}.v_floor: more than mission.max_speed = {mission.max_speed:.6g} m/s"
        if velocity.omega_floor > mission.max_turn_rate:
            return (
                f"noise.{field}.omega_floor: more than mission.max_turn_rate = "
                f"{mission.max_turn_rate:.6g} rad/s"
            )
    return None


def third_point_turn_rate(mission: Mission) -> float:
    """Return the turn rate omega_1 in rad/s that maximises eq. (4) within omega_max."""
    return min(OPTIMAL_TURN / mission.period, mission.max_turn_rate)
