"""Phase 1: the manoeuvre to a further range to the own anchor (Section III.A, eqs. (3) to (5))."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from agent.estimation.exact import Branch
from agent.planning.planner import Manoeuvres
from protocol.mission import RANGE_MARGIN, Mission, third_point_turn_rate
from protocol.motion import Controls, Pose, chord, compose, rotated_back

PREFERENCE = 1e-9
"""The relative improvement, above rounding errors, that a later candidate needs to replace an earlier one."""

SHORTEST_MANOEUVRE = 1e-9
"""The length of a manoeuvre, relative to A_0, up to which it counts as none."""

IN_RANGE_SIGMAS = 3.0
"""The distance inside R, in standard deviations of a range, at which a noisy point counts as in range."""


def third_point(
    places: Sequence[Pose],
    mission: Mission,
    manoeuvres: Manoeuvres,
    *,
    margin: float = RANGE_MARGIN,
    pinning: bool = False,
) -> Controls | None:
    """Return the manoeuvre whose end point best distinguishes the poses `places` in the anchor's frame.

    If the branches mirror each other along the heading, eq. (4) gives the best turn rate. If they mirror each
    other across it, as after a circle, driving straight is best. Both are compared, each with the longest
    chord that keeps at least one branch in range (eq. (5)), in the directions of `manoeuvres`.

    `margin` is the distance inside R, in m, at which a point is certainly in range. With `pinning`, one
    branch is left, but the ranges do not determine its heading accurately enough. The best end point is then
    the one farthest from the line through the anchor and p_0, because a range depends most on the heading
    there.

    The result is None if no manoeuvre satisfies eq. (5).
    """
    best: Controls | None = None
    best_value = 0.0
    shortest = SHORTEST_MANOEUVRE * mission.first_straight
    rim = mission.sensing_range - max(margin, IN_RANGE_SIGMAS * mission.noise.anchor_sigma)
    turn_rate = third_point_turn_rate(mission)
    turn_rates = [side * turn_rate for side in manoeuvres.sides]
    # A single branch was found on a radius. A straight manoeuvre along that radius would check nothing.
    if len(places) > 1 or pinning:
        turn_rates.append(0.0)
    for omega in turn_rates:
        unit = chord(1.0, omega, mission.period)
        longest = mission.max_speed * unit
        half = 0.5 * mission.period * omega
        for forward in manoeuvres.directions:
            outward = [_outward(place, half, forward) for place in places]
            reach = max(_reach(along, across, rim) for along, across in outward)
            length = min(longest, reach)
            if pinning:
                value = max(
                    [abs(place.y + forward * length * math.sin(place.heading + half)) for place in places]
                )
            else:
                value = _separation(length, [along for along, _ in outward])
            if length > shortest and (best is None or value > best_value * (1.0 + PREFERENCE)):
                best, best_value = Controls(forward * min(length / unit, mission.max_speed), omega), value
    return best


def _outward(place: Pose, half_turn: float, forward: float) -> tuple[float, float]:
    """Return the components in m of the position, relative to the anchor, along and across the next chord."""
    course = place.heading + half_turn
    c, s = forward * math.cos(course), forward * math.sin(course)
    return rotated_back(c, s, place.x, place.y)


def _reach(along: float, across: float, rim: float) -> float:
    """Return how far in m the robot can drive before it leaves the circle of radius `rim` (eq. (5)).

    The result is negative if the robot is outside.
    """
    inside = rim * rim - across * across
    return math.sqrt(inside) - along if inside >= 0.0 else -math.inf


def _separation(length: float, along: Sequence[float]) -> float:
    """Return the smallest difference |d_+^2 - d_-^2| in m^2 of the squared ranges that the branches predict.

    For a single branch the result is `length`: there is nothing to distinguish, and the longest chord gives
    the best check.
    """
    if len(along) == 1:
        return length
    return 2.0 * length * min(abs(one - other) for one, other in combinations(along, 2))


def local(branches: Sequence[Branch], odometry: Pose) -> list[Pose]:
    """Return the robot's current pose in its anchor's frame for each of `branches`."""
    return [compose(branch.start, odometry) for branch in branches]
