"""Phase 3: the last manoeuvres, which select the true solution of eq. (7) (Section III.C)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, reduce
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.closed_forms import Placement
from agent.estimation.exact import PairObservation, information
from agent.estimation.exact_estimator import ELSEWHERE
from agent.planning.planner import Manoeuvres
from agent.planning.separation import nearest
from protocol.mission import RANGE_MARGIN, Mission, Role
from protocol.motion import Controls, Pose, placed, relative, travelled

Array = NDArray[np.float64]
Point = float | Array

TURN_RATES = 721
"""The number of values of omega_2 compared in eq. (8), from -omega_max to omega_max.

With the parameters of Section IV, there is one every half degree.
"""

LAST_SPEEDS = (1.0, -1.0, 0.75, -0.75, 0.5, -0.5, 0.25, -0.25, 0.1, -0.1)
"""The values of v_2 compared, in units of A_0 / T_s: v_max, or less if one tick would come near R."""

REGULARISATION = 1e-8
"""The regularisation of the information matrix: a fraction of (D + R)^2 for phi and of D^2 for psi.

These are the largest contributions of one range. Without the regularisation, the first of two missing ranges
would not increase the determinant.
"""


class Question(NamedTuple):
    """The problem that the last manoeuvre solves: which of `placements` is the true one."""

    mover: Role
    """The robot that moves, in the paper always b."""
    a: Pose
    """The pose of a in <a(M1)>."""
    b: Pose
    """The pose of b in <b(M2)>."""
    placements: tuple[Placement, ...]


class Plan(NamedTuple):
    """A last manoeuvre and its expected result."""

    command: Controls
    separation_m2: float | None
    """J of eq. (8) in m^2: the smallest difference of predicted squared ranges; None for one placement."""
    question: Question


class ReachableEnds(NamedTuple):
    """The S x W manoeuvres that are compared, and their end points in the frame of the mover's anchor."""

    v: Array
    """The speeds in m/s; (S, 1)."""
    omega: Array
    """The turn rates in rad/s; (W,)."""
    x: Array
    """The end points in m; (S, W)."""
    y: Array


class Compared(NamedTuple):
    """The value of each manoeuvre in `reach`."""

    reach: ReachableEnds
    gap: Array
    """J in m^2, (S, W). For one placement: the decrease of the squared range."""
    value: Array
    """`gap` of the manoeuvres that are allowed, and -inf for the others; (S, W)."""


def turn(pair_observations: Sequence[PairObservation]) -> Role:
    """Return the robot that moves next: the one that did not move last. Robot b moves first."""
    for before, latest in pairwise(reversed(pair_observations)):
        if travelled(before.b, latest.b) > 0.0:
            return "a"
        if travelled(before.a, latest.a) > 0.0:
            return "b"
    return "b"


def last_manoeuvre(question: Question, mission: Mission, manoeuvres: Manoeuvres) -> Plan | None:
    """Return the manoeuvre that best distinguishes the placements by the range after it (eq. (8)).

    It maximises the smallest difference of the predicted ranges, in squares. The maximum is found by
    enumeration of `manoeuvres`.

    With one placement, the manoeuvre is a check: it approaches the other robot so that the squared range
    decreases most, since no detection would check nothing. The result is None if every manoeuvre violates the
    safety distance.
    """
    reach, gap, value = compared(question, mission, manoeuvres)
    return _plan(question, reach, value, gap if len(question.placements) > 1 else None)


def compared(question: Question, mission: Mission, manoeuvres: Manoeuvres) -> Compared:
    """Return all manoeuvres with their values. `last_manoeuvre` takes the largest value."""
    mover, a, b, placements = question
    reach = reachable(a if mover == "a" else b, mission, manoeuvres.last_speeds)
    squared: list[Array] = []
    for placement in placements:
        (ax, ay), (bx, by) = _positions_in_b(mover, a, b, placement, reach.x, reach.y)
        dx, dy = np.subtract(ax, bx), np.subtract(ay, by)
        dx *= dx
        dy *= dy
        dx += dy
        squared.append(dx)
    if len(squared) == 1:
        gap = travelled(b, placements[0].place(a)) ** 2 - squared[0]
    else:
        gap = reduce(np.minimum, [_gap(one, other) for i, one in enumerate(squared) for other in squared[:i]])
    value, apart = gap, None
    if mission.safety_distance:
        apart = _keeps_apart(question, reach, mission)
        value = np.where(apart, gap, -np.inf)
    if manoeuvres.fewest_out_of_range:
        rim = (mission.sensing_range - RANGE_MARGIN) ** 2
        outside = reduce(np.add, [(distance > rim).view(np.int8) for distance in squared])
        fewest = (outside if apart is None else outside[apart]).min(initial=len(squared))
        value = np.where(outside == fewest, value, -np.inf)
    return Compared(reach, gap, value)


