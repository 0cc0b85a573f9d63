"""How soon orbits meet: `uv run docs/rendezvous.py [ANGLES] [PLANS]` (1000, 200).

The mean and the longest time, in ticks, until two robots that drive round their anchors are in range of
each other, over all pairs of ANGLES starting angles: on the orbits of `assured`; on the paper's, inside
(D + R) / 2 by the margin that they need to meet at all (a sixth of the angles); and on the soonest of PLANS
others: any two circles, any constant speeds, either sense, drawn at random and then near the best so far.
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

import numpy as np

from protocol.mission import Mission
from protocol.motion import TAU
from protocol.orbits import Orbit, half_arc, rendezvous

SECTION_IV = (10.0, Mission(3.0, 1.0, 1.0, math.pi))
SETTINGS = [
    SECTION_IV,
    *((distance, Mission(3.0, 1.0, 1.0, math.pi)) for distance in (7.0, 8.0, 15.0, 30.0)),
    *((10.0, Mission(reach, 1.0, 1.0, math.pi)) for reach in (1.5, 5.0)),
    *((10.0, Mission(3.0, 1.0, speed, math.pi)) for speed in (0.3, 0.5, 2.0)),
    (10.0, Mission(3.0, 1.0, 1.0, 0.5)),
    *((10.0, Mission(3.0, period, 1.0, math.pi)) for period in (0.1, 0.5)),
    *(
        (10.0, Mission(r, t, 1.0, omega))
        for r in (1.0, 15.0)
        for t in (0.05, 1.0)
        for omega in (0.2, math.pi)
    ),
]
"""D in m, and R, T_s, v_max, omega_max: those of the sweep `settings`"""

COARSE = 40
"""starting angles, of a plan that is only drawn"""
KEPT = 20
"""of the best plans so far, near which others are drawn"""
LONG_TICK = 0.5
"""s: other plans are drawn only where a tick is so long; where it is shorter, they take their time"""
LIMIT = 20.0
"""times round an orbit of radius D + R: for so long a meeting is waited for"""


class Meeting(NamedTuple):
    """Ticks until two robots are in range."""

    mean: float
    worst: int


def meeting(setting: tuple[float, Mission], a: Orbit, b: Orbit, angles: int) -> Meeting:
    """By driving from every pair of starting angles, tick by tick."""
    distance, mission = setting
    starts = (np.arange(angles) + 0.5) * (TAU / angles)
    alpha, beta = (grid.ravel() for grid in np.meshgrid(starts, starts, indexing="ij"))
    limit = LIMIT * TAU * (distance + mission.sensing_range) / (mission.max_speed * mission.period)
    waited, tick = 0, 0
    while True:
        x = distance + b.radius * np.cos(beta) - a.radius * np.cos(alpha)
        y = b.radius * np.sin(beta) - a.radius * np.sin(alpha)
        apart = x * x + y * y > mission.sensing_range**2
        alpha, beta = alpha[apart], beta[apart]
        if alpha.size == 0 or tick >= limit:
            return Meeting(waited / angles**2, tick)
        waited += alpha.size
        tick += 1
        alpha += a.omega * mission.period
        beta += b.omega * mission.period


def papers(setting: tuple[float, Mission]) -> tuple[Orbit, Orbit]:
    """The paper's orbits, inside (D + R) / 2 by m0 = (v T_s (1 - Omega / pi))^2 / (16 R)."""
    distance, mission = setting
    share = half_arc(distance, mission.sensing_range) / math.pi
    margin = (mission.max_speed * mission.period * (1.0 - share)) ** 2 / (16.0 * mission.sensing_range)
    radius = 0.5 * (distance + mission.sensing_range) - margin
    return driven(mission, radius, 1.0), driven(mission, radius, -share)


def driven(mission: Mission, radius: float, share: float) -> Orbit:
    """The circle of `radius` (m), at `share` of the speed that is possible there; its sign is the sense."""
    omega = share * min(mission.max_turn_rate, mission.max_speed / max(radius, 1e-9))
    return Orbit(radius, abs(omega) * radius, omega)


def soonest(setting: tuple[float, Mission], plans: int) -> Meeting:
    """The best mean of `plans` pairs of orbits."""
    distance, mission = setting
    size = distance + mission.sensing_range
    draw = np.random.default_rng(1)
    best: list[tuple[Meeting, float, float, float]] = []
    for plan in range(plans):
        if plan < KEPT or draw.random() < 0.3:
            radius_a, radius_b, share = draw.uniform([0.0, 0.0, -1.0], [size, size, 1.0])
        else:
            scale = 10.0 ** draw.uniform(-3.0, -0.7)
            _, *near = best[int(draw.integers(len(best)))]
            radius_a, radius_b, share = np.array(near) + scale * draw.normal(size=3) * [size, size, 1.0]
        radius_a, radius_b, share = abs(radius_a), abs(radius_b), float(np.clip(share, -1.0, 1.0))
        met = meeting(setting, driven(mission, radius_a, 1.0), driven(mission, radius_b, share), COARSE)
        best = sorted([*best, (met, radius_a, radius_b, share)])[:KEPT]
    return best[0][0]


def main(angles: int, plans: int) -> None:
    """A line each setting."""
    print(f"{'D, R, T_s, v_max, omega_max':>30}   assured: bound, mean / worst   paper's orbits   drawn")
    for setting in SETTINGS:
        distance, mission = setting
        plan = rendezvous(mission, distance, "assured")
        ours = meeting(setting, plan.a, plan.b, angles)
        theirs = meeting(setting, *papers(setting), math.ceil(angles / 6))
        drawn = soonest(setting, plans) if mission.period >= LONG_TICK else None
        values = (distance, mission.sensing_range, mission.period, mission.max_speed, mission.max_turn_rate)
        print(
            f"{', '.join(f'{value:.3g}' for value in values):>30}   "
            f"{plan.bound / mission.period:8.0f} {ours.mean:8.1f} /{ours.worst:5d}   "
            f"{theirs.mean:8.1f} /{theirs.worst:5d}  {ours.mean / theirs.mean:5.2f} /"
            f"{ours.worst / theirs.worst:5.2f}   " + (f"{drawn.mean:8.1f} /{drawn.worst:5d}" if drawn else "")
        )


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]), *(1000, 200)[len(sys.argv) - 1 :])
