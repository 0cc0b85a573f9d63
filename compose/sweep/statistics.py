"""The statistics of each cell: outcomes, durations and accuracy of its trials, and `summary.csv`."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple, get_args

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.special import bdtr, gammainccinv, gammaincinv  # type: ignore[import-untyped]

from compose.recording.claim import DEGREES_OF_FREEDOM
from compose.sweep.cells import Cell
from compose.sweep.field_paths import canonical
from compose.sweep.spec import Sweep
from compose.sweep.trial import TrialOutcome
from protocol.messages import Outcome

_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?")
Floats = NDArray[np.float64]
CONFIDENCE = 0.95
"""The confidence level of the interval of a success rate."""
NEES_CONFIDENCE = 0.99
"""The probability with which a mean NEES lies in its band if the covariances are consistent."""
WORSE = ("wrong", "inconsistent", "failed", "undecided")
"""The outcomes that need a look, the worst first."""
FIGURES_OF_GROUP = (
    *("bound_share_p50", "bound_share_max", "corrected_share_max", "makespan_p50", "makespan_p95"),
    *("honest_localised", "honest_undecided", "honest_wrong", "attacker_met", "attacker_found"),
)
"""The fields of a CellSummary that only groups have."""


class Interval(NamedTuple):
    """An estimate, and the bounds of its interval."""

    estimate: float
    low: float
    high: float


class CellSummary(msgspec.Struct, frozen=True):
    """A row of `summary.csv`, without the columns of the axes. A value that does not apply is None."""

    trials: int
    """number of trials that were not refused; the counts of the outcomes sum to it"""
    localised: int
    undecided: int
    inconsistent: int
    wrong: int
    failed: int
    """number of trials that failed or were lost"""
    rate: float | None
    """fraction of the trials that localised"""
    rate_low: float | None
    rate_high: float | None
    """bounds of the 95 % Wilson interval of the rate"""
    ticks_p10: float | None
    """percentiles of the number of ticks of trials that localised"""
    ticks_p50: float | None
    ticks_p90: float | None
    ticks_p95: float | None
    ticks_max: float | None
    meeting_tick_p50: float | None
    """median tick at which phase 3 began, of trials in which it began"""
    meeting_tick_max: float | None
    t_max_s: float | None
    """largest T_max of a trial, in s"""
    t_max_ratio_max: float | None
    """largest ratio of the time from both in orbit to phase 3 to T_max"""
    error_p50_m: float | None
    """median over trials with a claim of the largest position error of a robot"""
    error_max_m: float | None
    error_max_rad: float | None
    claims: int
    """number of claims by all robots"""
    within_3_accuracy: float | None
    """fraction of the claims with a position error of at most 3 times mission.accuracy"""
    truth_held: float | None
    """fraction of the trials with claims under noise in which every such robot held the true hypothesis"""
    nees_mean: float | None
    """mean over trials of the mean NEES of their robots' claims, wrong ones included; 3 is expected if the
    claimed covariances are consistent"""
    nees_low: float | None
    """lower bound of the band that contains nees_mean in 99 % of sweeps if covariances are consistent"""
    nees_high: float | None
    """upper bound of that band"""
    rmse_over_bound: float | None
    """root mean square of the position errors of all robots, divided by that of their Cramér-Rao bounds"""
    reports_p50: float | None
    """median number of reports that all robots of a trial sent"""
    audited: int
    """number of audited trials"""
    clean: int
    """number of audited trials without a violation"""
    violations: int
    """number of violations in all trials"""
    reports_lost: int
    """number of reports lost in all trials"""
    reports_refused: int
    """number of reports rejected in all trials"""
    refused_trials: int
    """number of trials whose scenario is infeasible with the drawn values; no other figure counts them"""
    refused: str | None
    """reason why the scenario of this cell is infeasible"""
    bound_share_p50: float | None
    """only for groups: median over trials in which all honest robots claimed of honest_tick / bound_ticks"""
    bound_share_max: float | None
    """only for groups: the largest of these"""
    corrected_share_max: float | None
    """only for groups: the largest honest_tick / corrected_ticks, of trials with a corrected bound"""
    makespan_p50: float | None
    """only for groups: median over the same trials of honest_tick / travel_ticks"""
    makespan_p95: float | None
    """only for groups: the 95th percentile of these"""
    honest_localised: int | None
    """only for groups: number of honest robots, of all trials, whose claims are right"""
    honest_undecided: int | None
    """only for groups: number of those that have no claim at the end"""
    honest_wrong: int | None
    """only for groups: number of those whose claims are wrong"""
    attacker_met: int | None
    """only for groups: number of their meetings with a robot that has an attack, of audited trials"""
    attacker_found: int | None
    """only for groups: number of these in which they found its data inconsistent"""


class NotableTrial(msgspec.Struct, frozen=True):
    """The trial to look at first: one with a violation, else the worst outcome, else the longest."""

    cell: int
    trial: int
    seed: int
    outcome: TrialOutcome
    ticks: int | None
    why: str | None


def counted(table: pa.Table, refused: str | None = None) -> CellSummary:
    """Return the statistics of the trials in `table`.

    `refused` is the reason why the scenario of the cell is infeasible, or None.
    """
    everything = len(table)
    table = ran(table)
    outcomes = table["outcome"].to_pylist()
    counts = {outcome: outcomes.count(outcome) for outcome in get_args(Outcome)}
    k, n = counts["localised"], len(outcomes)
    rate, low, high = wilson(k, n) if n else (None, None, None)
    ticks = column(table, "ticks")[np.array([outcome == "localised" for outcome in outcomes], bool)]
    meeting, error = _known(column(table, "meeting_tick")), _known(column(table, "position_error_m"))
    right = table.filter(pa.array([outcome != "wrong" for outcome in outcomes], pa.bool_()))
    claims, nees = int(_known(column(table, "claims")).sum()), _known(column(table, "nees"))
    nees_low, nees_high = nees_band(len(nees))
    violations = _known(column(table, "violations"))
    shares, makespans, corrected = [
        _shares(right, name) for name in ("bound_ticks", "travel_ticks", "corrected_ticks")
    ]
    return CellSummary(
        trials=n,
        **counts,
        rate=rate,
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
        truth_held=_fraction(table["truth_held"].to_pylist()),
        nees_mean=float(nees.mean()) if len(nees) else None,
        nees_low=nees_low,
        nees_high=nees_high,
        rmse_over_bound=_rmse_over_bound(table),
        reports_p50=_percentile(_known(column(table, "reports_sent")), 50),
        audited=len(violations),
        clean=int((violations == 0.0).sum()),
        violations=int(violations.sum()),
        reports_lost=int(_known(column(table, "reports_lost")).sum()),
        reports_refused=int(_known(column(table, "reports_refused")).sum()),
        refused_trials=everything - n,
        refused=refused,
        bound_share_p50=_percentile(shares, 50),
        bound_share_max=_percentile(shares, 100),
        corrected_share_max=_percentile(corrected, 100),
        makespan_p50=_percentile(makespans, 50),
        makespan_p95=_percentile(makespans, 95),
        honest_localised=_sum_of_known(table, "honest_localised"),
        honest_undecided=_sum_of_known(table, "honest_undecided"),
        honest_wrong=_sum_of_known(table, "honest_wrong"),
        attacker_met=_sum_of_known(table, "attacker_met"),
        attacker_found=_sum_of_known(table, "attacker_found"),
    )


def _shares(right: pa.Table, bound: str) -> Floats:
    """Return the tick of the last claim of an honest robot over the column `bound`; none for pairs."""
    if bound not in right.schema.names:
        return np.zeros(0)
    return _known(column(right, "honest_tick") / column(right, bound))


def _sum_of_known(table: pa.Table, name: str) -> int | None:
    """Return the sum of a column of groups; None for pairs, and if no trial has a value."""
    known = _known(column(table, name)) if name in table.schema.names else np.zeros(0)
    return int(known.sum()) if len(known) else None


def _rmse_over_bound(table: pa.Table) -> float | None:
    """Return the RMS position error over the RMS Cramér-Rao bound, of all robots with a bound.

    None if no robot has one.
    """
    names = [name.removesuffix("_bound_m") for name in table.schema.names if name.endswith("_bound_m")]
    if not names or not len(table):
        return None
    bounds = np.concatenate([column(table, f"{name}_bound_m") for name in names])
    errors = np.concatenate([column(table, f"{name}_position_error_m") for name in names])
    known = ~np.isnan(bounds)
    if not known.any():
        return None
    return float(np.sqrt(np.mean(errors[known] ** 2) / np.mean(bounds[known] ** 2)))


def wilson(k: int, n: int) -> Interval:
    """Return the rate of `k` successes in `n` trials, at least one, with its Wilson interval."""
    z = NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE)
    centre = (k + 0.5 * z * z) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(k * (n - k) / n + 0.25 * z * z)
    return Interval(k / n, 0.0 if k == 0 else centre - half, 1.0 if k == n else centre + half)


def quantile(values: Floats, p: float) -> Interval:
    """Return the quantile `p` of `values`, of which there is at least one, with linear interpolation.

    The bounds are order statistics, those of the binomial distribution of the number of values below the
    quantile: they hold for any distribution of the values. Where there are too few, they are the extremes.
    """
    ordered, n = np.sort(values), len(values)
    below = bdtr(np.arange(n + 1), n, p)
    low, high = np.searchsorted(below, [0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)])
    return Interval(
        float(np.quantile(ordered, p)), float(ordered[max(low - 1, 0)]), float(ordered[min(high, n - 1)])
    )


def nees_band(trials: int) -> tuple[float | None, float | None]:
    """Return the bounds of the mean NEES of `trials` trials if the claimed covariances are consistent.

    The NEES of one robot, summed over the trials, has a chi-square distribution with 3 degrees of freedom per
    trial. The mean over the robots of a trial has the same variance if their errors are fully correlated, and
    a smaller one otherwise. The probability of a mean outside the band is therefore at most 1 %.
    """
    if not trials:
        return None, None
    tail = 0.5 * (1.0 - NEES_CONFIDENCE)
    half = 0.5 * DEGREES_OF_FREEDOM * trials  # chi-square with 2 a degrees of freedom = 2 gamma(a)
    low, high = 2.0 * gammaincinv(half, tail) / trials, 2.0 * gammainccinv(half, tail) / trials
    return float(low), float(high)


def column(table: pa.Table, name: str) -> Floats:
    """Return a numeric column as floats, shape (rows,), with NaN for missing values."""
    return np.asarray(table[name].cast(pa.float64()).to_numpy(), float)


def orbited_over_t_max(table: pa.Table) -> Floats:
    """Return, per trial, the time from both in orbit to phase 3 divided by T_max.

    It is 0 if phase 3 begins before both orbit, and NaN if it never begins.
    """
    meeting, orbiting = column(table, "meeting_tick"), column(table, "orbiting_tick")
    orbited = meeting - np.where(np.isnan(orbiting), meeting, orbiting)
    t_max = column(table, "t_max_s")
    at_once = np.where(orbited > 0.0, math.inf, orbited)  # used if T_max is 0
    return np.divide(orbited * column(table, "period_s"), t_max, out=at_once, where=t_max > 0.0)


def summary_csv(sweep: Sweep, cells: Sequence[Cell], figures: Mapping[int, CellSummary]) -> str:
    """Return the text of `summary.csv`, with one row per cell."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(header(sweep))
    for cell in cells:
        axes: list[Any] = []
        for axis, place in zip(sweep.axes, cell.place, strict=True):
            axes += [axis.label(place)] if axis.labels is not None else []
            axes += [_text(value) for value in axis.values[place]]
        rows.writerow(
            [cell.index, *axes, *[getattr(figures[cell.index], name) for name in columns_of(sweep)]]
        )
    return out.getvalue()


