"""The manoeuvres that active sensing compares, and the strides of which each consists."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import cos, sin
from agent.estimation.gaussian.odometry_noise import Array, Places, ratio_of_chord
from agent.planning import separation
from protocol.mission import Mission
from protocol.motion import Pose, placed

STRIDE_LENGTH = 0.25
"""The minimum length of a manoeuvre, as a fraction of R. A manoeuvre lasts as many ticks as that takes."""

STRIDES_AHEAD = 3
"""The number of strides over which a manoeuvre is evaluated, as if it were continued."""

TURN_COUNT = 17
"""The number of values of omega that are compared, from -omega_max to omega_max."""

STRIDE_SPEEDS = (1.0, -1.0, 0.5, -0.5)
"""The values of v that are compared, in units of A_0 / T_s."""

SLOW = (0.1, -0.1)
"""Additional values of v in the same units, for small gaps when there is a safety distance."""


def stride(mission: Mission) -> int:
    """Return the number of ticks of a manoeuvre. Ranges from nearer points are hardly more informative."""
    return max(1, round(STRIDE_LENGTH * mission.sensing_range / mission.first_straight))


class Choice(NamedTuple):
    """The C manoeuvres that are compared, with end points relative to the starting pose."""

    v: Array
    omega: Array
    along: Array
    """The distance in m along the initial heading after each stride; (C, strides)."""
    across: Array
    """The distance in m to the left of it; (C, strides)."""
    way_along: Array
    """The distance in m along the initial heading at CHORDS times during the first stride; (C, CHORDS)."""
    way_across: Array
    """The distance in m to the left of it; (C, CHORDS)."""

    def ends(self, pose: Array, some: Places | slice = slice(None)) -> tuple[Array, Array]:
        """Return the positions in m after each stride of the manoeuvres `some` from `pose`; (C, strides)."""
        return placed(Pose(*pose), self.along[some], self.across[some])

    def way(self, pose: Array, some: Places) -> tuple[Array, Array]:
        """Return the positions in m during the first stride of the manoeuvres `some`; (C, CHORDS)."""
        return placed(Pose(*pose), self.way_along[some], self.way_across[some])


@cache
def choice(mission: Mission, strides: int = STRIDES_AHEAD) -> Choice:
    """Return all manoeuvres of a robot, continued for `strides`. The last one is to stand still."""
    period = stride(mission) * mission.period
    fastest = min(mission.max_turn_rate, math.pi / period)
    speeds = STRIDE_SPEEDS + SLOW if mission.safety_distance else STRIDE_SPEEDS
    omega, speed = np.meshgrid(
        np.linspace(-fastest, fastest, TURN_COUNT), mission.first_straight / mission.period * np.array(speeds)
    )
    v = np.append(speed.ravel(), 0.0)
    turn = np.append(omega.ravel(), 0.0)
    half = 0.5 * period * turn
    chord = period * v * ratio_of_chord(half)
    course = half[:, None] * (2.0 * np.arange(strides) + 1.0)
    share = half[:, None] * np.arange(1, separation.CHORDS + 1) / separation.CHORDS
    way = (
        period * v[:, None] * np.arange(1, separation.CHORDS + 1) / separation.CHORDS * ratio_of_chord(share)
    )
    return Choice(
        v,
        turn,
        np.cumsum(chord[:, None] * cos(course), 1),
        np.cumsum(chord[:, None] * sin(course), 1),
        way * cos(share),
        way * sin(share),
    )
