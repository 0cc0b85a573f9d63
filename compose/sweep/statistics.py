"""A row a cell: how many of its trials ended how, how long they took, and how exact they were."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any, get_args

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.special import gammainccinv, gammaincinv  # type: ignore[import-untyped]

from compose.recording.claim import DEGREES_OF_FREEDOM
from compose.sweep.cells import Cell
from compose.sweep.field_paths import canonical
from compose.sweep.spec import Sweep
from compose.sweep.trial import TrialOutcome
from protocol.messages import Outcome

_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?")
Floats = NDArray[np.float64]
CONFIDENCE = 0.95
"""of an interval"""
NEES_CONFIDENCE = 0.99
"""of the band of a mean NEES"""
WORSE = ("wrong", "inconsistent", "failed", "undecided")
"""outcomes that call for a look, the worst first"""


class CellSummary(msgspec.Struct, frozen=True):
    """A row of `summary.csv`, after its axes; what does not apply is None."""

    trials: int
    localised: int
    undecided: int
    inconsistent: int
    wrong: int
    failed: int
    """lost to an error, or to a process that was"""
    rate: float | None
    """localised, of all trials"""
    rate_low: float | None
    rate_high: float | None
    """Wilson's interval"""
    ticks_p10: float | None
    """until all was known; of trials that localised"""
    ticks_p50: float | None
    ticks_p90: float | None
    ticks_p95: float | None
    ticks_max: float | None
    meeting_tick_p50: float | None
    """when phase 3 began; of trials in which it did"""
    meeting_tick_max: float | None
    t_max_s: float | None
    t_max_ratio_max: float | None
    """the longest that both orbited until phase 3 began, over T_max"""
    error_p50_m: float | None
    """of the worse robot of each trial in which one claimed"""
    error_max_m: float | None
    error_max_rad: float | None
    claims: int
    """of a pose, by all robots"""
    within_3_accuracy: float | None
    """of these, off by no more than 3 times mission.accuracy"""
    nees_mean: float | None
    """over trials that were not wrong, each with the mean of its robots' claims: 3 is expected where
    covariances are true"""
    nees_low: float | None
    """between which bounds that lies in 99 % of sweeps then"""
    nees_high: float | None
    rmse_over_bound: float | None
    """root mean square of the position errors of all robots, over that of their Cramér-Rao bounds"""
    reports_p50: float | None
    """sent, by all"""
    audited: int
    """trials"""
    clean: int
    """of these, without a violation"""
    violations: int
    """in all"""
    reports_lost: int
    """of all trials"""
    reports_refused: int
    refused_trials: int
    """trials in whose drawn setting no mission can be played; no other figure counts them"""
    refused: str | None
    """why no mission can be played in this setting"""


class NotableTrial(msgspec.Struct, frozen=True):
    """A trial that deserves a look: one that breaks a rule; else the worst outcome; else the longest."""

    cell: int
    trial: int
    seed: int
    outcome: TrialOutcome
    ticks: int | None
    why: str | None


def counted(table: pa.Table, refused: str | None = None) -> CellSummary:
    """The figures of these trials."""
    everything = len(table)
    table = _played(table)
    outcomes = table["outcome"].to_pylist()
    counts = {outcome: outcomes.count(outcome) for outcome in get_args(Outcome)}
    k, n = counts["localised"], len(outcomes)
    low, high = wilson(k, n)
    ticks = column(table, "ticks")[np.array([outcome == "localised" for outcome in outcomes], bool)]
    meeting, error = _known(column(table, "meeting_tick")), _known(column(table, "position_error_m"))
    right = table.filter(pa.array([outcome != "wrong" for outcome in outcomes], pa.bool_()))
    claims, nees = int(_known(column(table, "claims")).sum()), _known(column(right, "nees"))
    nees_low, nees_high = nees_band(len(nees))
    violations = _known(column(table, "violations"))
    return CellSummary(
        trials=n,
        **counts,
        rate=k / n if n else None,
        rate_low=low,
        rate_high=high,
        ticks_p10=_percentile(ticks, 10),
        ticks_p50=_percentile(ticks, 50),
        ticks_p90=_percentile(ticks, 90),
        ticks_p95=_percentile(ticks, 95),
        ticks_max=_percentile(ticks, 100),
        meeting_tick_p50=_percentile(meeting, 50),
        meeting_tick_max=_percentile(meeting, 100),
        t_max_s=_percentile(_known(column(table, "t_max_s")), 100),
        t_max_ratio_max=_percentile(_known(orbited_over_t_max(table)), 100),
        error_p50_m=_percentile(error, 50),
        error_max_m=_percentile(error, 100),
        error_max_rad=_percentile(_known(column(table, "heading_error_rad")), 100),
        claims=claims,
        within_3_accuracy=float(_known(column(table, "claims_within")).sum()) / claims if claims else None,
        nees_mean=float(nees.mean()) if len(nees) else None,
        nees_low=nees_low,
        nees_high=nees_high,
        rmse_over_bound=_rmse_over_bound(right),
        reports_p50=_percentile(_known(column(table, "reports_sent")), 50),
        audited=len(violations),
        clean=int((violations == 0.0).sum()),
        violations=int(violations.sum()),
        reports_lost=int(_known(column(table, "reports_lost")).sum()),
        reports_refused=int(_known(column(table, "reports_refused")).sum()),
        refused_trials=everything - n,
        refused=refused,
    )


