"""Placeholder until the tree arrives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import msgspec


class PlannedVisit(msgspec.Struct, frozen=True, array_like=True):
    visitor: int
    visited: int
    ends: float


class GroupPlan(msgspec.Struct, frozen=True):
    meetings: tuple[PlannedVisit, ...]
    bound: float
    travel_lower_bound: float


def group_plan(
    anchors: Sequence[tuple[float, float]],
    seed_time: Callable[[int, int], float],
    speed: float,
    meeting: float,
) -> GroupPlan:
    n = len(anchors)
    t, a, b = min((seed_time(i, j), i, j) for i in range(n) for j in range(n) if i != j)
    out = [PlannedVisit(a, b, t)]
    free = {a: (t, b), b: (t, b)}
    left = set(range(n)) - {a, b}
    while left:
        e, v, w = min(
            (tt + math.dist(anchors[at], anchors[w]) / speed + meeting, v, w)
            for v, (tt, at) in free.items()
            for w in left
        )
        out.append(PlannedVisit(v, w, e))
        free[v] = free[w] = (e, w)
        left.discard(w)
    out.sort(key=lambda one: one.ends)
    return GroupPlan(tuple(out), max(one.ends for one in out), 0.0)
