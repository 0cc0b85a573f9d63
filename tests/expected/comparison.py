"""The comparison of new results of sweeps with those of their files.

All statistics of a run share one rate of false alarms: with a probability of at least 1 - ALARM, nothing is
found if nothing has changed, however they depend on each other (S. Holm, "A simple sequentially rejective
multiple test procedure", 1979, with weights). Half of the weight is on what is pooled over the cells of a
file, a quarter on what is pooled over all files, and a quarter on single cells.

- Counts: the distribution of the new count given the sum of both, which is exact (Fisher; over several
  cells, the exact form of Mantel and Haenszel's test).
- Quantiles: the number of new values below an order statistic of the file has a beta-binomial distribution,
  whatever that of the values. Where values are equal, the less significant number counts.
- Means: Student's t of the differences within cells, of logarithms, and of cube roots of NEES.
- With the same seeds, trials are paired: a sign test of those whose results differ.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from scipy.special import betaln, gammaln  # type: ignore[import-untyped]
from scipy.stats import beta, binom, hypergeom, t  # type: ignore[import-untyped]

from tests.expected.results import (
    QUANTILES,
    ROUNDING,
    TRANSFORMED,
    CellResults,
    Expected,
    Floats,
    Mean,
    Quantiles,
    Trials,
    known,
    rank,
    sampled,
)

Level = Literal["all files", "all cells", "cell"]
ALARM = 0.01
"""The probability of any finding if nothing has changed, over all statistics of all files of a run."""
POWER = 0.8
"""The probability with which the smallest effect is found."""
LEVELS: dict[Level, float] = {"all files": 0.25, "all cells": 0.5, "cell": 0.25}
"""The share of ALARM for the statistics of each level."""
FEWEST = 5
"""The fewest values of a cell, on both sides together, of which means are compared."""
SAME = 0.01
"""The relative difference of two NEES up to which they are the same: a sample has three digits."""
BAD = ("wrong", "truth lost", "failed")
"""The counts of which, over all cells, only more is tested."""
MORE_IS_BETTER = ("localised", "inconsistent under attack")
NEITHER_IS_BETTER = ("nees", "refused", "undecided under attack", "localised under attack")
SHARES_AND_TIMES = ("ticks", "error", "heading", "share", "travel")
"""The quantities whose quantiles are compared; less is better."""


class Count(msgspec.Struct, frozen=True):
    """The numbers of events among the new trials, and among those of the file."""

    new: int
    of_new: int
    old: int
    of_old: int


class Place(NamedTuple):
    """The part of the results that a statistic is of."""

    level: Level
    sweep: str
    where: str


class Test(msgspec.Struct, frozen=True):
    """A statistic of a run, beside that of the file."""

    level: Level
    sweep: str
    where: str
    quantity: str
    old: str
    new: str
    p: float
    """the probability of such a difference if nothing has changed"""
    change: float
    """above 0 if the new value is larger"""
    smallest: Callable[[float], str]
    """the smallest effect that is found with the probability POWER, given the rate of false alarms"""

    @property
    def verdict(self) -> str:
        """ "better" or "worse"; "more" or "less" of a quantity of which neither is better."""
        name = self.quantity.partition(",")[0]
        if name in NEITHER_IS_BETTER:
            return "more" if self.change > 0.0 else "less"
        return "better" if (self.change > 0.0) == (name in MORE_IS_BETTER) else "worse"


class Run(msgspec.Struct, frozen=True):
    """A new run of a sweep, and the results of its file."""

    new: Expected
    trials: Trials
    old: Expected


def findings(tests: Sequence[Test], alarm: float = ALARM) -> list[Test]:
    """Return the tests that are significant together, by Holm's procedure, the least probable first."""
    weight = weights(tests)
    left = math.fsum([weight[test.level] for test in tests])
    found = []
    for test in sorted(tests, key=lambda test: test.p / weight[test.level]):
        if test.p / weight[test.level] > alarm / left:
            break
        found.append(test)
        left = max(left - weight[test.level], weight[test.level])
    return found


def weights(tests: Sequence[Test]) -> dict[Level, float]:
    """Return the weight of a test of each level."""
    return {
        level: share / max(1, sum([test.level == level for test in tests])) for level, share in LEVELS.items()
    }


