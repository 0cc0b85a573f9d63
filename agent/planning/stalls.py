"""Stalls of active sensing: robots that stand, or drive to and fro, and measure at the same places for ever.

A manoeuvre is evaluated as if it were continued, but only its first stride is executed. If each continuation
leaves the sensing range under some hypothesis, the next plan takes the stride back, and so on: the ranges for
which the manoeuvres were chosen are never measured. A stalled robot therefore plans by what the next stride
alone tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.gaussian.joint_ranges import MOVED
from agent.estimation.gaussian.odometry_noise import Track
from protocol.mission import Mission

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
