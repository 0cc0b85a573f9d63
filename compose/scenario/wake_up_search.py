"""A search for a short wake-up forest of a group that is too large for the optimum."""

from __future__ import annotations

import random
from collections.abc import Callable

from compose.scenario.open_forest import OpenForest
from compose.scenario.wake_up_tree import MeetingTimes, WakeUpForest

SEARCH_STEPS = 1000
"""The changes that are tried."""
MOST_RELEASED = 10
"""The most robots that a change takes out of the forest, without their partners."""
STEP_SLACK = 0.05
"""The share by which a step may exceed the shortest forest at the start of the search; it falls to zero."""
SEARCH_SEED = 21


def short_forest(times: MeetingTimes, steps: int = SEARCH_STEPS) -> WakeUpForest:
    """Return the shortest forest that the search finds.

    A step releases robots near one of those on which the last end depends, and inserts them again in another
    order: ruin and recreate (Schrimpf et al., J. Comput. Phys. 159, 2000) with blinks (Christiaens and
    Vanden Berghe, Transp. Sci. 54, 2020). The search ends early at a lower bound. Its seed is a constant. No
    ratio to the optimum is proved, as one is for `sector_forest`.
    """
    draw = random.Random(SEARCH_SEED).random
    near = [sorted(times.robots, key=row.__getitem__) for row in times.hop]
    forest = OpenForest(times)
    forest.insert(_shuffled(list(times.robots), draw), draw)
    best = forest
    lower_bound = times.earliest_end()
    for step in range(steps):
        if best.length() <= lower_bound:
            break
        changed = forest.copy()
        latest = changed.latest()
        centre = latest[int(draw() * len(latest))]
        count = 2 + int(draw() * (MOST_RELEASED - 1))
        parts = changed.release([centre, *(robot for robot in near[centre][: 2 * count] if draw() < 0.5)])
        changed.insert(_shuffled(parts, draw), draw)
        slack = 1.0 + STEP_SLACK * (1.0 - step / steps)
        if changed.length() <= max(forest.length(), best.length() * slack):
            forest = changed
        if changed.length() < best.length():
            best = changed
    return best.frozen()


def _shuffled(parts: list[int], draw: Callable[[], float]) -> list[int]:
    """Return `parts` in an order that is the same with every version of Python."""
    return [part for _, part in sorted((draw(), part) for part in parts)]
