"""Pictures of a sweep over kills: whose death in which tick left another record, and what it cost."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from compose.sweep.execution import Results
from compose.sweep.statistics import column

NOBODY = "nobody"
"""the label of the missions without a kill, which the others are held against"""
TICK = re.compile(r"kill\[[0-9]+\]\.tick").fullmatch
ABOVE = 95.0
"""percentile from which on a cost has the darkest colour"""
LEAST_INCHES = 3.2
"""of height, for what is written beside the colours"""
MOST_LABELS = 14
"""of ticks"""


def axis_of_ticks(results: Results) -> int | None:
    """Which axis is of the tick of a kill, the first of its fields; none if there is none."""
    for place, axis in enumerate(results.sweep.axes):
        whole = all(isinstance(values[0], int) for values in axis.values)
        if len(axis.values) > 1 and whole and TICK(axis.fields[0]):
            return place
    return None


def costs(results: Results, place: int) -> Figure:
    """For each choice of the other axes and each tick of the kill: same record or not, and the wall time.

    That is what it took longer than nobody's in the median, or all of it where there is nobody's.
    """
    ticks = [values[0] for values in results.sweep.axes[place].values]
    tables = {
        ", ".join([label for _, label in named]): [results.of(cell) for cell in cells]
        for named, cells in results.settings(place)
    }
    nobody = tables.pop(NOBODY, None)
    wall = np.array([[_median(table) for table in row] for row in tables.values()])
    if nobody is not None:
        wall -= _median(pa.concat_tables(nobody))
    figure = Figure(figsize=(8.2, max(LEAST_INCHES, 1.5 + 0.22 * len(tables))), layout="constrained")
    axes = figure.subplots()
    known = wall[~np.isnan(wall)]
    top = float(np.percentile(known, ABOVE)) if len(known) else 1.0
    image = axes.imshow(wall, aspect="auto", cmap="Blues", vmin=0.0, vmax=max(top, 1e-3))
    for said, marker, colour, size in (
        ("another record, or none", "x", "#d9541e", 40),
        ("the point never came", ".", "0.45", 8),
    ):
        found = [
            (x, y)
            for y, row in enumerate(tables.values())
            for x, table in enumerate(row)
            if (_lost(table) if marker == "x" else _never(table))
        ]
        if found:
            at = np.array(found).T
            axes.scatter(at[0], at[1], marker=marker, c=colour, s=size, label=said)
    every = -(-len(ticks) // MOST_LABELS)
    axes.set_xticks(range(0, len(ticks), every), [str(tick) for tick in ticks[::every]])
    axes.set_yticks(range(len(tables)), list(tables))
    axes.set_xlabel("tick of the kill")
    kind = "more than with no kill" if nobody is not None else "in all"
    figure.colorbar(image, ax=axes, label=f"wall time, s, {kind}", extend="max")
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def _median(table: pa.Table) -> float:
    """Of the wall times, s; NaN of none."""
    wall: NDArray[np.float64] = column(table, "wall_s")
    return float(np.median(wall)) if len(wall) else np.nan


def _lost(table: pa.Table) -> bool:
    return any(same is not True for same in _said(table, "same_record"))


def _never(table: pa.Table) -> bool:
    kills = _said(table, "kills")
    return bool(kills) and all(count == 0 for count in kills)


def _said(table: pa.Table, name: str) -> Sequence[object]:
    found: list[object] = table[name].to_pylist()
    return found
