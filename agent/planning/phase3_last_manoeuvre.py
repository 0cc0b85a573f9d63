"""Phase 3: the last manoeuvres, and which of the placements of eq. (7) is true (Section III.C)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.estimation.closed_forms import Placement, placements
from agent.estimation.exact import PairObservation, information
from agent.planning.range_seeking import travelled
from agent.planning.separation import nearest
from protocol.mission import RANGE_MARGIN, Mission, PlannerName, Role
from protocol.motion import Controls, Pose

Array = NDArray[np.float64]
Point = float | Array

TURN_RATES = 721
"""values of omega_2 tried in eq. (8), from -omega_max to omega_max: every half degree in Section IV"""

SPEEDS = (1.0, -1.0, 0.75, -0.75, 0.5, -0.5, 0.25, -0.25, 0.1, -0.1)
"""values of v_2 tried, over A_0 / T_s: v_max, or less where that would come near R in one tick"""

ELSEWHERE = 1e-6
"""m: a range taken nearer than this to where another was says nothing new"""

ON_THE_OTHER = 1e-6
"""of a's way between two ranges: nearer to M1 than this, b may be on it, and eq. (7) has a's turn about M1 by
1e-16 over this at the best"""

FAINT = 1e-8
"""of (D + R)^2 for phi and of D^2 for psi, the most that a range tells: added to the information there is, so
that the first of two missing ranges counts"""


class Standing(msgspec.Struct, frozen=True):
    """b stands, and waits for a's second range; or, back from a manoeuvre, for word from a."""

    through: int = -1
    """ranges are weighed through this tick"""


class Waiting(msgspec.Struct, frozen=True):
    """a stands: it has its second range, and b makes the last manoeuvre; a too, where that is not enough."""

    through: int = -1
    """ranges are weighed through this tick"""


class LastManoeuvre(msgspec.Struct, frozen=True):
    """Drives to where the placements that are left predict different ranges."""

    command: Controls
    origin: Pose


class Returning(msgspec.Struct, frozen=True):
    """Has left the peer's range, and drives the same arc backwards to tell it."""

    command: Controls
    origin: Pose


Resting = Standing | Waiting
State = Resting | LastManoeuvre | Returning


class Question(NamedTuple):
    """Which of `candidates` is true: what the last manoeuvre is to answer."""

    mover: Role
    a: Pose
    """in <a(M1)>"""
    b: Pose
    """in <b(M2)>"""
    candidates: tuple[Placement, ...]


class Plan(NamedTuple):
    """A last manoeuvre, and what it is expected to tell."""

    command: Controls
    separation_m2: float | None
    """J of eq. (8): the least difference of two predicted squared ranges; none for one candidate"""
    question: Question


class Reach(NamedTuple):
    """The manoeuvres that are compared, and where each ends, in the frame of the mover's anchor."""

    v: Array
    """(S, 1)"""
    omega: Array
    """(W,)"""
    x: Array
    """(S, W)"""
    y: Array


class Compared(NamedTuple):
    """What each of the manoeuvres in `reach` would tell."""

    reach: Reach
    gap: Array
    """J in m^2, (S, W); for one candidate, by how much the squared range would shrink"""
    value: Array
    """the same; -inf for manoeuvres that are not to be taken"""


def base(
    pair_observations: Sequence[PairObservation], floor: float
) -> tuple[PairObservation, PairObservation] | None:
    """The two ranges that eq. (7) is solved from: the first two between which only a has moved.

    b has not moved if it is where it was to `floor` m, the rounding of both odometries. Not two ranges by
    which b may stand on M1: there any turn of a about it would do.
    """
    ranged: list[PairObservation] = []
    for pair_observation in pair_observations:
        if pair_observation.range is not None and not (
            ranged
            and (ranged[-1].a, ranged[-1].b)
            == (pair_observation.a, pair_observation.b)  # both have stood since
        ):
            ranged.append(pair_observation)
    for first in ranged:
        for second in ranged:
            stood, moved = travelled(first.b, second.b) <= floor, travelled(first.a, second.a) > ELSEWHERE
            if first.tick < second.tick and stood and moved:
                near = ON_THE_OTHER * travelled(first.a, second.a)
                if not (_as_far(first, near) and _as_far(second, near)):
                    return first, second
    return None


