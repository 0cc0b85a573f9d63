"""Pictures of a sweep over lies: which are found out, and at what price in false alarms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from compose.sweep.execution import Results
from compose.sweep.spec import Axis

FIELD = ".attack"
"""how the path of the field ends that is varied"""

HONEST = "honest"
"""the label of the truth, against which lies are held"""

OUTCOMES = (("inconsistent", "#0b3c6f", ""), ("undecided", "#c9c9c9", ""), ("localised", "#9fc8a9", ".."))
"""outcome, colour, hatch; what is left is wrong"""

WRONG = "#d9541e"


def axis_of_lies(results: Results) -> int | None:
    """Which axis is of lies, with the truth among its values; none if there is none."""
    for place, axis in enumerate(results.sweep.axes):
        if axis.fields[0].endswith(FIELD) and axis.labels is not None and HONEST in axis.labels:
            return place
    return None


def outcomes(results: Results, place: int) -> Figure:
    """What became of the missions under each lie: found out, believed without harm, or believed and wrong."""
    axis = results.sweep.axes[place]
    groups = _settings(results, place)
    labels = [axis.label(i) for i in range(len(axis.values))]
    figure = Figure(figsize=(3.2 + 2.6 * len(groups), 1.2 + 0.2 * len(labels)), layout="constrained")
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for panel, (name, cells) in zip(panels, groups, strict=True):
        left = np.zeros(len(labels))
        for outcome, colour, hatch in OUTCOMES:
            share = np.array([_share(results.of(cell), outcome) for cell in cells])
            panel.barh(labels, share, left=left, color=colour, hatch=hatch, edgecolor="white", label=outcome)
            left += share
        panel.barh(labels, 1.0 - left, left=left, color=WRONG, hatch="//", edgecolor="white", label="wrong")
        panel.set_title(name)
        panel.set_xlim(0.0, 1.0)
        panel.set_xlabel("share of missions")
    panels[0].set_ylim(len(labels) - 0.5, -0.5)
    handles, named = panels[0].get_legend_handles_labels()
    figure.legend(handles, named, loc="outside upper center", ncols=4, frameon=False)
    return figure


def roc(results: Results, place: int) -> Figure | None:
    """Receiver operating characteristic: lies told apart from the truth by the least p-value of a mission.

    A line for each kind and part of a lie, all its sizes pooled. No picture where sensors are exact: there a
    p-value is 0 or 1.
    """
    axis = results.sweep.axes[place]
    truth = _honest(axis)
    noisy = [
        (name, cells)
        for name, cells in _settings(results, place)
        if len(honest := _least(results.of(cells[truth]))) and np.ptp(honest) > 0.0
    ]
    if not noisy:
        return None
    figure = Figure(figsize=(1.6 + 3.8 * len(noisy), 4.2), layout="constrained")
    panels = figure.subplots(1, len(noisy), sharey=True, squeeze=False)[0]
    kinds = list(dict.fromkeys([_kind(axis.label(i)) for i in range(len(axis.values))]))
    for panel, (name, cells) in zip(panels, noisy, strict=True):
        honest = np.sort(_least(results.of(cells[truth])))
        false = np.arange(1, len(honest) + 1) / len(honest)
        for k, kind in enumerate([one for one in kinds if one != HONEST]):
            sizes = [cell for i, cell in enumerate(cells) if _kind(axis.label(i)) == kind]
            lies = np.sort(np.concatenate([_least(results.of(cell)) for cell in sizes]))
            found = np.searchsorted(lies, honest, side="right") / max(1, len(lies))
            colour, line = f"C{k // 4}", ("-", "--", "-.", ":")[k % 4]
            panel.step(false, found, where="post", color=colour, ls=line, lw=1.2, label=kind)
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.set_title(name)
        panel.set_xlabel("honest missions held to be lies")
        panel.set_ylim(0.0, 1.02)
    panels[0].set_ylabel("lies found out")
    handles, named = panels[0].get_legend_handles_labels()
    figure.legend(handles, named, loc="outside right center", frameon=False)
    return figure


def _settings(results: Results, place: int) -> list[tuple[str, list[int]]]:
    """The other axes' choices: what to call each, and the cell of each lie in it."""
    return [
        (", ".join([f"{name} {label}" for name, label in named]), cells)
        for named, cells in results.settings(place)
    ]


def _honest(axis: Axis) -> int:
    assert axis.labels is not None
    return list(axis.labels).index(HONEST)


def _kind(label: str) -> str:
    """The label without its size."""
    words: Sequence[str] = label.split()
    size = next((i for i, word in enumerate(words) if word[0].isdigit()), len(words))
    return " ".join(words[:size])


def _share(table: pa.Table, outcome: str) -> float:
    return float(np.mean(np.array(table["outcome"].to_pylist()) == outcome)) if len(table) else 0.0


def _least(table: pa.Table) -> NDArray[np.float64]:
    """The least p-value in each mission; 0 where an alarm needed none, 1 where nothing was in doubt."""
    names = [name for name in table.column_names if name.endswith("_p_value")]
    columns = [table[name].to_pylist() for name in names]
    rows = zip(table["outcome"].to_pylist(), *columns, strict=True)
    return np.array(
        [
            min(
                [value for value in values if value is not None],
                default=0.0 if outcome == "inconsistent" else 1.0,
            )
            for outcome, *values in rows
        ]
    )
