"""The results of a sweep as its file `NAME.toml` states them, computed from the rows of its trials.

Unlike in `tandem sweep`, no two cells share missions: all trials are independent, so what is pooled over
cells has a known distribution. A file states no differences between cells.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from compose.sweep.cells import cells, label
from compose.sweep.spec import Sweep
from compose.sweep.statistics import column
from protocol import documents
from protocol.journal import environment

FOLDER = Path(__file__).parent
STRIDE = 10_000
"""The numbers of a cell's trials begin at its index times this, so that no two cells have the same seeds."""
SAMPLE = 20
"""The number of first trials of each cell that a file states one by one, for runs with the same seeds."""
NEES_CAP = 100.0
"""A NEES above this counts as this: such claims are wrong, and are counted as wrong."""
ROUNDING = 1e-6
"""Errors below this, in m and rad, are compared as this: with exact sensors they are rounding errors."""
QUANTILES = {"p50": 0.5, "p95": 0.95}
"""The quantiles that are compared, by the name of the field of Quantiles."""
Floats = NDArray[np.float64]


class Quantiles(msgspec.Struct, frozen=True):
    """Order statistics of `n` values: those with the ranks ceil(n / 2) and ceil(0.95 n), and the largest."""

    n: int
    p50: float
    p95: float
    max: float


class Mean(msgspec.Struct, frozen=True):
    """The number of values, their mean, and their standard deviation (0 of one value)."""

    n: int
    mean: float
    sd: float


class CellResults(msgspec.Struct, frozen=True, omit_defaults=True):
    """The results of a cell. A quantity that no trial has is None."""

    label: str
    """names and values of its axes"""
    outcomes: dict[str, int]
    """number of trials with each outcome, without those that have none"""
    ticks: Quantiles | None = None
    """ticks of the trials that localised; of groups, tick of the last claim of an honest robot"""
    error: Quantiles | None = None
    """largest position error of a claim of a trial in m"""
    heading: Quantiles | None = None
    """largest heading error of a claim of a trial in rad"""
    nees: float | None = None
    """mean of the trials' mean NEES"""
    wrong: int = 0
    """number of trials in which a claim of an honest robot is wrong"""
    means: dict[str, Mean] = {}
    """of each quantity in TRANSFORMED, as it is transformed there"""
    truth: tuple[int, int] | None = None
    """numbers of trials with claims under noise, and of those in which every such robot held the truth"""
    share: Quantiles | None = None
    """of groups: tick of the last claim of an honest robot over the computed bound"""
    travel: Quantiles | None = None
    """of groups: that tick over the ticks of travel alone"""
    honest: tuple[int, int, int] | None = None
    """of groups: numbers of honest robots with right claims, without a claim, and with wrong claims"""

    @property
    def trials(self) -> int:
        """The number of trials that were not refused."""
        return sum(self.outcomes.values()) - self.outcomes.get("refused", 0)


class Sample(msgspec.Struct, frozen=True, omit_defaults=True):
    """The first trials of a cell: first letters of the outcomes, the others separated by blanks."""

    outcomes: str
    ticks: str
    nees: str = ""
    decisions: str = ""
    """checksums of all Commands of a mission, in the environment of the file"""


class Landed(msgspec.Struct, frozen=True, omit_defaults=True):
    """The results of an earlier run with more trials, of one cell or of several that were stated together."""

    label: str
    commit: str
    """the commit that stated them"""
    trials: int
    """number of trials in each cell"""
    outcomes: dict[str, int]
    ticks: str = ""
    """ticks of the trials that localised, median / 95 % / largest, or ranges of these"""
    nees: str = ""
    """mean NEES, or the range of several"""
    other: str = ""
    """what else was stated"""


