"""What a robot still holds possible: branches in phase 1, placements in phase 3.

Closed forms make the candidates, measurements weigh them. The sensors are exact here, so weighing is an
exact test with a numerical floor, and a candidate that passes is only polished: where the closed form
is well conditioned that is the identity, and next to a double root it restores the digits lost there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import msgspec

from agent.geometry import SAME, Placement, included_angle, same_placement
from protocol.motion import Pose, compose, wrap

FLOOR = 1e-9
"""m: how far an exact anchor range may be from its prediction (rounding; a thousand times what is seen)"""

MUTUAL_FLOOR = 1e-7
"""m: the same for a mutual range, whose prediction inherits the rounding of both robots' phase 1"""

POLISHING_STEPS = 12
"""Gauss-Newton steps at the most; a simple root takes one, a double root as many as it lost bits"""


class Branch(msgspec.Struct, frozen=True):
    """One of the two trajectories +-alpha that two ranges leave possible (Section III.A)."""

    alpha: float
    """rad, of eq. (2), signed"""
    start: Pose
    """where tick 0 of the odometry lies in the frame of the anchor: (rho_0, 0, heading)"""

    def distance(self, odometry: Pose) -> float:
        """From the anchor, in m."""
        place = compose(self.start, odometry)
        return math.hypot(place.x, place.y)


def branches(rho0: float, measured_at: Pose, rho: float) -> tuple[Branch, ...]:
    """The trajectories that fit the range `rho0` at tick 0 and `rho` at the odometry pose `measured_at`.

    Two, mirror images of each other; one where the motion was radial; none where the ranges contradict
    the odometry (eq. (2)).
    """
    alpha = included_angle(rho0, rho, math.hypot(measured_at.x, measured_at.y))
    if alpha is None:
        return ()
    bearing = math.atan2(measured_at.y, measured_at.x)
    sides = (alpha, -alpha) if 0.0 < alpha < math.pi else (alpha,)
    return tuple(Branch(side, Pose(rho0, 0.0, side - bearing)) for side in sides)


def weigh_branches(
    candidates: Iterable[Branch], seen: Iterable[tuple[Pose, float | None]], sensing_range: float
) -> tuple[Branch, ...]:
    """Those of `candidates` that explain every odometry pose in `seen` with its range, or its silence."""
    seen = tuple(seen)
    ranged = [(pose, rho) for pose, rho in seen if rho is not None]
    silent = [pose for pose, rho in seen if rho is None]
    left: list[Branch] = []
    for candidate in candidates:
        branch = _polished(candidate, ranged)
        if (
            all(abs(branch.distance(pose) - rho) <= FLOOR for pose, rho in ranged)
            and all(branch.distance(pose) > sensing_range - FLOOR for pose in silent)
            and not any(abs(wrap(branch.alpha - other.alpha)) < SAME for other in left)
        ):
            left.append(branch)
    return tuple(left)


def _polished(branch: Branch, ranged: Sequence[tuple[Pose, float]]) -> Branch:
    """The same branch with the heading that fits all ranges best, in squares (Gauss-Newton)."""
    rho0, heading = branch.start.x, branch.start.heading
    for _ in range(POLISHING_STEPS):
        c, s = math.cos(heading), math.sin(heading)
        gradient = curvature = 0.0
        for pose, rho in ranged:
            x, y = rho0 + c * pose.x - s * pose.y, s * pose.x + c * pose.y
            slope = -2.0 * rho0 * (s * pose.x + c * pose.y)
            gradient += slope * (x * x + y * y - rho * rho)
            curvature += slope * slope
        if curvature == 0.0:
            break
        correction = gradient / curvature
        heading -= correction
        if abs(correction) < 1e-12:
            break
    turned = heading - branch.start.heading
    return Branch(wrap(branch.alpha + turned), Pose(rho0, 0.0, heading))


class Sighting(msgspec.Struct, frozen=True):
    """One tick of an encounter: both robots in the frames of their own anchors, and the range between."""

    tick: int
    a: Pose
    b: Pose
    range: float | None


def separation(placement: Placement, a: Pose, b: Pose) -> float:
    """m: between a at `a` in <a(M1)> and b at `b` in <b(M2)>, if this is how they lie."""
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    return math.hypot(
        placement.x + c * a.x - s * a.y - b.x,
        placement.y + s * a.x + c * a.y - b.y,
    )


def weigh_placements(
    candidates: Iterable[Placement], sightings: Sequence[Sighting], sensing_range: float
) -> tuple[Placement, ...]:
    """Those of `candidates` that explain every sighting, be it a range or silence."""
    left: list[Placement] = []
    for candidate in candidates:
        placement = _polished_placement(candidate, sightings)
        for sighting in sightings:
            predicted = separation(placement, sighting.a, sighting.b)
            if sighting.range is None:
                if predicted <= sensing_range - MUTUAL_FLOOR:
                    break
            elif abs(predicted - sighting.range) > MUTUAL_FLOOR:
                break
        else:
            if not any(same_placement(placement, other, MUTUAL_FLOOR) for other in left):
                left.append(placement)
    return tuple(left)


def _polished_placement(placement: Placement, sightings: Sequence[Sighting]) -> Placement:
    """The placement nearby that fits all ranges best, in squares; M1 stays D from M2 (Gauss-Newton).

    The unknowns are phi and the bearing psi of M1 in <b(M2)>. Two ranges determine them exactly; more
    of them tell apart what eq. (7) alone gives as a double root.
    """
    distance = math.hypot(placement.x, placement.y)
    phi, psi = placement.phi, math.atan2(placement.y, placement.x)
    ranged = [(s.a, s.b, s.range) for s in sightings if s.range is not None]
    if len(ranged) < 3:
        return placement
    for _ in range(POLISHING_STEPS):
        c, s = math.cos(phi), math.sin(phi)
        tx, ty = distance * math.cos(psi), distance * math.sin(psi)
        pp = pq = qq = gp = gq = 0.0
        for a, b, rho in ranged:
            ax, ay = c * a.x - s * a.y, s * a.x + c * a.y
            x, y = tx + ax - b.x, ty + ay - b.y
            error = x * x + y * y - rho * rho
            by_phi = 2.0 * (y * ax - x * ay)
            by_psi = 2.0 * (y * tx - x * ty)
            pp += by_phi * by_phi
            pq += by_phi * by_psi
            qq += by_psi * by_psi
            gp += by_phi * error
            gq += by_psi * error
        determinant = pp * qq - pq * pq
        if determinant <= 1e-14 * pp * qq:
            break
        turn = (qq * gp - pq * gq) / determinant
        swing = (pp * gq - pq * gp) / determinant
        phi -= turn
        psi -= swing
        if abs(turn) + abs(swing) < 1e-13:
            break
    return Placement(wrap(phi), distance * math.cos(psi), distance * math.sin(psi))
