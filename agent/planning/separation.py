"""The safety distance between two robots in range of each other, for all poses that may be true."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from protocol.mission import Mission
from protocol.motion import Controls, Pose

Array = NDArray[np.float64]

CHORDS = 16
"""The number of chords per arc. Half a circle of 1 m arc length is at most 1.5 mm from its chords."""

LARGEST_ERROR_SIGMAS = 3.0
"""The assumed largest error of a noisy range, in standard deviations."""

SHARE_OF_EACH = 0.5
"""The share of the remaining distance that each robot may use while the other one may be driving too."""

BLOCKED = 0.1
"""The way that is left in a tick, as a fraction of A_0, below which a robot may be blocked."""


def is_tight(metres: float, mission: Mission) -> bool:
    """Return whether a robot that may drive so many metres in a tick, or has driven them, may be blocked."""
    return metres < BLOCKED * mission.first_straight


def largest_error(mission: Mission) -> float:
    """Return the assumed largest error in m of a mutual range."""
    return LARGEST_ERROR_SIGMAS * mission.noise.mutual_sigma


def leeway(rho: float, mission: Mission) -> float:
    """Return how far in m a robot may go in any direction, `rho` m from a peer that stands still."""
    if not mission.safety_distance:
        return math.inf
    return max(0.0, rho - largest_error(mission) - mission.safety_distance)


def leeway_of_each(rho: float, mission: Mission, *, aside: bool = False) -> float:
    """Return how far in m each of two robots `rho` m apart may go in any direction, as both may drive.

    On a way `aside`, no error of the range is allowed for: robots that its noise has led too near would stand
    there for ever.
    """
    free = max(0.0, rho - mission.safety_distance) if aside else leeway(rho, mission)
    return SHARE_OF_EACH * free


def slowed(controls: Controls, metres: float, mission: Mission) -> Controls:
    """Return `controls` with the same arc, shortened to the length `metres` in m."""
    length = abs(controls.v) * mission.period
    if length <= metres:
        return controls
    return Controls(controls.v * metres / length, controls.omega * metres / length)


def nearest(pose: Pose, v: Array, omega: Array, point: tuple[float, float], period: float) -> Array:
    """Return the smallest distance in m between `point` and each arc from `pose`; the shape is that of `v`.

    The result is a lower bound: the distance to the chords, minus the largest distance of an arc from its
    chord.
    """
    x, y = np.full(v.shape, pose.x - point[0]), np.full(v.shape, pose.y - point[1])
    half = 0.5 * omega * period / CHORDS
    chord = v * period / CHORDS * np.sinc(half / math.pi)
    least = np.hypot(x, y)
    for i in range(CHORDS):
        course = pose.heading + (2 * i + 1) * half
        dx, dy = chord * np.cos(course), chord * np.sin(course)
        along = -(x * dx + y * dy) / np.maximum(chord * chord, 1e-300)
        share = np.clip(along, 0.0, 1.0)
        least = np.minimum(least, np.hypot(x + share * dx, y + share * dy))
        x, y = x + dx, y + dy
    sagitta: Array = least - 0.5 * np.abs(chord * np.tan(0.5 * half))
    return sagitta
