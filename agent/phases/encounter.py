"""Phase 3: the last manoeuvres, and which of the placements of eq. (7) is true (Section III.C)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from agent.belief import Sighting, dilution
from agent.geometry import Placement, placements
from agent.phases.seeking import travelled
from protocol.mission import RANGE_MARGIN, Mission, Variant
from protocol.motion import Controls, Pose

TURN_RATES = 721
"""values of omega_2 tried in eq. (8), -omega_max and omega_max included: every half degree at T_s = 1 s"""

SPEEDS = (1.0, -1.0, 0.75, -0.75, 0.5, -0.5, 0.25, -0.25, 0.1, -0.1)
"""values of v_2 tried, over v_max or, where that would leave the range in one tick, over A_0 / T_s"""

ELSEWHERE = 1e-6
"""m: a range taken nearer than this to where another was says nothing new"""


SMALLEST_GAP = 1e-6
"""m: a manoeuvre after which two predicted ranges differ by less tells nothing, and a longer one is taken.

Ten times `belief.MUTUAL_FLOOR`, the most by which rounding may put a true prediction off.
"""

LONGEST = 64
"""ticks of a last manoeuvre"""

ROUNDING = 64 * 2.0**-52
"""of D + R: how far rounding may put a range off its prediction"""

SURE = 1e-7
"""rad, and m at the distance D + R: how exact a pose must be to be claimed; a tenth of what is tolerated"""


class Standing(msgspec.Struct, frozen=True):
    """b stands, and waits for a's second range; or, back from a manoeuvre, for word from a."""


class Waiting(msgspec.Struct, frozen=True):
    """a stands: it has its second range, and b makes the last manoeuvre."""


class LastManoeuvre(msgspec.Struct, frozen=True):
    """b drives to where the placements that are left predict different ranges."""

    drive: Controls
    origin: Pose
    """where this tick began"""
    left: int = 1
    """ticks, this one included"""
    driven: int = 0
    """ticks before this one"""


class Returning(msgspec.Struct, frozen=True):
    """b has left a's range, and drives the same arc backwards until it can tell it."""

    drive: Controls
    origin: Pose
    left: int = 1


State = Standing | Waiting | LastManoeuvre | Returning


class Plan(NamedTuple):
    """A last manoeuvre, and what it is expected to tell."""

    drive: Controls
    ticks: int
    separation_m2: float | None
    """J of eq. (8): the least difference of two predicted squared ranges; none for one candidate"""


def base(sightings: Sequence[Sighting]) -> tuple[Sighting, Sighting] | None:
    """The two ranges that eq. (7) is solved from: the first two between which only a has moved."""
    ranged = [sighting for sighting in sightings if sighting.range is not None]
    for first in ranged:
        for second in ranged:
            if first.tick < second.tick and travelled(first.b, second.b) < ELSEWHERE < travelled(
                first.a, second.a
            ):
                return first, second
    return None


def solve(distance: float, base: tuple[Sighting, Sighting]) -> list[Placement]:
    """The placements that eq. (7) leaves after two ranges; `distance` is D."""
    first, second = base
    assert first.range is not None
    assert second.range is not None
    return placements(distance, first.b, first.a, second.a, first.range, second.range)


def redundant(sightings: Sequence[Sighting], base: tuple[Sighting, Sighting]) -> bool:
    """Whether there is a range more, from elsewhere, than the two that the placements were made from."""
    return any(
        sighting.range is not None
        and all(
            travelled(sighting.a, used.a) > ELSEWHERE or travelled(sighting.b, used.b) > ELSEWHERE
            for used in base
        )
        for sighting in sightings
    )


def pinned_down(
    placement: Placement, sightings: Sequence[Sighting], mission: Mission, distance: float
) -> bool:
    """Whether the ranges in `sightings` fix `placement` as exactly as a claim has to be."""
    size = distance + mission.sensing_range
    return dilution(placement, sightings) * ROUNDING * size * max(1.0, size) <= SURE


def advanced(state: LastManoeuvre | Returning, pose: Pose, in_contact: bool) -> State:
    """The state after a tick that led to `pose`."""
    match state:
        case LastManoeuvre(drive, _, left, driven):
            if not in_contact:
                return Returning(Controls(-drive.v, -drive.omega), pose, driven + 1)
            return LastManoeuvre(drive, pose, left - 1, driven + 1) if left > 1 else Standing()
        case Returning(drive, _, left):
            return Returning(drive, pose, left - 1) if left > 1 and not in_contact else Standing()


def last_manoeuvre(
    b: Pose,
    a: Pose,
    candidates: Sequence[Placement],
    mission: Mission,
    variant: Variant,
    before: Plan | None = None,
) -> Plan:
    """b's manoeuvre after which the ranges that `candidates` predict differ most (eq. (8), on squares).

    `b` is in <b(M2)> and `a` in <a(M1)>. One tick; in `assured` more where that would tell too little, and
    more than `before`, the last one, which has not told enough.
    """
    if variant == "paper":
        return _best(b, a, candidates, mission, variant, 1)
    ticks = 1 if before is None else min(2 * before.ticks, LONGEST)
    while True:
        plan = _best(b, a, candidates, mission, variant, ticks)
        enough = 2.0 * mission.sensing_range * SMALLEST_GAP
        if ticks == LONGEST or plan.separation_m2 is None or plan.separation_m2 >= enough:
            return plan
        ticks *= 2


def _best(
    b: Pose, a: Pose, candidates: Sequence[Placement], mission: Mission, variant: Variant, ticks: int
) -> Plan:
    """By enumeration, of the manoeuvres of so many ticks.

    The letter drives at v_max; `assured` takes the best of those with the fewest candidates out of range,
    which silence then names. A single candidate is checked by the range that changes most, towards it:
    silence would check nothing.
    """
    period = ticks * mission.period
    omega = np.linspace(-mission.max_turn_rate, mission.max_turn_rate, TURN_RATES) / ticks
    half = 0.5 * period * omega
    unit = period * np.sinc(half / math.pi)
    if variant == "paper":
        speed = np.array([[mission.max_speed]])
    else:
        speed = mission.first_straight / mission.period * np.array(SPEEDS)[:, None]
    x = b.x + speed * unit * np.cos(b.heading + half)
    y = b.y + speed * unit * np.sin(b.heading + half)

    squared = []
    for candidate in candidates:
        there = candidate.place(a)
        squared.append((there.x - x) ** 2 + (there.y - y) ** 2)
    rim = (mission.sensing_range - RANGE_MARGIN) ** 2
    if len(squared) == 1:
        here = travelled(b, candidates[0].place(a))
        gap = here * here - squared[0]
    else:
        gap = np.min([abs(one - other) for i, one in enumerate(squared) for other in squared[:i]], axis=0)
    value = gap
    if variant == "assured":
        outside = sum((distance > rim).astype(float) for distance in squared)
        value = np.where(outside == np.min(outside), gap, -np.inf)
    row, column = np.unravel_index(np.argmax(value), value.shape)
    drive = Controls(float(speed[row, 0]), float(omega[column]))
    return Plan(drive, ticks, float(gap[row, column]) if len(candidates) > 1 else None)