def _text(value: Any) -> str:
    """Return the value of a field as the text of a column; empty if the field is as in the base scenario."""
    if value is None:
        return ""
    return value if isinstance(value, str) else canonical(value)


def header(sweep: Sweep) -> list[str]:
    """Return the column names of `summary.csv`."""
    axes = [
        name
        for axis in sweep.axes
        for name in ([axis.name] if axis.labels is not None else []) + list(axis.fields)
    ]
    return ["cell", *axes, *columns_of(sweep)]


def columns_of(sweep: Sweep) -> list[str]:
    """Return the fields of a CellSummary that `sweep` has."""
    return [name for name in CellSummary.__struct_fields__ if sweep.of_group or name not in FIGURES_OF_GROUP]


def ran(table: pa.Table) -> pa.Table:
    """Return the trials of `table` that were not refused."""
    return table.filter(
        pa.array([outcome != "refused" for outcome in table["outcome"].to_pylist()], pa.bool_())
    )


def refusals(table: pa.Table) -> list[tuple[str, int]]:
    """Return the reasons for refused trials with their counts, the most frequent first.

    Reasons that differ only in numbers are counted together under the first of them.
    """
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
    """Return the trial to look at first; None if none has run."""
    table = ran(table)
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


def _fraction(values: list[bool | None]) -> float | None:
    """Return the fraction of the known values that are true; None if there are none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _percentile(values: Floats, percent: float) -> float | None:
    """Return the percentile of `values` with linear interpolation; None if there are none."""
    return float(np.percentile(values, percent)) if len(values) else None
