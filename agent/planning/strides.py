"""The manoeuvres that active sensing compares, the strides of which each consists, and its stalls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import cos, sin
from agent.estimation.gaussian.joint_ranges import MOVED
from agent.estimation.gaussian.odometry_noise import Array, Places, Track, ratio_of_chord
from agent.planning import separation
from agent.planning.state import RobotState
from protocol.mission import Mission
from protocol.motion import Controls, Pose, placed

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


def is_planning_tick(state: RobotState) -> bool:
    """Return whether the robot plans a manoeuvre in this tick. Both robots plan in the same ticks."""
    return state.tick % stride(state.config.mission) == 0


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

    def controls(self, i: int) -> Controls:
        """Return the controls of the manoeuvre with the index `i`."""
        return Controls(float(self.v[i]), float(self.omega[i]))

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


PLANS = 6
"""The number of consecutive plans whose places are compared.

Set on missions with R = 1.5 m, of which 4 of 1500 stalled for more than 60 plans. With fewer, robots that
measure on purpose for a while where they are would leave; with more, a stall lasts longer. With 6, robots
stalled for a while in 5 % of these missions, and in none of 300 of the row `as told` of the sweep `mismatch`.
"""

STALLED_PLACES = 3
"""The number of different places at which a robot is stalled if its last PLANS plans led to no more.

To and fro are two places. With three, the strides after a stall are still chosen by what each of them tells.
"""


def is_stalled(paths: Sequence[Track], since: int, stride: int, mission: Mission) -> bool:
    """Return whether the last PLANS plans led to at most STALLED_PLACES different places.

    A manoeuvre is evaluated as if it were continued, but only its first stride is executed. If each
    continuation leaves the sensing range under some hypothesis, the next plan takes the stride back, and so
    on: the ranges for which the manoeuvres were chosen are never measured. A stalled robot therefore plans by
    what the next stride alone tells.

    `paths` are those of the robots that plan together, `since` is the tick of the first of consecutive plans,
    and each lasts `stride` ticks.
    """
    tick = min([len(path.v) for path in paths])
    if tick - since < PLANS * stride:
        return False
    ticks = tick - stride * np.arange(PLANS + 1)
    where = np.stack([one for path in paths for one in (path.x[ticks], path.y[ticks])])
    apart = np.abs(where[:, :, None] - where[:, None, :]).max(0) > MOVED * mission.sensing_range
    is_new = [all(apart[i, :i].tolist()) for i in range(len(ticks))]
    return sum(is_new) <= STALLED_PLACES
