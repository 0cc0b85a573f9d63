"""A search for a short wake-up forest of a group that is too large for the optimum."""

from __future__ import annotations

import random
from collections.abc import Callable

from compose.scenario.open_forest import OpenForest
from compose.scenario.wake_up_tree import MeetingTimes, WakeUpForest

STEPS = 1000
"""The changes that are tried."""
MOST_RELEASED = 10
"""The most robots that a change takes out of the forest, without their partners."""
SLACK = 0.05
"""The share by which a change may lengthen the shortest forest at the start of the search; it falls to zero."""
SEED = 21


def short_forest(times: MeetingTimes, steps: int = STEPS) -> WakeUpForest:
    """Return the shortest forest that the search finds.

    A step releases robots near one of those on which the last end rests, and inserts them again in another order
    (ruin and recreate, Schrimpf et al., J. Comput. Phys. 159, 2000). All random numbers come from a constant seed.
    """
    draw = random.Random(SEED).random
    near = [sorted(times.robots, key=row.__getitem__) for row in times.hop]
    forest = OpenForest(times)
    forest.insert(_shuffled(list(times.robots), draw))
    best = forest
    for step in range(steps):
        changed = forest.copy()
        latest = changed.latest()
        centre = latest[int(draw() * len(latest))]
        count = 2 + int(draw() * (MOST_RELEASED - 1))
        parts = changed.release([centre, *(robot for robot in near[centre][: 2 * count] if draw() < 0.5)])
        changed.insert(_shuffled(parts, draw))
        slack = 1.0 + SLACK * (1.0 - step / steps)
        if changed.length() <= max(forest.length(), best.length() * slack):
            forest = changed
        if changed.length() < best.length():
            best = changed
    return best.frozen()


def _shuffled(parts: list[int], draw: Callable[[], float]) -> list[int]:
    """Return `parts` in an order that is the same with every version of Python."""
    return [part for _, part in sorted((draw(), part) for part in parts)]