def compare(runs: Sequence[Run]) -> list[Test]:
    """Return all tests of these runs."""
    tests: list[Test] = []
    for run in runs:
        for i in range(len(run.old.cell)):
            tests += _of_cell(run, i)
        tests += _together(Place("all cells", run.old.sweep, "all cells"), [run])
    every = Place("all files", "all files", "all cells")
    return tests + (_together(every, runs) if len(runs) > 1 else [])


def _together(place: Place, runs: Sequence[Run]) -> list[Test]:
    """Return the tests of what is pooled over all cells of `runs`, and of trials with equal seeds."""
    return [*_pooled(place, runs), *_paired(place, runs)]


def _of_cell(run: Run, i: int) -> list[Test]:
    new, old = run.new.cell[i], run.old.cell[i]
    place = Place("cell", run.old.sweep, old.label)
    values = run.trials.where(run.trials.cell == i).values
    found = [
        count_test(place, name, [count]) for name, count in counts(new, old).items() if count.new + count.old
    ]
    for quantity in SHARES_AND_TIMES:
        before: Quantiles | None = getattr(old, quantity)
        if before is not None and len(after := known(values[quantity])):
            found += [quantile_test(place, quantity, name, before, after) for name in QUANTILES]
    if "nees" in new.means and "nees" in old.means:
        found += mean_test(place, "nees", [(new.means["nees"], old.means["nees"])])
    return found


def counts(new: CellResults, old: CellResults) -> dict[str, Count]:
    """Return the counts of a cell by their names."""
    under = " under attack" if attacked(old.label) else ""
    found = {}
    for name in ("localised", "undecided", "inconsistent", "failed"):
        number = [one.outcomes.get(name, 0) for one in (new, old)]
        called = name if name == "failed" else name + under
        found[called] = Count(number[0], new.trials, number[1], old.trials)
    found["wrong"] = Count(new.wrong, new.trials, old.wrong, old.trials)
    refused = [one.outcomes.get("refused", 0) for one in (new, old)]
    found["refused"] = Count(refused[0], new.trials + refused[0], refused[1], old.trials + refused[1])
    if new.truth is not None and old.truth is not None:
        lost = [one[0] - one[1] for one in (new.truth, old.truth)]
        found["truth lost"] = Count(lost[0], new.truth[0], lost[1], old.truth[0])
    return {name: count for name, count in found.items() if count.of_new and count.of_old}


def attacked(label: str) -> bool:
    """Return whether a robot sends false reports in the cell with this label."""
    return "attack = " in label and "attack = honest" not in label


def _pooled(place: Place, runs: Sequence[Run]) -> list[Test]:
    """Return the tests of what is pooled over all cells of `runs`."""
    pairs = [pair for run in runs for pair in zip(run.new.cell, run.old.cell, strict=True)]
    by_cell = [counts(new, old) for new, old in pairs]
    found = [
        count_test(place, name, [one[name] for one in by_cell if name in one], one_sided=name in BAD)
        for name in dict.fromkeys([name for one in by_cell for name in one])
    ]
    for name in TRANSFORMED:
        means = [
            (new.means[name], old.means[name])
            for new, old in pairs
            if name in new.means and name in old.means
        ]
        found += mean_test(place, name, means)
    return found


def count_test(place: Place, quantity: str, counts: Sequence[Count], *, one_sided: bool = False) -> Test:
    """Return the test of a count, summed over cells; if it is one-sided, that of more events."""
    new, of_new = sum([one.new for one in counts]), sum([one.of_new for one in counts])
    old, of_old = sum([one.old for one in counts]), sum([one.of_old for one in counts])
    more, fewer = conditional(counts)

    def smallest(alarm: float) -> str:
        tail = alarm if one_sided else 0.5 * alarm
        rare = 2 * old <= of_old  # else, what is found is how many more are not among the events
        before = old if rare else of_old - old
        for number in range(of_new + 1):
            if hypergeom.sf(number - 1, of_old + of_new, before + number, of_new) <= tail:
                rate = float(beta.ppf(POWER, number, of_new - number + 1)) if number < of_new else 1.0
                return f"{(rate if rare else 1.0 - rate) * of_new:.3g} of {of_new}"
        return "none"

    return Test(
        *(*place, quantity),
        f"{old} of {of_old}",
        f"{new} of {of_new}",
        more if one_sided else min(1.0, 2.0 * min(more, fewer)),
        1.0 if one_sided else new * of_old - old * of_new,
        smallest,
    )


