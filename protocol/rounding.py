"""Bounds on what double precision does to poses and ranges: every floor of a test with exact sensors.

The world moves the robots, and a robot its odometry, by one `step` a tick. Let `length` be the largest
coordinate, `ticks` the number of steps, `turned` the sum of |omega T_s| over them, and u = 2^-53.

- A heading grows to TAU + `turned`, the first by the branch or the start, and each addition to it is rounded by
  at most u (TAU + turned). Equal turns are rounded alike, so the errors add up, and they swing a position
  by at most themselves times `length`: ticks u (TAU + turned) length.
- A coordinate is rounded by u `length` in each step, and a chord and its sine and cosine by less than that.
- A range of two points is rounded a few times more: RANGED u `length`.

Both sides err, the world and whoever recomputes it: twice u.
"""

from __future__ import annotations

from protocol.motion import TAU

EPSILON = 2.0**-52
"""2 u"""

RANGED = 8.0
"""EPSILON of a length: the rounding of a range, of a closed form that inverts it, and of the frames between"""

SAME = 4.0
"""floors: two anchors so near each other predict ranges that differ by a floor each at the most, on either side
of what is measured; so nothing tells them apart"""

TOLERANCE = 1e-6
"""m and rad: a claim that is farther off than this is wrong, where sensors are exact"""

SURE = 0.5 * TOLERANCE
"""m and rad: what all roundings together may put a claim off, for it to be made; the other half is left for
placements that are merged (`same_turn`)"""


def rounding(length: float, ticks: int, turned: float) -> float:
    """Return the bound in m, derived above, on how far a computed range may be from the measured one."""
    return EPSILON * length * (RANGED + ticks * (1.0 + TAU + turned))


def same_turn(size: float) -> float:
    """Return the angle in rad below which two turns of a robot about its anchor give one claim.

    The poses that follow, `size` m from the anchors at the most, then differ by less than SURE.
    """
    return SURE / max(1.0, size)


def foothold(size: float, distance: float, sensing_range: float) -> float:
    """Return how exactly, in m, a robot must know where its anchor is when phase 1 ends.

    An anchor that is off by e turns the line between the anchors by e / D, and b, whose place is R / 8 from its
    own, by 8 e / R; either puts a pose off by `size` times that, and two robots err. Half of SURE goes there.
    """
    return 0.25 * SURE * min(distance, 0.125 * sensing_range) / max(1.0, size)
