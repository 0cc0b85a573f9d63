"""The differences between the cells of a paired axis, trial by trial, and `differences.csv`.

Trials with the same number have the same seed in both cells, hence the same starts, sensors and faults, and
the difference of their results has a smaller variance than that of two medians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
from scipy.special import stdtrit  # type: ignore[import-untyped]

from compose.sweep.cells import Cell
from compose.sweep.spec import Sweep
from compose.sweep.statistics import CONFIDENCE, CellTrials, Floats, Number, by_cell, column

MaybeInterval = tuple[Number, Number, Number]
"""An estimate and the bounds of its interval, each None where there are too few values."""


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
    """Return the differences of all cells of paired axes, in the order of the axes and of their cells."""
    table = table.filter(table["error"].is_null())
    index_of = {cell.place: cell.index for cell in cells}
    trials = {i: CellTrials(one) for i, one in by_cell(table, cells).items()}
    return tuple(
        PairedDifference(
            axis.name,
            axis.label(cell.place[i]),
            axis.label(0),
            cell.index,
            first,
            *_difference(trials[cell.index], trials[first]),
        )
        for i, axis in enumerate(sweep.axes)
        for cell in (cells if axis.paired else ())
        if cell.place[i]
        for first in [index_of[(*cell.place[:i], 0, *cell.place[i + 1 :])]]
    )


def _difference(these: CellTrials, those: CellTrials) -> tuple[Any, ...]:
    """Return the fields of a PairedDifference from `pairs` on."""
    numbers = [one.table["trial"].to_numpy() for one in (these, those)]
    pairs, *places = np.intersect1d(*numbers, return_indices=True)
    localised, ticks = [], []
    for one, place in zip((these, those), places, strict=True):
        localised.append(np.array(one.localised, bool)[place])
        ticks.append(column(one.table, "ticks")[place])
    both = localised[0] & localised[1]
    only, only_other = [int((one & ~both).sum()) for one in localised]
    mean = mean_interval((ticks[0] - ticks[1])[both])
    rate = rate_interval(only, only_other, len(pairs))
    return len(pairs), int(both.sum()), only, only_other, *mean, *rate


def mean_interval(values: Floats) -> MaybeInterval:
    """Return the mean of `values` and the bounds of its interval; None where there are too few."""
    if not len(values):
        return None, None, None
    mean = float(values.mean())
    if len(values) < 2:
        return mean, None, None
    quantile = float(stdtrit(len(values) - 1, 0.5 + 0.5 * CONFIDENCE))
    half = quantile * float(values.std(ddof=1)) / math.sqrt(len(values))
    return mean, mean - half, mean + half


def rate_interval(only_value: int, only_reference: int, pairs: int) -> MaybeInterval:
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