def conditional(counts: Sequence[Count]) -> tuple[float, float]:
    """Return the probabilities of at least, and of at most, as many new events, given those of both sides.

    Within a cell both sides have the same rate if nothing has changed; it may differ between cells.
    """
    pmf, low = np.ones(1), 0
    for one in counts:
        events, trials = one.new + one.old, one.of_new + one.of_old
        least, most = max(0, events - one.of_old), min(events, one.of_new)
        pmf = np.convolve(pmf, hypergeom.pmf(np.arange(least, most + 1), trials, events, one.of_new))
        low += least
    at = sum([one.new for one in counts]) - low
    return min(1.0, float(pmf[at:].sum())), min(1.0, float(pmf[: at + 1].sum()))


def quantile_test(place: Place, quantity: str, name: str, old: Quantiles, new: Floats) -> Test:
    """Return the test of the quantile `name` of the file against new values."""
    p = QUANTILES[name]
    at: float = getattr(old, name)
    if quantity in ("error", "heading"):
        at, new = max(at, ROUNDING), np.maximum(new, ROUNDING)
    cdf = below(len(new), rank(p, old.n), old.n)
    fewer, most = int((new < at).sum()), int((new <= at).sum())
    larger, smaller = float(cdf[most]), float(1.0 - cdf[fewer - 1]) if fewer else 1.0
    ordered = np.sort(new)
    after = float(ordered[rank(p, len(new)) - 1])

    def smallest(alarm: float) -> str:
        number = int(np.searchsorted(cdf, 0.5 * alarm, side="right")) - 1
        if number < 0 or at <= 0.0:
            return "none"
        share = float(beta.ppf(1.0 - POWER, number + 1, len(new) - number))
        there = float(ordered[rank(share, len(new)) - 1])
        return f"x{at / there:.3g}" if there > 0.0 else "none"

    return Test(
        *(*place, f"{quantity}, {name}"),
        f"{at:.4g} ({old.n})",
        f"{after:.4g} ({len(new)})",
        min(1.0, 2.0 * min(larger, smaller)),
        smaller - larger,
        smallest,
    )


def below(n: int, k: int, m: int) -> Floats:
    """Return the distribution function of the number of `n` new values below the k-th of `m` old ones."""
    j = np.arange(n + 1)
    choose = gammaln(n + 1) - gammaln(j + 1) - gammaln(n - j + 1)
    pmf = np.exp(choose + betaln(j + k, n - j + m + 1 - k) - betaln(k, m + 1 - k))
    return np.asarray(np.minimum(np.cumsum(pmf), 1.0), float)


def mean_test(place: Place, quantity: str, pairs: Sequence[tuple[Mean, Mean]]) -> list[Test]:
    """Return the test of a mean over cells, each new and old; none if there are too few values.

    Each cell has one variance on both sides if nothing has changed.
    """
    pairs = [pair for pair in pairs if pair[0].n + pair[1].n >= FEWEST]
    number = np.array([[one.n for one in pair] for pair in pairs], float).reshape(-1, 2)
    deviation = np.array([[one.sd for one in pair] for pair in pairs]).reshape(-1, 2)
    weight = number.prod(1) / number.sum(1)
    weight /= weight.sum() or 1.0
    degrees = number.sum(1) - 2.0
    parts = weight**2 * ((number - 1.0) * deviation**2).sum(1) / degrees * number.sum(1) / number.prod(1)
    if not (variance := parts.sum()):
        return []
    freedom = variance**2 / (parts**2 / degrees).sum()
    new, old = (float(weight @ [pair[side].mean for pair in pairs]) for side in (0, 1))
    error, change = math.sqrt(variance), new - old

    def smallest(alarm: float) -> str:
        least = float(t.isf(0.5 * alarm, freedom) + t.ppf(POWER, freedom)) * error
        return f"{least:.3g}" if quantity == "nees" else f"x{math.exp(least):.3g}"

    p = float(2.0 * t.sf(abs(change) / error, freedom))
    return [Test(*place, quantity, _back(quantity, old), _back(quantity, new), p, change, smallest)]


