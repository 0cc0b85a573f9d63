"""How the two robots of a pair meet: where each orbits, and how long that takes at most (Section III.B).

The paper has both orbit, in opposite senses. In `assured`, b waits beside its anchor and a goes round on
the circle that passes b's range whichever way b lies. Of all pairs of circles and constant speeds, those
that `docs/rendezvous.py` finds to meet soonest are of this kind, with b on its anchor, and gain 5 %.
"""

from __future__ import annotations

import math
from functools import cache

import msgspec

from protocol.mission import RANGE_MARGIN, Mission, PlannerName, Role
from protocol.motion import TAU
from protocol.units import AngularVelocity, Range, Time, Velocity

WAITING_PLACE = 0.125
"""of R: how far from its anchor b waits. Not on it: there its ranges would not tell its heading; and not
farther than that takes, since each metre lengthens a's way round by two pi"""

PASSAGE = 1.5
"""ticks at least that a is in b's range at each pass: one, to be measured, and room to go straight on"""

RADII = 400
"""of a's orbit that are compared: twice as many change no meeting by a tick"""


class Orbit(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A circle about the robot's own anchor, driven without end; or, with no speed, a place on it."""

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

    def of(self, role: Role) -> Orbit:
        """The part of who plays `role`."""
        return self.a if role == "a" else self.b


@cache
def rendezvous(mission: Mission, distance: float, planner_name: PlannerName) -> Rendezvous:
    """The plan for anchors `distance` m (D) apart."""
    return orbiting(mission, distance) if planner_name == "paper" else searching(mission, distance)


def tick_budget(mission: Mission, plan: Rendezvous) -> int:
    """max_ticks where the scenario names none: twice T_max, and ample time for phases 1 and 3."""
    turn = math.ceil(TAU / (mission.max_turn_rate * mission.period))
    reach = max(plan.a.radius, plan.b.radius) + mission.sensing_range
    radial = math.ceil(reach / (mission.max_speed * mission.period))
    circle_rate = min(mission.max_turn_rate, mission.max_speed / mission.first_straight)
    circle = math.ceil(TAU / (circle_rate * mission.period))
    return 2 * math.ceil(plan.bound / mission.period) + 2 * circle + radial + 6 * turn + 50


# --- the paper's --------------------------------------------------------------------------------------


def half_arc(distance: float, sensing_range: float) -> float:
    """Omega in rad: half the angle, seen from an anchor, between the crossings of the paper's orbits."""
    return math.acos(distance / (distance + sensing_range))


def longest_meeting(mission: Mission, distance: float, omega_b: float) -> float:
    """T_max in s, in continuous time: b's way round, and twice over the arc 2 Omega."""
    return (TAU + 2.0 * half_arc(distance, mission.sensing_range)) / abs(omega_b)


def orbiting(mission: Mission, distance: float) -> Rendezvous:
    """The paper's orbits, eq. (6): of radius (D + R) / 2, in opposite senses."""
    radius = 0.5 * (distance + mission.sensing_range)
    omega_a = min(mission.max_turn_rate, mission.max_speed / radius)
    omega_b = -half_arc(distance, mission.sensing_range) / math.pi * omega_a
    return Rendezvous(
        a=Orbit(radius, omega_a * radius, omega_a),
        b=Orbit(radius, -omega_b * radius, omega_b),
        bound=longest_meeting(mission, distance, omega_b),
    )


# --- one waits, one searches --------------------------------------------------------------------------


def searching(mission: Mission, distance: float) -> Rendezvous:
    """b waits R / 8 from its anchor; a orbits where it passes b's range, and so slowly that it is measured.

    Of the radii that do, the one on which a is there soonest: on its way out, and half round in the mean.
    Where R is so far beyond D that both are in range of each other wherever they wait, a waits too.

    The bound: wherever b waits, at least `2 half` of a's circle is in its range. From outside, a has at most
    `TAU - 2 half` to drive until it is in; and as omega T_s is less than `2 half`, no tick jumps the passage.
    """
    reach, period = mission.sensing_range - RANGE_MARGIN - clearance(mission, distance), mission.period
    waiting = Orbit(WAITING_PLACE * mission.sensing_range, 0.0, 0.0)
    near, far = abs(distance - waiting.radius), distance + waiting.radius
    if far < reach:
        return Rendezvous(Orbit(min(reach - far, waiting.radius), 0.0, 0.0), waiting, 0.0)
    best = math.inf
    for i in range(1, RADII):  # more of them near the smallest, where the best mostly is
        radius = (far - reach) + (near + reach - (far - reach)) * (i / RADII) ** 2
        half = min(half_passage(near, radius, reach), half_passage(far, radius, reach))
        omega = min(mission.max_turn_rate, mission.max_speed / radius, 2.0 * half / (PASSAGE * period))
        cost = (math.pi - half) / omega + radius / mission.max_speed
        if cost < best:
            best = cost
            ticks = math.ceil((TAU - 2.0 * half) / (omega * period))
            plan = Rendezvous(Orbit(radius, omega * radius, omega), waiting, ticks * period)
    return plan


def clearance(mission: Mission, distance: float) -> float:
    """m: by how much a and b may be nearer or farther than they think, for what a robot knows when phase 1 is
    done and how its odometry drifts on the way; none where sensors and wheels are exact."""
    if mission.noise.exact:
        return 0.0
    known = mission.foothold
    drift = mission.noise.odometry.omega * math.pi / 2 * distance
    return min(CLEARANCE_SIGMAS * math.hypot(known, drift), CLEARANCE_LIMIT * mission.sensing_range)


CLEARANCE_SIGMAS = 3.0
CLEARANCE_LIMIT = 0.4
"""of R: with less left of it, a's way round would take too long"""


def half_passage(apart: float, radius: float, reach: float) -> float:
    """rad: half the arc, of a circle of `radius` about M1, that is within `reach` of a point `apart` from M1.

    On [D - r, D + r] it is least at an end: its cosine is convex in `apart` where the circle is larger
    than the reach, and grows with it where it is smaller.
    """
    cosine = (apart * apart + radius * radius - reach * reach) / (2.0 * apart * radius)
    return math.acos(min(1.0, max(-1.0, cosine)))
