"""The differences between the cells of a paired axis, trial by trial, and `differences.csv`.

Trials with the same number have the same seed in both cells, hence the same starts, sensors and faults, and
the difference of their results has a smaller variance than that of two medians.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from statistics import NormalDist

import msgspec
import numpy as np
import pyarrow as pa
from scipy.special import stdtrit  # type: ignore[import-untyped]

from compose.sweep.cells import Cell
from compose.sweep.spec import Sweep
from compose.sweep.statistics import CONFIDENCE, Floats, column


class PairedDifference(msgspec.Struct, frozen=True):
    """The results of a cell less those of the cell with the first value of the same axis.

    A CellSummary describes a cell, this a pair of them. A pair is two trials with the same number that both
    ran: neither was refused, and neither has an error. Intervals have a confidence of 95 %.
    """

    axis: str
    """name of the axis; the two cells have the same values of all others"""
    value: str
    """its value in the cell"""
    reference: str
    """its first value, that of the other cell"""
    cell: int
    """index of the cell"""
    reference_cell: int
    """index of the other cell"""
    pairs: int
    """number of pairs"""
    both_localised: int
    """number of pairs of which both trials localised"""
    only_value: int
    """number of pairs of which only the trial of the cell localised"""
    only_reference: int
    """number of pairs of which only the trial of the other cell localised"""
    ticks: float | None
    """mean difference of the ticks of the pairs of which both localised: no other mission has a time until it
    is localised; below 0 where the value is faster"""
    ticks_low: float | None
    """lower bound of the interval of this mean, by Student's t"""
    ticks_high: float | None
    """its upper bound"""
    rate: float | None
    """share of all pairs of which only the trial of the cell localised, less that of the other cell"""
    rate_low: float | None
    """lower bound of the interval of this difference (Bonett and Price 2012)"""
    rate_high: float | None
    """its upper bound"""


def paired_differences(sweep: Sweep, cells: Sequence[Cell], table: pa.Table) -> tuple[PairedDifference, ...]:
    """Return the differences of all cells of paired axes, in the order of the axes and of their cells.

    `table` has the trials of the sweep, sorted by cell.
    """
    places = {cell.place: cell for cell in cells}
    numbers = table["cell"].to_numpy()
    trials = {
        cell.index: _Trials.of(table.slice(begin, end - begin))
        for cell in cells
        for begin, end in [np.searchsorted(numbers, [cell.index, cell.index + 1])]
    }
    found = []
    for i, axis in enumerate(sweep.axes):
        for cell in cells if axis.paired else ():
            if cell.place[i]:
                first = places[(*cell.place[:i], 0, *cell.place[i + 1 :])]
                found.append(
                    _difference(
                        (axis.name, axis.label(cell.place[i]), axis.label(0), cell.index, first.index),
                        trials[cell.index],
                        trials[first.index],
                    )
                )
    return tuple(found)


class _Trials(msgspec.Struct, frozen=True):
    """The trials of a cell that ran: their numbers, whether they localised, and their ticks."""

    numbers: np.ndarray
    localised: np.ndarray
    ticks: Floats

    @classmethod
    def of(cls, table: pa.Table) -> _Trials:
        outcomes = table["outcome"].to_pylist()
        ran = np.array([outcome != "refused" for outcome in outcomes], bool)
        ran &= table["error"].is_null().to_numpy()
        localised = np.array([outcome == "localised" for outcome in outcomes], bool)
        return cls(table["trial"].to_numpy()[ran], localised[ran], column(table, "ticks")[ran])


def _difference(names: tuple[str, str, str, int, int], these: _Trials, those: _Trials) -> PairedDifference:
    """Return the difference of the trials `these` less `those`; both are sorted by number."""
    shared, i, j = np.intersect1d(these.numbers, those.numbers, return_indices=True)
    one, other = these.localised[i], those.localised[j]
    both = one & other
    only_value, only_reference = int((one & ~other).sum()), int((other & ~one).sum())
    return PairedDifference(
        *names,
        len(shared),
        int(both.sum()),
        only_value,
        only_reference,
        *mean_interval(these.ticks[i][both] - those.ticks[j][both]),
        *rate_interval(only_value, only_reference, len(shared)),
    )


def mean_interval(values: Floats) -> tuple[float | None, float | None, float | None]:
    """Return the mean of `values` and the bounds of its interval; None where there are too few."""
    if not len(values):
        return None, None, None
    mean = float(values.mean())
    if len(values) < 2:
        return mean, None, None
    quantile = float(stdtrit(len(values) - 1, 0.5 + 0.5 * CONFIDENCE))
    half = quantile * float(values.std(ddof=1)) / math.sqrt(len(values))
    return mean, mean - half, mean + half


def rate_interval(
    only_value: int, only_reference: int, pairs: int
) -> tuple[float | None, float | None, float | None]:
    """Return the difference of two paired rates and the bounds of its interval; None without pairs.

    It is Wald's interval after one more pair of each kind that differs (D. G. Bonett and R. M. Price,
    "Adjusted Wald confidence interval for a difference of binomial proportions based on paired data", 2012).
    """
    if not pairs:
        return None, None, None
    one, other = (only_value + 1.0) / (pairs + 2.0), (only_reference + 1.0) / (pairs + 2.0)
    z = NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE)
    half = z * math.sqrt((one + other - (one - other) ** 2) / (pairs + 2.0))
    low, high = max(-1.0, one - other - half), min(1.0, one - other + half)
    return (only_value - only_reference) / pairs, low, high


def differences_csv(differences: Sequence[PairedDifference]) -> str:
    """Return the text of `differences.csv`."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(PairedDifference.__struct_fields__)
    rows.writerows([msgspec.structs.astuple(one) for one in differences])
    return out.getvalue()