def _back(quantity: str, value: float) -> str:
    """Return a pooled mean for people to read; that of NEES as the cube of the mean of cube roots."""
    return f"{value**3 if quantity == 'nees' else math.exp(value):.4g}"


def _paired(place: Place, runs: Sequence[Run]) -> list[Test]:
    """Return the sign tests of trials with the same seeds as those in the files; none with other seeds."""
    pairs = [paired_trials(run) for run in runs if run.new.seed == run.old.seed]
    found = []
    for name in ("localised", "wrong", "ticks", "nees"):
        change = known(np.concatenate([np.zeros(0), *[changes(name, *pair) for pair in pairs]]))
        more, fewer = int((change > 0.0).sum()), int((change < 0.0).sum())
        if not more + fewer:
            continue
        tails = [float(binom.sf(one - 1, more + fewer, 0.5)) for one in (more, fewer)]
        found.append(
            Test(
                *(*place._replace(where=f"same seeds, {len(change)}"), name),
                f"more in {more}",
                f"less in {fewer}",
                tails[0] if name == "wrong" else min(1.0, 2.0 * min(tails)),
                more - fewer,
                lambda alarm: f"{math.ceil(math.log2(2.0 / alarm))}, all more or all less",
            )
        )
    return found


def paired_trials(run: Run) -> tuple[Trials, dict[str, Floats]]:
    """Return the new trials that are in the samples of the file, and what the file states of them."""
    sizes = np.array([len(one.outcomes) for one in run.old.sample])
    starts = np.cumsum(sizes) - sizes
    trials = run.trials.where(run.trials.trial < sizes[run.trials.cell])
    at = starts[trials.cell] + trials.trial
    letters = np.array(list("".join([one.outcomes for one in run.old.sample])))
    values = {
        name: np.concatenate(
            [
                sampled(text) if (text := getattr(one, name)) else np.full(len(one.outcomes), math.nan)
                for one in run.old.sample
            ]
        )
        for name in ("ticks", "nees")
    }
    outcomes = {"localised": letters == "l", "wrong": letters == "w", "outcome": letters}
    decisions = [one.decisions.split() or [""] * len(one.outcomes) for one in run.old.sample]
    known = {"decisions": np.array([one for some in decisions for one in some])}
    return trials, {name: one[at] for name, one in (values | outcomes | known).items()}


def changes(name: str, trials: Trials, old: dict[str, Floats]) -> Floats:
    """Return the differences of a quantity, trial by trial, new less old; NaN where one has none."""
    if name in ("localised", "wrong"):
        return np.asarray((trials.outcome == name) - 1.0 * old[name], float)
    new = np.asarray(TRANSFORMED[name](trials.values[name]), float)
    difference: Floats = new - TRANSFORMED[name](old[name])
    if name == "nees":
        difference[np.abs(difference) <= SAME * new] = 0.0
    return difference


def number_changed(run: Run) -> tuple[int, int]:
    """Return how many trials with the same seeds differ from those in the file, and of how many.

    In the environment of the file, its decisions are compared, too: nothing may differ unless they changed.
    """
    trials, old = paired_trials(run)
    letters = np.array([outcome[0] for outcome in trials.outcome.tolist()])
    changed = letters != old["outcome"]
    for name in ("ticks", "nees"):
        difference = changes(name, trials, old)
        changed |= np.nan_to_num(difference) != 0.0
        changed |= np.isnan(trials.values[name]) != np.isnan(old[name])
    if same_environment(run):
        both = (old["decisions"] != "") & (trials.decisions != "")
        changed |= both & (old["decisions"] != trials.decisions)
    return int(changed.sum()), len(changed)


def same_environment(run: Run) -> bool:
    """Return whether the trials ran with the libraries and the kind of processor that the file names."""
    return run.new.environment == run.old.environment != ""
