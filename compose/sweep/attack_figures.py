"""The figures of a sweep over attacks: how many are detected, and how many honest missions are rejected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from compose.sweep.execution import Results
from compose.sweep.spec import Axis

FIELD = ".attack"
"""The end of the path of the field that such a sweep varies."""

HONEST = "honest"
"""The label of missions without an attack, with which the others are compared."""

OUTCOME_BARS = (("inconsistent", "#0b3c6f", ""), ("undecided", "#c9c9c9", ""), ("localised", "#9fc8a9", ".."))
"""The outcome, colour and hatch of each part of a bar. The remaining part is `wrong`."""

WRONG = "#d9541e"
"""The colour of `wrong`."""


def attack_axis(results: Results) -> int | None:
    """Return the index of the axis of attacks that includes HONEST; None if there is none."""
    for place, axis in enumerate(results.sweep.axes):
        if axis.fields[0].endswith(FIELD) and axis.labels is not None and HONEST in axis.labels:
            return place
    return None


def outcomes(results: Results, place: int) -> Figure:
    """Return a bar chart of the outcomes under each attack, a panel per combination of the other axes."""
    axis = results.sweep.axes[place]
    groups = _settings(results, place)
    labels = [axis.label(i) for i in range(len(axis.values))]
    figure = Figure(figsize=(3.2 + 2.6 * len(groups), 1.2 + 0.2 * len(labels)), layout="constrained")
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for panel, (name, cells) in zip(panels, groups, strict=True):
        left = np.zeros(len(labels))
        for outcome, colour, hatch in OUTCOME_BARS:
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
    """Return the receiver operating characteristic of detecting attacks by the least p-value of a mission.

    There is one line per kind and part of an attack; its sizes are pooled. Return None if all sensors are
    exact, because p-values are then 0 or 1.
    """
    axis = results.sweep.axes[place]
    baseline = _honest(axis)
    noisy = [
        (name, cells)
        for name, cells in _settings(results, place)
        if len(honest := _least(results.of(cells[baseline]))) and np.ptp(honest) > 0.0
    ]
    if not noisy:
        return None
    figure = Figure(figsize=(1.6 + 3.8 * len(noisy), 4.2), layout="constrained")
    panels = figure.subplots(1, len(noisy), sharey=True, squeeze=False)[0]
    kinds = list(dict.fromkeys([_kind(axis.label(i)) for i in range(len(axis.values))]))
    for panel, (name, cells) in zip(panels, noisy, strict=True):
        honest = np.sort(_least(results.of(cells[baseline])))
        false = np.arange(1, len(honest) + 1) / len(honest)
        for k, kind in enumerate([one for one in kinds if one != HONEST]):
            sizes = [cell for i, cell in enumerate(cells) if _kind(axis.label(i)) == kind]
            attacked = np.sort(np.concatenate([_least(results.of(cell)) for cell in sizes]))
            found = np.searchsorted(attacked, honest, side="right") / max(1, len(attacked))
            colour, line = f"C{k // 4}", ("-", "--", "-.", ":")[k % 4]
            panel.step(false, found, where="post", color=colour, ls=line, lw=1.2, label=kind)
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.set_title(name)
        panel.set_xlabel("honest missions rejected (false positive rate)")
        panel.set_ylim(0.0, 1.02)
    panels[0].set_ylabel("attacks detected (true positive rate)")
    handles, named = panels[0].get_legend_handles_labels()
    figure.legend(handles, named, loc="outside right center", frameon=False)
    return figure


def _settings(results: Results, place: int) -> list[tuple[str, list[int]]]:
    """Return the combinations of the other axes: a name, and the cell of each attack."""
    return [
        (", ".join([f"{name} {label}" for name, label in named]), cells)
        for named, cells in results.settings(place)
    ]


def _honest(axis: Axis) -> int:
    """Return the index of the value HONEST."""
    assert axis.labels is not None
    return list(axis.labels).index(HONEST)


def _kind(label: str) -> str:
    """Return the label of an attack without its size."""
    words: Sequence[str] = label.split()
    size = next((i for i, word in enumerate(words) if word[0].isdigit()), len(words))
    return " ".join(words[:size])


def _share(table: pa.Table, outcome: str) -> float:
    """Return the fraction of trials with this outcome; 0 without trials."""
    return float(np.mean(np.array(table["outcome"].to_pylist()) == outcome)) if len(table) else 0.0


def _least(table: pa.Table) -> NDArray[np.float64]:
    """Return the least p-value of each mission, shape (trials,).

    Without a p-value it is 0 if the outcome is `inconsistent`, else 1.
    """
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