def _gap(one: Array, other: Array) -> Array:
    """Return the absolute difference of two squared distances in m^2."""
    difference = one - other
    return np.abs(difference, out=difference)


def most_informative_manoeuvre(
    question: Question, pair_observations: Sequence[PairObservation], mission: Mission
) -> Plan | None:
    """Return the manoeuvre after which a range determines the placement best, or None (see `last_manoeuvre`).

    It applies to the only remaining placement if the ranges in `pair_observations` do not determine it,
    because both robots and their anchors lie on one line. The criterion is the determinant of the information
    matrix. Both robots have to move to raise it.
    """
    mover, a, b, (placement,) = question
    reach = reachable(a if mover == "a" else b, mission, LAST_SPEEDS)
    (ax, ay), (bx, by) = _positions_in_b(mover, a, b, placement, reach.x, reach.y)
    dx, dy = ax - bx, ay - by
    apart = np.maximum(np.hypot(dx, dy), ELSEWHERE)
    by_phi = (dy * (ax - placement.x) - dx * (ay - placement.y)) / apart
    by_psi = (dy * placement.x - dx * placement.y) / apart
    pp, pq, qq = information(placement, pair_observations)
    distance = math.hypot(placement.x, placement.y)
    ridge_p, ridge_q = REGULARISATION * (distance + mission.sensing_range) ** 2, REGULARISATION * distance**2
    value = (pp + by_phi**2 + ridge_p) * (qq + by_psi**2 + ridge_q) - (pq + by_phi * by_psi) ** 2
    value = np.where(apart <= mission.sensing_range - RANGE_MARGIN, value, -np.inf)
    if mission.safety_distance:
        value = np.where(_keeps_apart(question, reach, mission), value, -np.inf)
    return _plan(question, reach, value)


def _keeps_apart(question: Question, reach: ReachableEnds, mission: Mission) -> NDArray[np.bool]:
    """Return which manoeuvres keep the safety distance by every placement; (S, W)."""
    mover, a, b, placements = question
    v, omega = np.broadcast_arrays(reach.v, reach.omega)
    here = a if mover == "a" else b
    others = [one.place(a) if mover == "b" else relative(one.frame, b) for one in placements]
    least = [nearest(here, v, omega, (other.x, other.y), mission.period) for other in others]
    allowed: NDArray[np.bool] = np.min(least, axis=0) >= mission.safety_distance
    return allowed


def _plan(question: Question, reach: ReachableEnds, value: Array, gap: Array | None = None) -> Plan | None:
    """Return the manoeuvre in `reach` with the largest `value`, and its `gap`; None if none is allowed."""
    row, column = divmod(int(np.argmax(value)), value.shape[1])  # the first one of several
    if value[row, column] == -np.inf:
        return None
    command = Controls(float(reach.v[row, 0]), float(reach.omega[column]))
    return Plan(command, None if gap is None else float(gap[row, column]), question)


def reachable(pose: Pose, mission: Mission, speeds: tuple[float, ...] | None) -> ReachableEnds:
    """Return the manoeuvres that are compared, from `pose`, at `speeds` in A_0 / T_s (None: at v_max)."""
    speed, omega, half, chords = _arcs(mission, speeds)
    course = pose.heading + half
    x, y = chords * np.cos(course), chords * np.sin(course)
    x += pose.x
    y += pose.y
    return ReachableEnds(speed, omega, x, y)


@cache
def _arcs(mission: Mission, speeds: tuple[float, ...] | None) -> tuple[Array, Array, Array, Array]:
    """Return the speeds (S, 1), the turn rates (W,), half the turns of a tick (W,), and the chords (S, W)."""
    if speeds is None:
        speed = np.array([[mission.max_speed]])
    else:
        speed = mission.first_straight / mission.period * np.array(speeds)[:, None]
    omega = np.linspace(-mission.max_turn_rate, mission.max_turn_rate, TURN_RATES)
    half = 0.5 * mission.period * omega
    return speed, omega, half, speed * (mission.period * np.sinc(half / math.pi))


def _positions_in_b(
    mover: Role, a: Pose, b: Pose, placement: Placement, x: Array, y: Array
) -> tuple[tuple[Point, Point], tuple[Point, Point]]:
    """Return the positions of a and b in <b(M2)>, if `mover` is at (x, y) in the frame of its anchor."""
    if mover == "b":
        there = placement.place(a)
        return (there.x, there.y), (x, y)
    return placed(placement.frame, x, y), (b.x, b.y)
