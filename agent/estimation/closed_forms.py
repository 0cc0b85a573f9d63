"""The closed forms of Section III for two ranges in the plane: the angle alpha and the placements of eq. (7).

The frames <a(M1)> and <b(M2)> are centred in the robot's own anchor, with the x-axis through its first
position p_0. Points are in m, angles in rad. All functions are pure.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from protocol.motion import Pose, compose, rotated, wrap

TRIANGLE_SLACK = 1e-7
"""The fraction of a triangle's perimeter by which rounding may violate the triangle inequality.

A later test of the residuals rejects whatever this admits wrongly. A side is the sum of some thousand terms,
each up to a thousand times as long as the side, and 1e-16 of 1e6 is less than this fraction.
"""

SAME_PLACEMENT = 1e-9
"""The angle in rad, and the fraction of a length, below which two placements are the same (a double root)."""


def included_angle(near: float, far: float, moved: float) -> float | None:
    """Return alpha of eq. (2), in [0, pi] rad: the angle from the outward radial direction to the motion.

    The robot is `near` m from a beacon, and a straight motion of `moved` m takes it to a distance of `far` m.
    Return None if no triangle has these sides, and 0 at the beacon, where every direction is radial. Kahan's
    formula for an angle from three sides is used because eq. (2) loses digits near 0 and pi.
    """
    if near == 0.0:
        return 0.0
    slack = TRIANGLE_SLACK * (near + far + moved)
    if not abs(far - near) - slack <= moved <= far + near + slack:
        return None
    long, short = max(near, moved), min(near, moved)
    excess = far - (long - short) if far <= short else short - (long - far)
    opposite = max(0.0, ((long - short) + far) * excess)
    adjacent = max(0.0, (long + (short + far)) * ((long - far) + short))
    return math.pi - 2.0 * math.atan2(math.sqrt(opposite), math.sqrt(adjacent))


class Placement(NamedTuple):
    """A placement of <a(M1)> in <b(M2)> that solves eq. (7): a rotation by phi, then a shift by T."""

    phi: float
    x: float
    y: float

    @property
    def frame(self) -> Pose:
        """The pose of <a(M1)> in <b(M2)>."""
        return Pose(self.x, self.y, self.phi)

    def place(self, pose: Pose) -> Pose:
        """Return `pose`, given in <a(M1)>, in <b(M2)>."""
        return compose(self.frame, pose)


def placements(
    distance: float,
    p1b: Pose,
    p1a: Pose,
    p2a: Pose,
    rho1: float,
    rho2: float,
) -> list[Placement]:
    """Return all solutions of eq. (7), at most four, in closed form.

    `distance` is D in m. b is at `p1b` in <b(M2)>. a moved from `p1a` to `p2a` in <a(M1)>, and its ranges to
    b there were `rho1` and `rho2` m. Two triangles (the branches +-alpha) determine where M1 lies relative to
    p1b, and D leaves two points for each. A double root is returned once. The list is empty if there is no
    solution, and also if b is at M1, because then every rotation about b is a solution.
    """
    dx, dy = p2a.x - p1a.x, p2a.y - p1a.y
    moved = math.hypot(dx, dy)
    if moved == 0.0:
        return []
    if rho1 == 0.0:  # there every direction is radial; the other end of the motion determines the triangle
        if rho2 == 0.0:
            return []
        return placements(distance, p1b, p2a, p1a, rho2, rho1)
    alpha = included_angle(rho1, rho2, moved)
    if alpha is None:
        return []
    course = math.atan2(dy, dx)
    solutions: list[Placement] = []
    for side in (alpha, -alpha):
        # <a(M1)> seen from p1b, with the x-axis towards p1a
        turn = side - course
        c, s = math.cos(turn), math.sin(turn)
        ahead, aside = rotated(c, s, p1a.x, p1a.y)
        anchor_x, anchor_y = rho1 - ahead, -aside
        radius = math.hypot(anchor_x, anchor_y)
        for tx, ty in circle_intersections(p1b.x, p1b.y, radius, distance):
            spin = math.atan2(ty - p1b.y, tx - p1b.x) - math.atan2(anchor_y, anchor_x)
            solution = Placement(wrap(turn + spin), tx, ty)
            if not any(same_placement(solution, other, SAME_PLACEMENT) for other in solutions):
                solutions.append(solution)
    return solutions


def same_placement(one: Placement, other: Placement, tolerance: float) -> bool:
    """Return whether phi and the bearing of M1 in <b(M2)> each differ by less than `tolerance`, in rad."""
    return abs(wrap(one.phi - other.phi)) < tolerance and math.hypot(
        one.x - other.x, one.y - other.y
    ) < tolerance * math.hypot(one.x, one.y)


def circle_intersections(x: float, y: float, radius: float, distance: float) -> list[tuple[float, float]]:
    """Return the intersections (m) of the circles of `radius` about (x, y) and `distance` about the origin.

    A tangent point is returned once. The list is empty if the circles do not meet, if they are equal, or if
    the first is a point, each up to rounding.
    """
    apart = math.hypot(x, y)
    if min(apart, radius) < SAME_PLACEMENT * (apart + radius + distance):
        return []
    away = included_angle(apart, radius, distance)
    if away is None:
        return []
    bearing = math.atan2(y, x)
    sides = (away, -away) if 0.0 < away < math.pi else (away,)
    return [(-distance * math.cos(bearing + side), -distance * math.sin(bearing + side)) for side in sides]
