"""The closest approach of two robots after their first mutual range."""

from __future__ import annotations

import math

from compose.recording.run import Run
from protocol.motion import Pose, step, travelled
from world.truth import Truth

INSTANTS = 32
"""The number of equal parts of a tick, at whose ends the distance is computed."""


def nearest(run: Run) -> float | None:
    """Return the smallest distance in m of a pair from its first mutual range on, also between ticks.

    In a group, any two robots are a pair, until one of them is dead: no robot can range it then.

    The result is None if no pair had a mutual range.
    """
    found = [_of_pair(run, pair) for pair in run.scenario.radio_pairs()]
    return min([one for one in found if one is not None], default=None)


def _of_pair(run: Run, pair: tuple[int, int]) -> float | None:
    of_pair = [run.robots[place] for place in pair]
    least, died = None, [one.tick for one in run.scenario.deaths if one.robot in of_pair]
    for tick in run.ticks[: min(died, default=None)]:
        mutual = tick.world.contacts.get(pair)
        if least is None and (mutual is None or mutual.range is None):
            continue
        paths = [_path(run, tick.truth, i) for i in pair]
        apart = map(travelled, *paths)
        least = min([*apart, least if least is not None else math.inf])
    return least


def _path(run: Run, truth: Truth, place: int) -> list[Pose]:
    """Return INSTANTS + 1 poses of a robot from this tick to the next; in the last tick, it is at rest."""
    pose, period = truth.poses[place], run.scenario.mission.period
    driven = run.driven(run.robots[place], truth.tick)
    if driven is None:
        return [pose] * (INSTANTS + 1)
    return [step(pose, driven.v, driven.omega, period * i / INSTANTS) for i in range(INSTANTS + 1)]
