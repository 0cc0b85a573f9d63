"""The orbits of phase 2, on which the two robots of a pair meet, and the time this takes (Section III.B).

With the `paper` planner, both robots orbit, in opposite directions. With `assured`, b waits beside its
anchor, and a orbits on a circle that crosses b's sensing range wherever b waits. `docs/rendezvous.py`
compares all pairs of circles with constant speeds. The fastest of them are of this kind, with b exactly on
its anchor, and 5 % faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, cached_property
from itertools import pairwise

import msgspec

from protocol.mission import RANGE_MARGIN, Mission, Role
from protocol.motion import TAU, Controls
from protocol.units import AngularVelocity, Range, Time, Velocity

WAITING_PLACE = 0.125
"""The distance of waiting b from its anchor, as a fraction of R.

On the anchor, b's ranges would contain no information about its heading. Each further metre makes a's circle
2 pi m longer.
"""

PASSAGE = 1.5
"""The minimum duration in ticks of a's passage through b's range.

One tick is needed for a range, and the rest is room for the next manoeuvre, which is straight.
"""

RADII = 400
"""The number of radii of a's orbit that are compared. Twice as many change no meeting by a tick."""


class Orbit(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, dict=True):
    """A circle about the robot's own anchor; with speed 0, a position at this distance from the anchor."""

    radius: Range
    """The radius, in m."""
    v: Velocity
    """The forward velocity, in m/s; 0 to wait."""
    omega: AngularVelocity
    """The angular velocity, in rad/s; positive is counter-clockwise."""

    @cached_property
    def controls(self) -> Controls:
        """The controls on the orbit (eq. (6)), or at rest."""
        return Controls(self.v, self.omega)


