"""How two robots that range each other keep `safety_distance`, wherever each may think that the other is."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from protocol.mission import Mission
from protocol.motion import Controls, Pose

Array = NDArray[np.float64]

CHORDS = 16
"""of an arc that is looked at: half a circle of 1 m is 1.5 mm from them at the most"""

SIGMAS = 3.0
"""by which a noisy range may be too long"""

BOTH = 0.5
"""of the way that is left: what each may take, where the other may be driving, too"""


def leeway(rho: float, mission: Mission) -> float:
    """m that a robot may go, whichever way, `rho` m from a peer that stands."""
    if not mission.safety_distance:
        return math.inf
    return max(0.0, rho - SIGMAS * mission.noise.mutual_sigma - mission.safety_distance)


def slowed(controls: Controls, metres: float, mission: Mission) -> Controls:
    """The same arc, as far along it as `metres`."""
    length = abs(controls.v) * mission.period
    if length <= metres:
        return controls
    return Controls(controls.v * metres / length, controls.omega * metres / length)


def nearest(pose: Pose, v: Array, omega: Array, point: tuple[float, float], period: float) -> Array:
    """m: how near the arcs from `pose` come to `point`, at the least; of the shape of `v` and `omega`.

    By their chords, and how far an arc may be from its own.
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
