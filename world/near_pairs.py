"""The pairs of places that are near each other, found with a grid of cells."""

from __future__ import annotations

import math
from collections.abc import Sequence

CELL_ROUNDING = 1e-9
"""The part by which a cell is wider than the reach: rounding must not put near places two cells apart."""


def near_pairs(places: Sequence[tuple[float, float]], reach: float) -> list[tuple[int, int]]:
    """Return all pairs of `places`, given in m, that are at most `reach` m apart, and some that are farther.

    Each pair is its two indices, the smaller one first. The pairs are sorted.
    """
    width = reach * (1.0 + CELL_ROUNDING)
    cells: dict[tuple[int, int], list[int]] = {}
    pairs: list[tuple[int, int]] = []
    for j, (x, y) in enumerate(places):
        column, row = math.floor(x / width), math.floor(y / width)
        for here in (column - 1, column, column + 1):
            for there in (row - 1, row, row + 1):
                pairs += [(i, j) for i in cells.get((here, there), ())]
        cells.setdefault((column, row), []).append(j)
    pairs.sort()
    return pairs