def _rmse_over_bound(table: pa.Table) -> float | None:
    """Of all robots that have a bound."""
    names = [name.removesuffix("_bound_m") for name in table.schema.names if name.endswith("_bound_m")]
    if not names or not len(table):
        return None
    bounds = np.concatenate([column(table, f"{name}_bound_m") for name in names])
    errors = np.concatenate([column(table, f"{name}_position_error_m") for name in names])
    known = ~np.isnan(bounds)
    if not known.any():
        return None
    return float(np.sqrt(np.mean(errors[known] ** 2) / np.mean(bounds[known] ** 2)))


def wilson(k: int, n: int) -> tuple[float | None, float | None]:
    """Between which rates the true one lies, given k of n."""
    if not n:
        return None, None
    z = NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE)
    centre = (k + 0.5 * z * z) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(k * (n - k) / n + 0.25 * z * z)
    return 0.0 if k == 0 else centre - half, 1.0 if k == n else centre + half


def nees_band(trials: int) -> tuple[float | None, float | None]:
    """Between which bounds the mean of so many trials' NEES lies, where covariances are true.

    One robot's sum to a chi-square of 3 degrees of freedom a trial. A trial's mean over its robots varies as
    much where their errors go together, and less where they do not; so a mean outside is none by chance.
    """
    if not trials:
        return None, None
    tail = 0.5 * (1.0 - NEES_CONFIDENCE)
    half = 0.5 * DEGREES_OF_FREEDOM * trials  # chi-square of 2 a is twice a gamma of a
    low, high = 2.0 * gammaincinv(half, tail) / trials, 2.0 * gammainccinv(half, tail) / trials
    return float(low), float(high)


def column(table: pa.Table, name: str) -> Floats:
    """A column of numbers; NaN where there is none."""
    return np.asarray(table[name].cast(pa.float64()).to_numpy(), float)


def orbited_over_t_max(table: pa.Table) -> Floats:
    """How long both orbited until phase 3 began, over T_max: 0 if they met before, NaN if never."""
    meeting, orbiting = column(table, "meeting_tick"), column(table, "orbiting_tick")
    orbited = meeting - np.where(np.isnan(orbiting), meeting, orbiting)
    t_max = column(table, "t_max_s")
    at_once = np.where(orbited > 0.0, math.inf, orbited)  # where T_max is 0
    return np.divide(orbited * column(table, "period_s"), t_max, out=at_once, where=t_max > 0.0)


def summary_csv(sweep: Sweep, cells: Sequence[Cell], figures: Mapping[int, CellSummary]) -> str:
    """A row a cell."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(header(sweep))
    for cell in cells:
        axes: list[Any] = []
        for axis, place in zip(sweep.axes, cell.place, strict=True):
            axes += [axis.label(place)] if axis.labels is not None else []
            axes += [value if isinstance(value, str) else canonical(value) for value in axis.values[place]]
        rows.writerow([cell.index, *axes, *msgspec.structs.astuple(figures[cell.index])])
    return out.getvalue()


def header(sweep: Sweep) -> list[str]:
    """Of `summary.csv`."""
    axes = [
        name
        for axis in sweep.axes
        for name in ([axis.name] if axis.labels is not None else []) + list(axis.fields)
    ]
    return ["cell", *axes, *CellSummary.__struct_fields__]


def _played(table: pa.Table) -> pa.Table:
    """Return the trials that were not refused."""
    return table.filter(
        pa.array([outcome != "refused" for outcome in table["outcome"].to_pylist()], pa.bool_())
    )


def refusals(table: pa.Table) -> list[tuple[str, int]]:
    """Return why trials were refused, and how many; of reasons that differ in numbers only, the first."""
    first: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for outcome, reason in zip(table["outcome"].to_pylist(), table["reason"].to_pylist(), strict=True):
        if outcome != "refused":
            continue
        kind = _NUMBER.sub("", reason)
        counts[kind] += 1
        first.setdefault(kind, reason)
    return [(first[kind], count) for kind, count in counts.most_common()]


def noted(table: pa.Table) -> NotableTrial | None:
    """The trial to look at first, if any was played."""
    table = _played(table)
    if not len(table):
        return None
    outcomes = table["outcome"].to_pylist()
    worst = next((outcome for outcome in WORSE if outcome in outcomes), None)
    broken = np.flatnonzero(column(table, "violations") > 0.0)
    if len(broken):
        place = int(broken[0])
    else:
        place = outcomes.index(worst) if worst is not None else int(np.nanargmax(column(table, "ticks")))
    found = table.slice(place, 1).to_pylist()[0]
    return NotableTrial(
        cell=found["cell"],
        trial=found["trial"],
        seed=found["seed"],
        outcome=found["outcome"],
        ticks=found["ticks"],
        why=found["first_violation"] or found["error"] or found["reason"],
    )


def _known(values: Floats) -> Floats:
    return values[~np.isnan(values)]


def _percentile(values: Floats, percent: float) -> float | None:
    """Between the two nearest, in proportion; None of none."""
    return float(np.percentile(values, percent)) if len(values) else None