def _as_far(pair_observation: PairObservation, near: float) -> bool:
    """Return whether a is as far from its own anchor as from b, to `near` m."""
    assert pair_observation.range is not None
    return abs(math.hypot(pair_observation.a.x, pair_observation.a.y) - pair_observation.range) <= near


def solve(distance: float, base: tuple[PairObservation, PairObservation]) -> list[Placement]:
    """The placements that eq. (7) leaves after two ranges; `distance` is D."""
    first, second = base
    assert first.range is not None
    assert second.range is not None
    return placements(distance, first.b, first.a, second.a, first.range, second.range)


def redundant(
    pair_observations: Sequence[PairObservation], base: tuple[PairObservation, PairObservation]
) -> bool:
    """Whether there is a range more, from elsewhere, than the two that the placements were made from."""
    return any(
        pair_observation.range is not None
        and all(
            travelled(pair_observation.a, used.a) > ELSEWHERE
            or travelled(pair_observation.b, used.b) > ELSEWHERE
            for used in base
        )
        for pair_observation in pair_observations
    )


def turn(pair_observations: Sequence[PairObservation]) -> Role:
    """Whose move it is: the other's than whose was the last. b moves first."""
    for before, now in pairwise(reversed(pair_observations)):
        if travelled(before.b, now.b) > 0.0:
            return "a"
        if travelled(before.a, now.a) > 0.0:
            return "b"
    return "b"


def advanced(state: LastManoeuvre | Returning, pose: Pose, in_contact: bool, rest: Resting) -> State:
    """The state after a tick that led to `pose`; in the end it is `rest`."""
    match state:
        case LastManoeuvre(command) if not in_contact:
            return Returning(Controls(-command.v, -command.omega), pose)
        case _:
            return rest


# --- the last manoeuvre -------------------------------------------------------------------------------


def last_manoeuvre(
    mover: Role,
    a: Pose,
    b: Pose,
    candidates: Sequence[Placement],
    mission: Mission,
    planner_name: PlannerName,
) -> Plan | None:
    """The manoeuvre after which the ranges that `candidates` predict differ most (eq. (8), on squares).

    Of `mover`, in the paper always b; `a` is in <a(M1)> and `b` in <b(M2)>. By enumeration. The letter
    drives at v_max; `assured` takes the best of the manoeuvres with the fewest candidates out of range,
    which silence then names. A single candidate is checked by the range that changes most, towards it:
    silence would check nothing. None where every manoeuvre comes nearer than the safety distance.
    """
    question = Question(mover, a, b, tuple(candidates))
    reach, gap, value = compared(question, mission, planner_name)
    row, column = _best(value)
    if value[row, column] == -np.inf:
        return None
    command = Controls(float(reach.v[row, 0]), float(reach.omega[column]))
    return Plan(command, float(gap[row, column]) if len(candidates) > 1 else None, question)


def compared(question: Question, mission: Mission, planner_name: PlannerName) -> Compared:
    """What `last_manoeuvre` chooses from: the largest value."""
    mover, a, b, candidates = question
    reach = reachable(a if mover == "a" else b, mission, planner_name)
    squared: list[Array] = []
    for candidate in candidates:
        (ax, ay), (bx, by) = _placed(mover, a, b, candidate, reach.x, reach.y)
        squared.append(np.square(ax - bx) + np.square(ay - by))
    if len(squared) == 1:
        gap = travelled(b, candidates[0].place(a)) ** 2 - squared[0]
    else:
        gap = np.min([abs(one - other) for i, one in enumerate(squared) for other in squared[:i]], axis=0)
    apart = _keeps_apart(question, reach, mission)
    value = np.where(apart, gap, -np.inf)
    if planner_name == "assured":
        rim = (mission.sensing_range - RANGE_MARGIN) ** 2
        outside = np.sum([distance > rim for distance in squared], axis=0)
        fewest = np.min(outside, where=apart, initial=len(squared))
        value = np.where(outside == fewest, value, -np.inf)
    return Compared(reach, gap, value)