class Expected(msgspec.Struct, frozen=True, omit_defaults=True):
    """The content of a file `NAME.toml`."""

    sweep: str
    seed: int
    """seed of the sweep"""
    trials: int
    """number of trials in each cell"""
    version: str
    commit: str
    """last commit that changed the code of the robots, the world or what they share, when the trials ran"""
    cost: float
    """processor time in s of one trial in each cell, together"""
    cell: tuple[CellResults, ...]
    sample: tuple[Sample, ...]
    landed: tuple[Landed, ...] = ()
    """results of earlier runs, which are only shown; they stay until a run has as many trials"""
    notes: str = ""
    environment: str = ""
    """libraries and processor with which the trials ran: with the same, decisions are the same to the bit"""


TRANSFORMED: dict[str, Callable[[Floats], Floats]] = {
    "nees": lambda values: np.cbrt(np.minimum(values, NEES_CAP)),
    "ticks": lambda values: np.log(np.maximum(values, 1.0)),
    **dict.fromkeys(
        ("error", "heading", "share", "travel"), lambda values: np.log(np.maximum(values, ROUNDING))
    ),
}
"""The transformations under which quantities are averaged: the cube root of a NEES is nearly normal if
covariances are right (Wilson and Hilferty)."""


class Trials(msgspec.Struct, frozen=True):
    """The rows of trials as arrays, one element per trial; NaN for a value that does not apply."""

    cell: NDArray[np.int64]
    trial: NDArray[np.int64]
    """number of the trial in its cell, from 0"""
    outcome: NDArray[np.str_]
    wrong: NDArray[np.bool_]
    """whether a claim of an honest robot is wrong"""
    held: Floats
    """1 if the truth was held, 0 if not"""
    values: dict[str, Floats]
    """the quantities that have quantiles or means, by their names"""
    honest: Floats
    """numbers of honest robots of groups: right, undecided, wrong, shape (trials, 3)"""
    decisions: NDArray[np.str_]
    """checksum of all Commands; empty if it is not known"""

    @classmethod
    def of(cls, table: pa.Table, decisions: Sequence[str] = ()) -> Trials:
        """Return the arrays of a table of trials, and of the checksums of their decisions."""
        outcome = np.array(table["outcome"].to_pylist(), str)
        localised = outcome == "localised"
        values = {
            "nees": column(table, "nees"),
            "ticks": np.where(localised, column(table, "ticks"), math.nan),
            "error": column(table, "position_error_m"),
            "heading": column(table, "heading_error_rad"),
        }
        wrong = outcome == "wrong"
        honest = np.full((len(table), 3), math.nan)
        if "honest_tick" in table.schema.names:
            last = column(table, "honest_tick")
            values |= {
                "ticks": last,
                "share": last / column(table, "bound_ticks"),
                "travel": last / column(table, "travel_ticks"),
            }
            names = ("honest_localised", "honest_undecided", "honest_wrong")
            honest = np.stack([column(table, name) for name in names], axis=1)
            wrong = honest[:, 2] > 0.0
        return cls(
            table["cell"].to_numpy(),
            table["trial"].to_numpy(),
            outcome,
            wrong,
            column(table, "truth_held"),
            values,
            honest,
            np.array(decisions or [""] * len(table), str),
        )

    def where(self, chosen: NDArray[np.bool_]) -> Trials:
        """Return the chosen trials."""
        arrays = {name: getattr(self, name)[chosen] for name in self.__struct_fields__ if name != "values"}
        return Trials(**arrays, values={name: one[chosen] for name, one in self.values.items()})


def known(values: Floats) -> Floats:
    """Return `values` without those that are missing."""
    return values[~np.isnan(values)]


def quantiles(values: Floats) -> Quantiles | None:
    """Return the order statistics of `values`; None if there are none."""
    ordered = np.sort(known(values))
    if not len(ordered):
        return None
    at = [float(ordered[rank(p, len(ordered)) - 1]) for p in QUANTILES.values()]
    return Quantiles(len(ordered), *[_rounded(one) for one in (*at, float(ordered[-1]))])


def rank(p: float, n: int) -> int:
    """Return the rank of the quantile at `p` among `n` values, from 1."""
    return max(1, math.ceil(p * n))


def mean(values: Floats) -> Mean | None:
    """Return the mean of `values`; None if there are none."""
    values = known(values)
    if not len(values):
        return None
    sd = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return Mean(len(values), _rounded(float(values.mean())), _rounded(sd))


