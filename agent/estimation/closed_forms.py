"""The closed forms of Section III: what two ranges leave possible, in the plane.

Frames: <a(M1)> and <b(M2)> are centred in the robot's own anchor, with the x-axis through its first
position p_0. Points are in m, angles in rad. Everything here is a function of its arguments.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from protocol.motion import Pose, compose, wrap

SLACK = 1e-7
"""of a triangle's three sides: by so much may rounding break its inequality; residuals weigh later what that
lets in. Sides are sums of some thousand numbers up to a thousand times as long: 1e-16 of 1e6 is less"""

SAME = 1e-9
"""rad, and of the lengths at hand: placements nearer than this are one (a double root)"""


def included_angle(near: float, far: float, moved: float) -> float | None:
    """alpha of eq. (2): the turn, at a point `near` m from a beacon, away from the outward radial direction.

    Going `moved` m in that direction leads to a point `far` m from the beacon. In [0, pi]; None where
    no triangle has these sides. At the beacon itself every direction is radial: 0. By Kahan's formula
    for an angle from three sides, which loses no digits where eq. (2) does: near 0 and pi.
    """
    if near == 0.0:
        return 0.0
    slack = SLACK * (near + far + moved)
    if not abs(far - near) - slack <= moved <= far + near + slack:
        return None
    long, short = max(near, moved), min(near, moved)
    excess = far - (long - short) if far <= short else short - (long - far)
    opposite = max(0.0, ((long - short) + far) * excess)
    adjacent = max(0.0, (long + (short + far)) * ((long - far) + short))
    return math.pi - 2.0 * math.atan2(math.sqrt(opposite), math.sqrt(adjacent))


class Placement(NamedTuple):
    """A rigid placement of <a(M1)> in <b(M2)>, a solution of eq. (7): turn by phi, then shift by T."""

    phi: float
    x: float
    y: float

    def place(self, pose: Pose) -> Pose:
        """`pose`, of <a(M1)>, in <b(M2)>."""
        return compose(Pose(self.x, self.y, self.phi), pose)


def placements(
    distance: float,
    p1b: Pose,
    p1a: Pose,
    p2a: Pose,
    rho1: float,
    rho2: float,
) -> list[Placement]:
    """Every solution of eq. (7), at most four, in closed form.

    `distance` is D; b stands at `p1b` in <b(M2)>; a went from `p1a` to `p2a` in <a(M1)>, and was ranged
    from b at `rho1` and `rho2` m. Two triangles (the +-alpha branches) fix where M1 lies about p1b, and
    D then leaves two points each. Double roots are given once. Empty where nothing fits; also where b
    stands on M1, since then any turn about it does.
    """
    dx, dy = p2a.x - p1a.x, p2a.y - p1a.y
    moved = math.hypot(dx, dy)
    if moved == 0.0:
        return []
    if rho1 == 0.0:  # every direction is radial from there; the triangle is known from its other end
        if rho2 == 0.0:
            return []
        return placements(distance, p1b, p2a, p1a, rho2, rho1)
    alpha = included_angle(rho1, rho2, moved)
    if alpha is None:
        return []
    course = math.atan2(dy, dx)
    found: list[Placement] = []
    for side in (alpha, -alpha):
        # <a(M1)> seen from p1b, with the x-axis towards p1a
        turn = side - course
        c, s = math.cos(turn), math.sin(turn)
        anchor_x = rho1 - (c * p1a.x - s * p1a.y)
        anchor_y = -(s * p1a.x + c * p1a.y)
        radius = math.hypot(anchor_x, anchor_y)
        for tx, ty in circle_intersections(p1b.x, p1b.y, radius, distance):
            spin = math.atan2(ty - p1b.y, tx - p1b.x) - math.atan2(anchor_y, anchor_x)
            candidate = Placement(wrap(turn + spin), tx, ty)
            if not any(same_placement(candidate, other, SAME) for other in found):
                found.append(candidate)
    return found


def same_placement(one: Placement, other: Placement, tolerance: float) -> bool:
    """Return whether phi and the bearing of M1 in <b(M2)> each differ by less than `tolerance`, in rad."""
    return abs(wrap(one.phi - other.phi)) < tolerance and math.hypot(
        one.x - other.x, one.y - other.y
    ) < tolerance * math.hypot(one.x, one.y)


def circle_intersections(x: float, y: float, radius: float, distance: float) -> list[tuple[float, float]]:
    """Where (m) the circle of `radius` about (x, y) meets that of radius `distance` about the origin.

    A tangent point is given once. Empty where they do not meet, or are the same circle, or the first is
    a point, to rounding.
    """
    apart = math.hypot(x, y)
    if min(apart, radius) < SAME * (apart + radius + distance):
        return []
    away = included_angle(apart, radius, distance)
    if away is None:
        return []
    bearing = math.atan2(y, x)
    sides = (away, -away) if 0.0 < away < math.pi else (away,)
    return [(-distance * math.cos(bearing + side), -distance * math.sin(bearing + side)) for side in sides]
