"""The figure of a sweep over kills: which kills changed the recording, and what they cost in wall time."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from compose.sweep.execution import Results
from compose.sweep.statistics import column

BASELINE = "nobody"
"""The label of missions without a kill, against which the wall time of the others is compared."""
KILL_TICK = re.compile(r"kill\[[0-9]+\]\.tick").fullmatch
ABOVE = 95.0
"""The percentile of the wall times above which a field has the darkest colour."""
LEAST_INCHES = 3.2
"""The least height of the figure in inches, so that the label of the colour bar fits."""
MOST_LABELS = 14
"""The largest number of labelled ticks on the horizontal axis."""


def kill_tick_axis(results: Results) -> int | None:
    """Return the index of the axis whose first field is the tick of a kill; None if there is none."""
    for place, axis in enumerate(results.sweep.axes):
        whole = all(isinstance(values[0], int) for values in axis.values)
        if len(axis.values) > 1 and whole and KILL_TICK(axis.fields[0]):
            return place
    return None


def costs(results: Results, place: int) -> Figure:
    """Return a heat map of the wall time, with a row per combination of the other axes and a column per tick.

    The wall time is the median in excess of that of missions without a kill, or the whole median if there are
    none. Markers show trials with a different recording, and kills that never took place.
    """
    ticks = [values[0] for values in results.sweep.axes[place].values]
    tables = {
        ", ".join([label for _, label in named]): [results.of(cell) for cell in cells]
        for named, cells in results.settings(place)
    }
    baseline = tables.pop(BASELINE, None)
    wall = np.array([[_median(table) for table in row] for row in tables.values()])
    if baseline is not None:
        wall -= _median(pa.concat_tables(baseline))
    figure = Figure(figsize=(8.2, max(LEAST_INCHES, 1.5 + 0.22 * len(tables))), layout="constrained")
    axes = figure.subplots()
    known = wall[~np.isnan(wall)]
    top = float(np.percentile(known, ABOVE)) if len(known) else 1.0
    image = axes.imshow(wall, aspect="auto", cmap="Blues", vmin=0.0, vmax=max(top, 1e-3))
    for label, marker, colour, size in (
        ("recording differs or is missing", "x", "#d9541e", 40),
        ("kill did not take place", ".", "0.45", 8),
    ):
        found = [
            (x, y)
            for y, row in enumerate(tables.values())
            for x, table in enumerate(row)
            if (_lost(table) if marker == "x" else _never(table))
        ]
        if found:
            at = np.array(found).T
            axes.scatter(at[0], at[1], marker=marker, c=colour, s=size, label=label)
    every = -(-len(ticks) // MOST_LABELS)
    axes.set_xticks(range(0, len(ticks), every), [str(tick) for tick in ticks[::every]])
    axes.set_yticks(range(len(tables)), list(tables))
    axes.set_xlabel("tick of the kill")
    kind = "more than without a kill" if baseline is not None else "in total"
    figure.colorbar(image, ax=axes, label=f"wall time, s, {kind}", extend="max")
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def _median(table: pa.Table) -> float:
    """Return the median wall time in s; NaN without trials."""
    wall: NDArray[np.float64] = column(table, "wall_s")
    return float(np.median(wall)) if len(wall) else np.nan


def _lost(table: pa.Table) -> bool:
    """Return true if the recording of any trial differs from that without kills, or is missing."""
    return any(same is not True for same in _values(table, "same_record"))


def _never(table: pa.Table) -> bool:
    """Return true if no kill took place in any trial."""
    kills = _values(table, "kills")
    return bool(kills) and all(count == 0 for count in kills)


def _values(table: pa.Table, name: str) -> Sequence[object]:
    found: list[object] = table[name].to_pylist()
    return found
