"""The statistics of each cell: outcomes, durations and accuracy of its trials, and `summary.csv`.

The annotations of CellSummary hold the functions that compute it, so they are evaluated here.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import NormalDist
from typing import Annotated, Any, NamedTuple, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.special import bdtr, gammainccinv, gammaincinv  # type: ignore[import-untyped]

from compose.recording.claim_errors import DEGREES_OF_FREEDOM
from compose.recording.rows import csv_table
from compose.sweep.cells import Cell
from compose.sweep.field_paths import canonical
from compose.sweep.spec import Sweep
from compose.sweep.trial import TrialOutcome

Floats = NDArray[np.float64]
Number = float | None
CONFIDENCE = 0.95
"""The confidence level of the interval of a success rate."""
NEES_CONFIDENCE = 0.99
"""The probability with which a mean NEES lies in its band if the covariances are consistent."""
WORSE = ("wrong", "inconsistent", "failed", "undecided")
"""The outcomes that need a look, the worst first."""


class Interval(NamedTuple):
    """An estimate, and the bounds of its interval."""

    estimate: float
    low: float
    high: float


class CellTrials:
    """The trials of a cell that were not refused, as the columns of `summary.csv` take them."""

    def __init__(self, table: pa.Table) -> None:
        outcomes = np.array(table["outcome"].to_pylist(), object)
        ran = outcomes != "refused"
        self.table = table.filter(pa.array(ran))
        self.outcomes: list[str] = outcomes[ran].tolist()
        self.refused = len(table) - len(self.outcomes)

    def known(self, name: str) -> Floats:
        """Return the known values of a column, or of one of DERIVED; none if the sweep has no such column."""
        try:
            values = DERIVED[name](self) if name in DERIVED else column(self.table, name)
        except KeyError:  # a column of groups
            return np.zeros(0)
        return values[~np.isnan(values)]

    @property
    def localised(self) -> list[bool]:
        """True for each trial that localised."""
        return [one == "localised" for one in self.outcomes]


def _share(bound: str, trials: CellTrials) -> Floats:
    """Return the ticks of the last honest claim over those in `bound`, of trials that are not `wrong`."""
    right = [one != "wrong" for one in trials.outcomes]
    return column(trials.table, "honest_tick")[right] / column(trials.table, bound)[right]


def _orbited_over_t_max(trials: CellTrials) -> Floats:
    """Return, per trial, the time from both in orbit to phase 3 divided by T_max.

    It is 0 if phase 3 begins before both orbit, and NaN if it never begins.
    """
    meeting, orbiting = column(trials.table, "meeting_tick"), column(trials.table, "orbiting_tick")
    orbited = meeting - np.where(np.isnan(orbiting), meeting, orbiting)
    t_max = column(trials.table, "t_max_s")
    at_once = np.where(orbited > 0.0, math.inf, orbited)  # used if T_max is 0
    return np.divide(orbited * column(trials.table, "period_s"), t_max, out=at_once, where=t_max > 0.0)


DERIVED: Mapping[str, Callable[[CellTrials], Floats]] = {
    "ticks": lambda trials: column(trials.table, "ticks")[trials.localised],
    "t_max_ratio": _orbited_over_t_max,
    "bound_share": partial(_share, "bound_ticks"),
    "corrected_share": partial(_share, "corrected_ticks"),
    "makespan": partial(_share, "travel_ticks"),
}
"""The values that follow from several columns of a trial."""


class SummaryColumn(NamedTuple):
    """A column of `summary.csv`: its value, and its place in the table on the terminal."""

    value: Callable[[CellTrials], Number]
    title: str = ""
    """The title of its column on the terminal; empty if it is not shown there."""
    form: str = "d"
    """The format of its value there."""
    rank: int = -1
    """The larger it is, the earlier a table that is too wide lacks the column; -1 if another rule decides."""
    of_group: bool = False
    """True if only sweeps of groups and teams have the column."""


def _outcome(name: str) -> SummaryColumn:
    return SummaryColumn(lambda trials: trials.outcomes.count(name), name, rank=0)


def _rate(bound: int, title: str, rank: int) -> SummaryColumn:
    """Return the column with the rate of trials that localised (0), or a bound of its interval (1, 2)."""

    def value(trials: CellTrials) -> Number:
        n = len(trials.outcomes)
        return wilson(trials.outcomes.count("localised"), n)[bound] if n else None

    return SummaryColumn(value, title, ".4f", rank)


def _of(statistic: Callable[[Floats], Any], name: str, *shown: Any, of_group: bool = False) -> SummaryColumn:
    """Return the column with a statistic of the known values of `name`; `shown` is its place in the table."""

    def value(trials: CellTrials) -> Number:
        known = trials.known(name)
        return statistic(known).item() if len(known) else None

    return SummaryColumn(value, *shown)._replace(of_group=of_group)


def _at(percent: float, name: str, *shown: Any, of_group: bool = False) -> SummaryColumn:
    """Return the column with a percentile, with linear interpolation."""
    return _of(partial(np.percentile, q=percent), name, *shown, of_group=of_group)


def _sum(values: Floats) -> Any:
    return values.sum().astype(int)


def _total(name: str) -> SummaryColumn:
    return SummaryColumn(lambda trials: int(_sum(trials.known(name))))


def _within(trials: CellTrials) -> Number:
    claims = trials.known("claims").sum()
    return float(trials.known("claims_within").sum() / claims) if claims else None


def _rmse_over_bound(trials: CellTrials) -> Number:
    """Return the RMS position error over the RMS Cramér-Rao bound, of all robots with a bound."""
    names = trials.table.schema.names
    robots = [name.removesuffix("_bound_m") for name in names if name.endswith("_bound_m")]
    bounds, errors = [
        np.concatenate([np.zeros(0), *[column(trials.table, f"{robot}_{name}") for robot in robots]])
        for name in ("bound_m", "position_error_m")
    ]
    known = ~np.isnan(bounds)
    return float(np.sqrt(np.mean(errors[known] ** 2) / np.mean(bounds[known] ** 2))) if known.any() else None


def nees_band(trials: int) -> tuple[Number, Number]:
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


def _nees_bound(bound: int, title: str) -> SummaryColumn:
    return SummaryColumn(lambda trials: nees_band(len(trials.known("nees")))[bound], title, ".3g")


class CellSummary(msgspec.Struct, frozen=True):
    """A row of `summary.csv`, without the columns of the axes. A value that does not apply is None."""

    trials: Annotated[int, SummaryColumn(lambda trials: len(trials.outcomes), "trials", rank=1)]
    """number of trials that were not refused; the counts of the outcomes sum to it"""
    localised: Annotated[int, _outcome("localised")]
    """number of trials that ended so"""
    undecided: Annotated[int, _outcome("undecided")]
    """likewise"""
    inconsistent: Annotated[int, _outcome("inconsistent")]
    """likewise"""
    wrong: Annotated[int, _outcome("wrong")]
    """likewise"""
    failed: Annotated[int, _outcome("failed")]
    """number of trials that failed or were lost"""
    rate: Annotated[Number, _rate(0, "rate", 2)]
    """fraction of the trials that localised"""
    rate_low: Annotated[Number, _rate(1, "rate_low", 4)]
    """lower bound of its 95 % Wilson interval"""
    rate_high: Annotated[Number, _rate(2, "rate_high", 4)]
    """upper bound of that interval"""
    ticks_p10: Annotated[Number, _at(10, "ticks")]
    """10th percentile of the number of ticks of trials that localised"""
    ticks_p50: Annotated[Number, _at(50, "ticks", "p50", ".0f", 3)]
    """their median"""
    ticks_p90: Annotated[Number, _at(90, "ticks")]
    """their 90th percentile"""
    ticks_p95: Annotated[Number, _at(95, "ticks", "p95", ".0f", 4)]
    """their 95th percentile"""
    ticks_max: Annotated[Number, _at(100, "ticks", "max", ".0f", 3)]
    """the largest of them"""
    meeting_tick_p50: Annotated[Number, _at(50, "meeting_tick")]
    """median tick at which phase 3 began, of trials in which it began"""
    meeting_tick_max: Annotated[Number, _at(100, "meeting_tick")]
    """the largest of these ticks"""
    t_max_s: Annotated[Number, _at(100, "t_max_s")]
    """largest T_max of a trial, in s"""
    t_max_ratio_max: Annotated[Number, _at(100, "t_max_ratio")]
    """largest ratio of the time from both in orbit to phase 3 to T_max; the paper's T_max can be exceeded,
    since it holds in continuous time"""
    error_p50_m: Annotated[Number, _at(50, "position_error_m", "error p50", ".1e", 5)]
    """median over trials with a claim of the largest position error of a robot"""
    error_max_m: Annotated[Number, _at(100, "position_error_m", "error max", ".1e", 5)]
    """the largest of these errors"""
    error_max_rad: Annotated[Number, _at(100, "heading_error_rad")]
    """largest heading error of a claim"""
    claims: Annotated[int, _total("claims")]
    """number of claims by all robots"""
    within_3_accuracy: Annotated[Number, SummaryColumn(_within, "within", ".4f")]
    """fraction of the claims with a position error of at most 3 times mission.accuracy"""
    truth_held: Annotated[Number, _of(np.mean, "truth_held")]
    """fraction of the trials with claims under noise in which every such robot held the true hypothesis"""
    nees_mean: Annotated[Number, _of(np.mean, "nees", "nees", ".3g")]
    """mean over trials of the mean NEES of their robots' claims, wrong ones included; 3 is expected if the
    claimed covariances are consistent. The errors of a pair are correlated, so a trial counts once"""
    nees_low: Annotated[Number, _nees_bound(0, "nees low")]
    """lower bound of the band that contains nees_mean in 99 % of sweeps if covariances are consistent"""
    nees_high: Annotated[Number, _nees_bound(1, "nees high")]
    """upper bound of that band"""
    rmse_over_bound: Annotated[Number, SummaryColumn(_rmse_over_bound)]
    """root mean square of the position errors of all robots, divided by that of their Cramér-Rao bounds"""
    reports_p50: Annotated[Number, _at(50, "reports_sent")]
    """median number of reports that all robots of a trial sent"""
    audited: Annotated[int, SummaryColumn(lambda trials: len(trials.known("violations")))]
    """number of audited trials"""
    clean: Annotated[
        int, SummaryColumn(lambda trials: int((trials.known("violations") == 0.0).sum()), "clean", rank=3)
    ]
    """number of audited trials without a violation"""
    violations: Annotated[int, _total("violations")]
    """number of violations in all trials"""
    reports_lost: Annotated[int, _total("reports_lost")]
    """number of reports lost in all trials"""
    reports_refused: Annotated[int, _total("reports_refused")]
    """number of reports rejected in all trials"""
    refused_trials: Annotated[int, SummaryColumn(lambda trials: trials.refused)]
    """number of trials whose scenario is infeasible with the drawn values; no other figure counts them"""
    refused: str | None
    """reason why the scenario of this cell is infeasible"""
    bound_share_p50: Annotated[Number, _at(50, "bound_share", "share p50", ".2f", of_group=True)]
    """not for pairs: median over trials in which all honest robots claimed of honest_tick / bound_ticks"""
    bound_share_max: Annotated[Number, _at(100, "bound_share", "share max", ".2f", of_group=True)]
    """not for pairs: the largest of these"""
    corrected_share_max: Annotated[Number, _at(100, "corrected_share", "corrected", ".2f", of_group=True)]
    """only for groups: the largest honest_tick / corrected_ticks, of trials with a corrected bound"""
    makespan_p50: Annotated[Number, _at(50, "makespan", "travel p50", ".2f", of_group=True)]
    """only for groups: median over the same trials of honest_tick / travel_ticks"""
    makespan_p95: Annotated[Number, _at(95, "makespan", "travel p95", ".2f", of_group=True)]
    """only for groups: the 95th percentile of these"""
    honest_localised: Annotated[int | None, _of(_sum, "honest_localised", of_group=True)]
    """not for pairs: number of honest robots, of all trials, whose claims are right"""
    honest_undecided: Annotated[int | None, _of(_sum, "honest_undecided", of_group=True)]
    """not for pairs: number of those that have no claim at the end"""
    honest_wrong: Annotated[int | None, _of(_sum, "honest_wrong", of_group=True)]
    """not for pairs: number of those whose claims are wrong"""
    attacker_met: Annotated[int | None, _of(_sum, "attacker_met", of_group=True)]
    """only for groups: number of their meetings with a robot that has an attack, of audited trials"""
    attacker_found: Annotated[int | None, _of(_sum, "attacker_found", of_group=True)]
    """only for groups: number of these in which they found its data inconsistent"""


COLUMNS: dict[str, SummaryColumn] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(CellSummary, include_extras=True).items()
    if name != "refused"
}
"""The columns of a CellSummary by name, but for `refused`, which is given."""


class NotableTrial(msgspec.Struct, frozen=True):
    """The trial to look at first: one with a violation, else the worst outcome, else the longest."""

    cell: int
    trial: int
    seed: int
    outcome: TrialOutcome
    ticks: int | None
    first_violation: str | None
    error: str | None
    reason: str | None

    @property
    def why(self) -> str | None:
        """The reason to look at it."""
        return self.first_violation or self.error or self.reason


def counted(table: pa.Table, refused: str | None = None) -> CellSummary:
    """Return the statistics of the trials in `table`.

    `refused` is the reason why the scenario of the cell is infeasible, or None.
    """
    trials = CellTrials(table)
    values: dict[str, Any] = {name: shown.value(trials) for name, shown in COLUMNS.items()}
    return CellSummary(refused=refused, **values)


def by_cell(table: pa.Table, cells: Sequence[Cell]) -> dict[int, pa.Table]:
    """Return the trials of each cell, by its index; `table` is sorted by cell."""
    ends = table["cell"].to_numpy().searchsorted([cell.index for cell in cells], side="right")
    return {
        cell.index: table.slice(begin, end - begin)
        for cell, begin, end in zip(cells, [0, *ends[:-1]], ends, strict=True)
    }


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


def column(table: pa.Table, name: str) -> Floats:
    """Return a column of numbers or truth values as floats, shape (rows,), with NaN for missing values."""
    return np.asarray(table[name].cast(pa.float64()).to_numpy(), float)


def summary_csv(sweep: Sweep, cells: Sequence[Cell], figures: Mapping[int, CellSummary]) -> str:
    """Return the text of `summary.csv`, with one row per cell."""
    rows = []
    for cell in cells:
        axes = [
            value if isinstance(value, str | None) else canonical(value) for value in cell.on_axes(sweep.axes)
        ]
        rows.append([cell.index, *axes, *[getattr(figures[cell.index], name) for name in columns_of(sweep)]])
    return csv_table(header(sweep), rows)


def header(sweep: Sweep) -> list[str]:
    """Return the column names of `summary.csv`."""
    return ["cell", *[name for axis in sweep.axes for name in axis.columns], *columns_of(sweep)]


def columns_of(sweep: Sweep) -> list[str]:
    """Return the fields of a CellSummary that `sweep` has."""
    return [
        name
        for name in CellSummary.__struct_fields__
        if sweep.of_group or name not in COLUMNS or not COLUMNS[name].of_group
    ]


def noted(table: pa.Table) -> NotableTrial | None:
    """Return the trial to look at first; None if none has run."""
    trials = CellTrials(table)
    if not trials.outcomes:
        return None
    worst = next((outcome for outcome in WORSE if outcome in trials.outcomes), None)
    broken = np.flatnonzero(column(trials.table, "violations") > 0.0)
    if len(broken):
        place = int(broken[0])
    elif worst is not None:
        place = trials.outcomes.index(worst)
    else:
        place = int(np.nanargmax(column(trials.table, "ticks")))
    return msgspec.convert(trials.table.slice(place, 1).to_pylist()[0], NotableTrial)