class Rendezvous(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The orbits of both robots of a pair, computed once and sent to both in their RobotConfig."""

    a: Orbit
    """The orbit of a."""
    b: Orbit
    """The orbit of b."""
    bound: Time
    """The upper bound T_max in s of the time on the orbits until the robots are in range of each other."""

    def of(self, role: Role) -> Orbit:
        """Return the orbit of the robot with this role."""
        return self.a if role == "a" else self.b

    @property
    def a_searches(self) -> bool:
        """True if a orbits in search of b, which waits: then a can search again without telling b."""
        return self.a.v != 0.0 and self.b.v == 0.0


def tick_budget(mission: Mission, plan: Rendezvous) -> int:
    """Return the default of `max_ticks`: twice T_max, and ample time for phases 1 and 3.

    With noise, a may miss b and begin again at phase 1, so there is ample time for a second attempt.
    """
    attempts = 1 if mission.noise.exact or not plan.a_searches else 2
    return math.ceil(plan.bound / mission.period) + attempts * pair_ticks(mission, plan)


def pair_ticks(mission: Mission, plan: Rendezvous) -> int:
    """Return the ticks until a pair is localised: T_max, and ample time for phases 1 and 3."""
    reach = max(plan.a.radius, plan.b.radius) + mission.sensing_range
    radial = math.ceil(reach / (mission.max_speed * mission.period))
    return math.ceil(plan.bound / mission.period) + radial + 2 * meeting_ticks(mission)


def meeting_ticks(mission: Mission) -> int:
    """Return ample time in ticks for phase 1 or 3: a circle of radius A_0, turns, and some manoeuvres."""
    turn = math.ceil(TAU / (mission.max_turn_rate * mission.period))
    circle_rate = min(mission.max_turn_rate, mission.max_speed / mission.first_straight)
    circle = math.ceil(TAU / (circle_rate * mission.period))
    return circle + 3 * turn + 25


SHORT_OF_ANCHOR = 0.5
"""The distance from the visited robot's anchor at which a visitor stops, as a fraction of R.

The robot waits R / 8 from its anchor, so it is in range there; and on the anchor, the ranges to it would not
depend on where it waits.
"""

SEARCH_SIDES = 4
"""The number of sides of a visitor's search across its way, if its heading is not too inaccurate for that.

With exact sensors, a robot that is not in range at the end of the way is not there.
"""


def search_legs(sides: int) -> int:
    """Return the number of legs of so many sides of a search; see `leg_end`."""
    return max(2 * sides - 1, 0)


def leg_end(leg: int) -> float:
    """Return how far to the left of its way leg `leg`, from 1 on, of a visitor's search ends, in units of R.

    The sides end at 2, -4, 6, -8, ...: to the left and to the right in turn. Each but the first has two legs.
    The first of them leads to the end of the last side in this direction: 2, 0, -4, 2, 6, -4, -8, ... So a
    leg to places that have not been searched is 4 R long at most, and near the arc on which the robot may be.
    """
    side = leg // 2 + 1
    away = 2.0 * side if leg % 2 else 2.0 * (side - 2)
    return away if side % 2 else 0.0 - away


def search_ticks(mission: Mission, sides: int) -> int:
    """Return the ticks of so many sides of a visitor's search; 0 with exact sensors."""
    if mission.noise.exact:
        return 0
    ends = [-SHORT_OF_ANCHOR, *map(leg_end, range(1, search_legs(sides) + 1))]
    ways = [mission.sensing_range * abs(end - begin) for begin, end in pairwise(ends)]
    turn = math.ceil(math.pi / (mission.max_turn_rate * mission.period))
    return sum([math.ceil(way / (mission.max_speed * mission.period)) + turn for way in ways])


# --- the orbits of the `paper` planner ----------------------------------------------------------------


def half_arc(distance: float, sensing_range: float) -> float:
    """Return Omega in rad: half the angle between the crossings of the two orbits, seen from an anchor."""
    return math.acos(distance / (distance + sensing_range))


def longest_meeting(mission: Mission, distance: float, omega_b: float) -> float:
    """Return T_max in s: the time in which b completes its circle, with the arc 2 Omega travelled twice."""
    return (TAU + 2.0 * half_arc(distance, mission.sensing_range)) / abs(omega_b)


def orbiting(mission: Mission, distance: float) -> Rendezvous:
    """Return the orbits of eq. (6): both have the radius (D + R) / 2, and the directions are opposite."""
    radius = 0.5 * (distance + mission.sensing_range)
    omega_a = min(mission.max_turn_rate, mission.max_speed / radius)
    omega_b = -half_arc(distance, mission.sensing_range) / math.pi * omega_a
    return Rendezvous(
        a=Orbit(radius, omega_a * radius, omega_a),
        b=Orbit(radius, -omega_b * radius, omega_b),
        bound=longest_meeting(mission, distance, omega_b),
    )


# --- the orbits of the `assured` planner --------------------------------------------------------------


def searching(mission: Mission, distance: float) -> Rendezvous:
    """Return orbits on which b waits R / 8 from its anchor, and a crosses b's range slowly.

    The radius is the one with the shortest mean time to the meeting: the way out to the orbit, and half of
    the way round. If R is so large that the robots are in range of each other wherever they wait, a waits,
    too.

    The bound follows from the geometry. Wherever b waits, at least `2 half` rad of a's circle are in its
    range. From outside, a travels at most `TAU - 2 half` rad until it is in range. It never steps over the
    passage, because omega T_s is less than `2 half`.
    """
    reach, period = mission.sensing_range - RANGE_MARGIN - clearance(mission, distance), mission.period
    waiting = Orbit(WAITING_PLACE * mission.sensing_range, 0.0, 0.0)
    near, far = abs(distance - waiting.radius), distance + waiting.radius
    if far < reach:
        return Rendezvous(Orbit(min(reach - far, waiting.radius), 0.0, 0.0), waiting, 0.0)
    best = math.inf
    for i in range(1, RADII):  # denser near the smallest radius, where the best one usually is
        radius = (far - reach) + (near + reach - (far - reach)) * (i / RADII) ** 2
        half = min(half_passage(near, radius, reach), half_passage(far, radius, reach))
        omega = min(mission.max_turn_rate, mission.max_speed / radius, 2.0 * half / (PASSAGE * period))
        cost = (math.pi - half) / omega + radius / mission.max_speed
        if cost < best:
            best = cost
            ticks = math.ceil((TAU - 2.0 * half) / (omega * period))
            plan = Rendezvous(Orbit(radius, omega * radius, omega), waiting, ticks * period)
    return plan


def visiting(mission: Mission, distance: float) -> Rendezvous:
    """Return the orbits of a robot that knows its pose and drives straight to one that waits.

    `distance` (m) is that of their anchors. The bound is the time of that way.
    """
    waiting = Orbit(WAITING_PLACE * mission.sensing_range, 0.0, 0.0)
    return Rendezvous(Orbit(distance, 0.0, 0.0), waiting, distance / mission.max_speed)


def clearance(mission: Mission, distance: float) -> float:
    """Return the margin in m for the error of the distance between a and b; 0 with exact sensors and motion.

    The error comes from the anchor's position after phase 1, and from odometry noise on the orbit.
    """
    if mission.noise.exact:
        return 0.0
    known = mission.required_anchor_sigma
    odometry_error = mission.noise.odometry.omega * math.pi / 2 * distance
    return min(CLEARANCE_SIGMAS * math.hypot(known, odometry_error), CLEARANCE_LIMIT * mission.sensing_range)


CLEARANCE_SIGMAS = 3.0
"""The number of standard deviations in the margin."""
CLEARANCE_LIMIT = 0.4
"""The maximum of the margin, as a fraction of R. With a larger one, a's orbit would take too long."""


def half_passage(apart: float, radius: float, reach: float) -> float:
    """Return half the arc, in rad, of a circle of `radius` m about M1 that is within `reach` m of a point.

    The point is `apart` m from M1. For `apart` in [D - r, D + r], the angle has its minimum at an end: its
    cosine is convex in `apart` if the circle is larger than `reach`, and increases with `apart` otherwise.
    """
    cosine = (apart * apart + radius * radius - reach * reach) / (2.0 * apart * radius)
    return math.acos(min(1.0, max(-1.0, cosine)))


# --- the orbits of each shipped planner ---------------------------------------------------------------

RENDEZVOUS: dict[str, Callable[[Mission, float], Rendezvous]] = {
    "paper": orbiting,
    "assured": searching,
}
"""The orbits of each shipped planner, for a mission and the distance D in m between the anchors."""


@cache
def rendezvous(mission: Mission, distance: float, planner_name: str) -> Rendezvous:
    """Return the orbits of a shipped planner for anchors `distance` m (D) apart."""
    return RENDEZVOUS[planner_name](mission, distance)