def expected(
    sweep: Sweep, trials: Trials, version: str, commit: str, cost: float = 0.0, notes: str = ""
) -> Expected:
    """Return what a file states of these trials, which have run in all cells and took `cost` s."""
    every = list(cells(sweep))
    of_cell = [trials.where(trials.cell == cell.index) for cell in every]
    rounds = max(1, int(trials.trial.max()) + 1)
    return Expected(
        sweep=sweep.name,
        seed=sweep.seed,
        trials=rounds,
        version=version,
        commit=commit,
        cost=_rounded(cost / rounds, 3),
        cell=tuple([cell_results(label(sweep, one), of) for one, of in zip(every, of_cell, strict=True)]),
        sample=tuple([sample(of) for of in of_cell]),
        notes=notes,
        environment=f"{environment.of_robot()}",
    )


def cell_results(name: str, trials: Trials) -> CellResults:
    """Return the results of the cell `name`."""
    values = trials.values
    nees = known(values["nees"])
    held = known(trials.held)
    honest = trials.honest[~np.isnan(trials.honest).any(axis=1)].sum(axis=0)
    nothing = np.zeros(0)
    return CellResults(
        label=name,
        outcomes=dict(sorted(Counter(trials.outcome.tolist()).items())),
        ticks=quantiles(values["ticks"]),
        error=quantiles(values["error"]),
        heading=quantiles(values["heading"]),
        nees=_rounded(float(nees.mean())) if len(nees) else None,
        wrong=int(trials.wrong.sum()),
        means={
            name: one
            for name, of in TRANSFORMED.items()
            if name in values and (one := mean(of(known(values[name])))) is not None
        },
        truth=(len(held), int(held.sum())) if len(held) else None,
        share=quantiles(values.get("share", nothing)),
        travel=quantiles(values.get("travel", nothing)),
        honest=(int(honest[0]), int(honest[1]), int(honest[2])) if "share" in values else None,
    )


def sample(trials: Trials) -> Sample:
    """Return the first trials of a cell, one by one."""
    first = trials.where(trials.trial < SAMPLE)
    nees = first.values["nees"]
    return Sample(
        "".join([outcome[0] for outcome in first.outcome.tolist()]),
        " ".join([_text(value) for value in first.values["ticks"]]),
        " ".join([_text(value) for value in nees]) if not np.isnan(nees).all() else "",
        " ".join(first.decisions.tolist()) if all(first.decisions) else "",
    )


def sampled(text: str) -> Floats:
    """Return the values of a field of Sample."""
    return np.array([math.nan if one == "-" else float(one) for one in text.split()])


def _text(value: float) -> str:
    """Return a value of a sample with three digits, or all of a number of ticks; "-" if it is missing."""
    if math.isnan(value):
        return "-"
    return str(int(value)) if value == int(value) else f"{value:.3g}"


def _rounded(value: float, digits: int = 6) -> float:
    return float(f"{value:.{digits}g}")


def path_of(name: str) -> Path:
    """Return the path of the file of the sweep `name`."""
    return FOLDER / f"{name}.toml"


def read(name: str) -> Expected | None:
    """Return the file of the sweep `name`; None if there is none."""
    path = path_of(name)
    if not path.exists():
        return None
    return msgspec.convert(documents.toml_table(path.read_text()), Expected)


def toml_text(results: Expected) -> str:
    """Return the text of a file: one line for each cell and each sample."""
    table = msgspec.to_builtins(results)
    lines = [
        f"# Written by `python -m tests.expected {results.sweep} --write`; results.py explains the fields."
    ]
    for name, value in table.items():
        if isinstance(value, list | tuple):
            lines += [f"{name} = [", *[f"    {_inline(one)}," for one in value], "]"]
        else:
            lines.append(f"{name} = {_inline(value)}")
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    """Return a value in the syntax of TOML, on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join([f"{_key(name)} = {_inline(one)}" for name, one in value.items()]) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join([_inline(one) for one in value]) + "]"
    return json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() else json.dumps(name)
