"""Bounds on the rounding errors of poses and ranges: the floors of all tests with exact sensors.

The world moves the robots, and a robot its odometry, along the same arcs. A run, a sequence of equal
manoeuvres, is computed as one arc from the pose where it begins. Let `size` (D + R) be the largest
coordinate, `path` the length driven in `runs` runs, `turned` the sum of |omega T_s| over all ticks, and
u = 2^-53.

- Each run rounds a coordinate by u `size`, and a chord, its sine and its cosine by less than that.
- A heading is at most TAU + `turned`, where TAU bounds the heading of the start or the branch. Each run
  rounds it by u times that. The errors may add up. They rotate the path, and move a position by at most the
  error of the heading times `path`, or times 2 `size` where that is less.
- A range is the hypotenuse of two differences of such coordinates, after a transformation between frames.
  It is rounded by RANGED u `size`.

The world and the robot that recomputes its numbers have the same errors, so the bounds use 2 u.
"""

from __future__ import annotations

from protocol.motion import TAU

EPSILON = 2.0**-52
"""Twice the unit roundoff: 2 u."""

RANGED = 4.0
"""The rounding of a range, in u `size`: two differences, the hypotenuse, and the rotation of a frame."""

SAME_ANCHORS = 2.0
"""The distance, in floors, below which no range distinguishes two anchors.

A measured range differs from the two that they predict by at most one floor each, on either side.
"""

TOLERANCE = 1e-6
"""The largest error in m and rad of a correct claim, with exact sensors."""

SURE = 0.5 * TOLERANCE
"""The largest rounding error in m and rad with which a claim is made.

The other half of TOLERANCE is left for the placements that are merged (`same_turn`).
"""


def rounding(size: float, runs: int, path: float, turned: float) -> float:
    """Return the bound in m, derived above, on the difference between a computed and a measured range."""
    return EPSILON * (size * (RANGED + runs) + min(path, 2.0 * size) * runs * (TAU + turned))


def same_turn(size: float) -> float:
    """Return the angle in rad below which two rotations of a robot about its anchor are merged into one.

    The resulting poses are at most `size` m from the anchors, so they differ by less than SURE.
    """
    return SURE / max(1.0, size)


WELL = 0.125
"""The fraction of `required_anchor_error` at which an anchor error suffices wherever the robots meet."""

BETTER = 0.9
"""The ratio to which a range must reduce the anchor error for another range to be worthwhile."""

OUT_AND_BACK = 2
"""The number of consecutive ranges without a smaller anchor error after which phase 1 takes no more.

One is measured on the way out, and one on the way back. Rounding grows with the path, so no later range
reduces the error.
"""


def required_anchor_error(size: float, distance: float, sensing_range: float) -> float:
    """Return the anchor error in m that a robot may have when phase 1 ends.

    An anchor error e rotates the line between the anchors by e / D, or by up to twice that if the ranges were
    measured at unfavourable positions. It rotates b, which waits R / 8 from its own anchor, by up to 8 e / R.
    Either rotation moves a pose by `size` times the angle, and the errors of both robots add up.
    """
    return 0.5 * SURE * min(0.5 * distance, 0.125 * sensing_range) / max(1.0, size)
