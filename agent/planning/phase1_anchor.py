"""Phase 1: all that one anchor can tell (Section III.A)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import msgspec

from agent.estimation.exact import Branch
from agent.planning.range_seeking import ARRIVED
from protocol.mission import RANGE_MARGIN, Mission, PlannerName, third_point_turn_rate
from protocol.motion import Controls, Pose, chord, compose

PREFERENCE = 1e-9
"""a later choice must be better than an earlier one by more than rounding"""


SIGMAS = 3.0
"""of a range: how far inside R a point must lie under noise to count on its range"""


class ThirdPoint(msgspec.Struct, frozen=True):
    """Drives to where the branches that are left predict different ranges (eqs. (3) to (5))."""

    branches: tuple[Branch, ...]
    origin: Pose
    command: Controls


def third_point(
    places: Sequence[Pose],
    mission: Mission,
    planner_name: PlannerName,
    *,
    margin: float = RANGE_MARGIN,
    pinning: bool = False,
) -> Controls | None:
    """The manoeuvre whose end tells best which of `places` (poses in the anchor's frame) the robot is at.

    Eq. (4) has its best turn rate where the branches mirror each other along the heading, and is best
    straight ahead where they mirror across it (after a circle); both are tried, with the longest chord that
    surely leaves one branch in range, eq. (5). The letter drives forward, `assured` either way. None where
    the letter's own bound leaves no way to go. With `pinning`, one branch is left, and the ranges do not
    fix it well enough: then the end is best that is farthest off the line from the anchor through p_0,
    where a range tells most of the heading.
    """
    best: Controls | None = None
    best_value = 0.0
    shortest = ARRIVED * mission.first_straight
    rim = mission.sensing_range - max(margin, SIGMAS * mission.noise.anchor_sigma)
    turn_rate = third_point_turn_rate(mission)
    turn_rates = [turn_rate] if planner_name == "paper" else [turn_rate, -turn_rate]
    if len(places) > 1 or pinning:  # one branch was found on a radius: there, straight ahead checks nothing
        turn_rates.append(0.0)
    for omega in turn_rates:
        unit = chord(1.0, omega, mission.period)
        longest = mission.max_speed * unit
        half = 0.5 * mission.period * omega
        for forward in (1.0,) if planner_name == "paper" else (1.0, -1.0):
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
    """m: the parts of the position, seen from the anchor, along and across the chord to come."""
    course = place.heading + half_turn
    c, s = forward * math.cos(course), forward * math.sin(course)
    return place.x * c + place.y * s, place.y * c - place.x * s


def _reach(along: float, across: float, rim: float) -> float:
    """m: how far a robot can go before it is out of `rim`, eq. (5); negative where it is already."""
    inside = rim * rim - across * across
    return math.sqrt(inside) - along if inside >= 0.0 else -math.inf


def _separation(length: float, along: Sequence[float]) -> float:
    """m^2: the least difference of the squared ranges that the branches predict, |d_+^2 - d_-^2|.

    One branch has nothing to be told from; there the longest way is worth most, to check it.
    """
    if len(along) == 1:
        return length
    return 2.0 * length * min(abs(one - other) for one, other in combinations(along, 2))


def local(branches: Sequence[Branch], odometry: Pose) -> list[Pose]:
    """Where the robot is in the frame of its anchor, by each branch."""
    return [compose(branch.start, odometry) for branch in branches]
