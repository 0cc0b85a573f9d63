"""Print how soon two orbiting robots are in range: `uv run docs/rendezvous.py [ANGLES] [PLANS]` (1000, 200).

The output is the mean and the longest time, in ticks, over all pairs of ANGLES starting angles, for three
kinds of orbits: those of `assured`; those of the paper, inside (D + R) / 2 by the margin that they need to
meet at all (with a sixth of the angles); and the soonest of PLANS others. These are any two circles with any
constant speeds in either sense, drawn at random and then near the best ones so far.
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
"""D in m, and the mission with R, T_s, v_max and omega_max: the settings of the sweep `settings`."""

COARSE = 40
"""The number of starting angles of a drawn plan."""
BEST = 20
"""The number of best plans so far near which others are drawn."""
LONG_TICK = 0.5
"""s: plans are drawn only where a tick is at least this long; with shorter ticks, that takes too long."""
LIMIT = 20.0
"""The time after which a simulation stops, in rounds of an orbit of radius D + R at v_max."""


class Meeting(NamedTuple):
    """The ticks until two robots are in range, over all pairs of starting angles."""

    mean: float
    worst: int


def meeting(setting: tuple[float, Mission], a: Orbit, b: Orbit, angles: int) -> Meeting:
    """Return the ticks until the orbits `a` and `b` meet, by simulation from all pairs of `angles` angles."""
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


def paper_orbits(setting: tuple[float, Mission]) -> tuple[Orbit, Orbit]:
    """Return the paper's orbits, inside (D + R) / 2 by m0 = (v T_s (1 - Omega / pi))^2 / (16 R)."""
    distance, mission = setting
    share = half_arc(distance, mission.sensing_range) / math.pi
    margin = (mission.max_speed * mission.period * (1.0 - share)) ** 2 / (16.0 * mission.sensing_range)
    radius = 0.5 * (distance + mission.sensing_range) - margin
    return driven(mission, radius, 1.0), driven(mission, radius, -share)


def driven(mission: Mission, radius: float, share: float) -> Orbit:
    """Return the circle of `radius` (m) at `share` of the highest speed on it; the sign is the direction."""
    omega = share * min(mission.max_turn_rate, mission.max_speed / max(radius, 1e-9))
    return Orbit(radius, abs(omega) * radius, omega)


def soonest(setting: tuple[float, Mission], plans: int) -> Meeting:
    """Return the result of that of `plans` drawn pairs of orbits which has the shortest mean time."""
    distance, mission = setting
    size = distance + mission.sensing_range
    draw = np.random.default_rng(1)
    best: list[tuple[Meeting, float, float, float]] = []
    for plan in range(plans):
        if plan < BEST or draw.random() < 0.3:
            radius_a, radius_b, share = draw.uniform([0.0, 0.0, -1.0], [size, size, 1.0])
        else:
            scale = 10.0 ** draw.uniform(-3.0, -0.7)
            _, *near = best[int(draw.integers(len(best)))]
            radius_a, radius_b, share = np.array(near) + scale * draw.normal(size=3) * [size, size, 1.0]
        radius_a, radius_b, share = abs(radius_a), abs(radius_b), float(np.clip(share, -1.0, 1.0))
        met = meeting(setting, driven(mission, radius_a, 1.0), driven(mission, radius_b, share), COARSE)
        best = sorted([*best, (met, radius_a, radius_b, share)])[:BEST]
    return best[0][0]


def main(angles: int, plans: int) -> None:
    """Print one line for each setting."""
    print(f"{'D, R, T_s, v_max, omega_max':>30}   assured: bound, mean / worst   paper's orbits   drawn")
    for setting in SETTINGS:
        distance, mission = setting
        plan = rendezvous(mission, distance, "assured")
        ours = meeting(setting, plan.a, plan.b, angles)
        theirs = meeting(setting, *paper_orbits(setting), math.ceil(angles / 6))
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
