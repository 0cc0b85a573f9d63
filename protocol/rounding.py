"""Bounds on what double precision does to poses and ranges: every floor of a test with exact sensors.

The world moves the robots, and a robot its odometry, along the same arcs: equal manoeuvres, a run of them,
are one arc from where the run began. Let `size` (D + R) be the largest coordinate, `path` the length driven
in `runs` runs, `turned` the sum of |omega T_s| over all ticks, u = 2^-53.

- A coordinate is rounded by u `size` in each run; a chord, its sine and its cosine by less than that.
- A heading grows to TAU + `turned`, TAU being that of the start or the branch, and is rounded by u of that
  in each run. The errors may add up, and they swing what was driven: a place by at most themselves times
  `path`, or times 2 `size` where that is less.
- A range is the hypotenuse of two differences of such coordinates, in frames that lead to each other:
  RANGED u `size`.

Both sides err alike, the world and whoever recomputes it: twice u.
"""

from __future__ import annotations

from protocol.motion import TAU

EPSILON = 2.0**-52
"""2 u"""

RANGED = 4.0
"""u of the size: two differences, the hypotenuse, and the turn of a frame"""

SAME = 2.0
"""floors: two anchors so near each other predict ranges that differ by a floor each at the most, on either
side of what is measured; so nothing tells them apart"""

TOLERANCE = 1e-6
"""m and rad: a claim that is farther off than this is wrong, where sensors are exact"""

SURE = 0.5 * TOLERANCE
"""m and rad: what all roundings together may put a claim off, for it to be made; the other half is left for
placements that are merged (`same_turn`)"""


def rounding(size: float, runs: int, path: float, turned: float) -> float:
    """Return the bound in m, derived above, on how far a computed range may be from the measured one."""
    return EPSILON * (size * (RANGED + runs) + min(path, 2.0 * size) * runs * (TAU + turned))


def same_turn(size: float) -> float:
    """Return the angle in rad below which two turns of a robot about its anchor give one claim.

    The poses that follow, `size` m from the anchors at the most, then differ by less than SURE.
    """
    return SURE / max(1.0, size)


WELL = 0.125
"""of `foothold`: an anchor that is known so well is known well enough from whatever places the robots meet"""

BETTER = 0.9
"""by which another range must better what is known of an anchor, for one more to be worth it"""

OUT_AND_BACK = 2
"""ranges running, one of a way out and one of the way back, that made an anchor no better known; rounding
grows with the way, so no further one will"""


def foothold(size: float, distance: float, sensing_range: float) -> float:
    """Return how exactly, in m, a robot must know where its anchor is when phase 1 ends.

    An anchor that is off by e turns the line between the anchors by e / D, and a fit to ranges from places
    that are not the best by up to twice that; and b, whose place is R / 8 from its own, by 8 e / R. Either
    puts a pose off by `size` times that, and two robots err.
    """
    return 0.5 * SURE * min(0.5 * distance, 0.125 * sensing_range) / max(1.0, size)