def survey(
    mover: Role,
    a: Pose,
    b: Pose,
    placement: Placement,
    pair_observations: Sequence[PairObservation],
    mission: Mission,
) -> Plan | None:
    """The manoeuvre of `mover` after which one more range would pin down `placement` best; none as above.

    For a placement that alone fits, and that the ranges in `pair_observations` do not determine: both robots and
    their anchors on one line. By the determinant of the information, which takes both robots to raise.
    """
    question = Question(mover, a, b, (placement,))
    reach = reachable(a if mover == "a" else b, mission, "assured")
    (ax, ay), (bx, by) = _placed(mover, a, b, placement, reach.x, reach.y)
    dx, dy = ax - bx, ay - by
    apart = np.maximum(np.hypot(dx, dy), ELSEWHERE)
    by_phi = (dy * (ax - placement.x) - dx * (ay - placement.y)) / apart
    by_psi = (dy * placement.x - dx * placement.y) / apart
    pp, pq, qq = information(placement, pair_observations)
    distance = math.hypot(placement.x, placement.y)
    faint_p, faint_q = FAINT * (distance + mission.sensing_range) ** 2, FAINT * distance**2
    value = (pp + by_phi**2 + faint_p) * (qq + by_psi**2 + faint_q) - (pq + by_phi * by_psi) ** 2
    value = np.where(apart <= mission.sensing_range - RANGE_MARGIN, value, -np.inf)
    value = np.where(_keeps_apart(question, reach, mission), value, -np.inf)
    row, column = _best(value)
    if value[row, column] == -np.inf:
        return None
    return Plan(Controls(float(reach.v[row, 0]), float(reach.omega[column])), None, question)


def _keeps_apart(question: Question, reach: Reach, mission: Mission) -> NDArray[np.bool]:
    """Which manoeuvres keep the safety distance, whichever of the candidates is true; (S, W)."""
    mover, a, b, candidates = question
    v, omega = np.broadcast_arrays(reach.v, reach.omega)
    if not mission.safety_distance:
        return np.ones(v.shape, dtype=np.bool)
    here = a if mover == "a" else b
    least = [
        nearest(here, v, omega, _seen(mover, a, b, candidate), mission.period) for candidate in candidates
    ]
    kept: NDArray[np.bool] = np.min(least, axis=0) >= mission.safety_distance
    return kept


def _seen(mover: Role, a: Pose, b: Pose, placement: Placement) -> tuple[float, float]:
    """Where the one that stands is, in the frame of the mover's anchor."""
    if mover == "b":
        there = placement.place(a)
        return there.x, there.y
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    dx, dy = b.x - placement.x, b.y - placement.y
    return c * dx + s * dy, c * dy - s * dx


def _best(value: Array) -> tuple[int, int]:
    """Row and column of the largest; of several, the first."""
    row, column = np.unravel_index(np.argmax(value), value.shape)
    return int(row), int(column)


def reachable(pose: Pose, mission: Mission, planner_name: PlannerName) -> Reach:
    """The manoeuvres that are compared, from `pose`."""
    omega = np.linspace(-mission.max_turn_rate, mission.max_turn_rate, TURN_RATES)
    half = 0.5 * mission.period * omega
    unit = mission.period * np.sinc(half / math.pi)
    if planner_name == "paper":
        speed = np.array([[mission.max_speed]])
    else:
        speed = mission.first_straight / mission.period * np.array(SPEEDS)[:, None]
    course = pose.heading + half
    x, y = pose.x + speed * unit * np.cos(course), pose.y + speed * unit * np.sin(course)
    return Reach(speed, omega, x, y)


def _placed(
    mover: Role, a: Pose, b: Pose, placement: Placement, x: Array, y: Array
) -> tuple[tuple[Point, Point], tuple[Point, Point]]:
    """Where a and b are in <b(M2)>: `mover` at (x, y) in the frame of its anchor, the other where it is."""
    if mover == "b":
        there = placement.place(a)
        return (there.x, there.y), (x, y)
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    return (placement.x + c * x - s * y, placement.y + s * x + c * y), (b.x, b.y)
