"""The comparison of sweeps with their expected results: false alarms, and the differences that it finds."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from compose.sweep import spec
from compose.sweep.cells import cells, label
from compose.sweep.spec import Sweep
from protocol import documents
from tests.expected.__main__ import main, report
from tests.expected.comparison import (
    Count,
    Run,
    compare,
    conditional,
    findings,
    number_changed,
    quantile_test,
)
from tests.expected.results import Expected, Trials, expected, path_of, quantiles, read, toml_text

ROOT = Path(__file__).parents[1]
SIGMA = spec.load("sigma", trials=40, seed=1)


def drawn(
    sweep: Sweep, rng: np.random.Generator, *, nees: float = 1.0, ticks: float = 1.0, wrong: float = 0.01
) -> Trials:
    """Return trials of `sweep` with drawn results."""
    every = list(cells(sweep))
    n = sweep.trials
    cell = np.repeat(np.arange(len(every)), n)
    trial = np.tile(np.arange(n), len(every))
    hard = rng.exponential(1.0, len(cell))
    outcome = np.where(rng.random(len(cell)) < wrong * hard, "wrong", "localised")
    outcome = np.where(rng.random(len(cell)) < 0.05 * hard, "undecided", outcome)
    localised = outcome == "localised"
    error = np.where(outcome != "undecided", 0.02 * hard * rng.chisquare(3, len(cell)), math.nan)
    return Trials(
        cell,
        trial,
        outcome,
        outcome == "wrong",
        np.where(rng.random(len(cell)) < wrong, 0.0, 1.0),
        {
            "nees": np.where(outcome != "undecided", nees * rng.chisquare(3, len(cell)), math.nan),
            "ticks": np.where(
                localised, np.ceil(ticks * (20.0 + 10.0 * hard + rng.gamma(3.0, 4.0, len(cell)))), math.nan
            ),
            "error": error,
            "heading": error,
        },
        np.full((len(cell), 3), math.nan),
        np.full(len(cell), "0badcafe"),
    )


def run_of(new: Trials, old: Trials, new_sweep: Sweep = SIGMA, old_sweep: Sweep = SIGMA) -> Run:
    return Run(expected(new_sweep, new, "", ""), new, expected(old_sweep, old, "", ""))


def test_a_count_a_quantile_and_all_statistics_raise_no_more_false_alarms_than_stated() -> None:
    rng = np.random.default_rng(1)
    alarms = np.zeros(2)
    for _ in range(300):
        counts = [Count(rng.binomial(60, p), 60, rng.binomial(200, p), 200) for p in (0.01, 0.3)]
        alarms[0] += 2.0 * min(conditional(counts)) <= 0.1
        old, new = (np.ceil(rng.gamma(3.0, 4.0, n)) for n in (60, 40))  # many are equal
        before = quantiles(old)
        assert before is not None
        alarms[1] += quantile_test("cell", "", "", "ticks", "p50", before, new).p <= 0.1
    assert (alarms <= 46).all()  # 30 are expected at most; 16 are 3 standard deviations
    assert (alarms >= 5).all()
    other = msgspec.structs.replace(SIGMA, seed=2)
    found = sum(
        [
            bool(findings(compare([run_of(drawn(other, rng), drawn(SIGMA, rng), other)]), 0.2))
            for _ in range(10)
        ]
    )
    assert found <= 6  # 2 are expected at most


@pytest.mark.parametrize(
    ("change", "quantity", "verdict"),
    [({"nees": 1.6}, "nees", "more"), ({"ticks": 1.2}, "ticks", "worse"), ({"wrong": 0.1}, "wrong", "worse")],
)
def test_a_difference_that_no_cell_shows_is_found_in_what_is_pooled(
    change: dict[str, float], quantity: str, verdict: str
) -> None:
    rng = np.random.default_rng(2)
    other = msgspec.structs.replace(SIGMA, seed=2)
    tests = compare([run_of(drawn(other, rng, **change), drawn(SIGMA, rng), other)])
    found = findings(tests)
    assert (quantity, verdict, "all cells") in [(one.quantity, one.verdict, one.level) for one in found]
    assert {one.quantity.partition(",")[0] for one in found} <= {quantity, "localised", "truth lost"}


def test_with_the_same_seeds_trials_are_compared_one_by_one() -> None:
    old = drawn(SIGMA, np.random.default_rng(3))
    same = run_of(old, old)
    assert number_changed(same) == (0, 11 * 20)
    assert findings(compare([same])) == []
    ticks = old.values["ticks"] + (old.trial < 18)  # a tick more, which the distributions do not show
    later = msgspec.structs.replace(old, values=old.values | {"ticks": ticks})
    found = findings(compare([run_of(later, old)]))
    (one,) = found
    assert (one.quantity, one.verdict, one.where) == ("ticks", "worse", "same seeds, 209")
    otherwise = msgspec.structs.replace(old, decisions=np.where(old.trial == 3, "0badcaff", old.decisions))
    assert number_changed(run_of(otherwise, old)) == (11, 11 * 20)
    assert report([run_of(otherwise, old)]) == 1
    assert report([run_of(otherwise, old)], statistics=True) == 0


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["loss", "--trials", "0"], "argument --trials: 0 is less than 1"),
        (["loss", "--jobs", "-1"], "argument --jobs: -1 is less than 1"),
        (["loss", "--folder", "nowhere"], f"argument --folder: there is no {Path('nowhere/trials.parquet')}"),
        (["los"], "'los' is no shipped sweep"),
    ],
)
def test_a_wrong_argument_is_refused_before_a_mission_runs(
    arguments: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert why in capsys.readouterr().err


def test_a_file_contains_the_results_from_which_it_was_written() -> None:
    results = expected(SIGMA, drawn(SIGMA, np.random.default_rng(4)), "1", "abc", 0.5, 'a "note"')
    assert msgspec.convert(documents.toml_table(toml_text(results)), Expected) == results


@pytest.mark.parametrize("name", spec.shipped())
def test_each_shipped_sweep_has_expected_results_of_all_its_cells(name: str) -> None:
    file = read(name)
    assert file is not None, (
        f"{path_of(name)}: missing; `uv run python -m tests.expected {name} --write` makes it"
    )
    sweep = spec.load(name)
    assert [one.label for one in file.cell] == [label(sweep, cell) for cell in cells(sweep)]
    assert {sum(one.outcomes.values()) for one in file.cell} == {file.trials}
    assert {len(one.outcomes) for one in file.sample} == {min(20, file.trials)}


@pytest.mark.long("slow")
@pytest.mark.timeout(900)
def test_shipped_sweeps_have_their_expected_results() -> None:
    """The command forks, so it is a process of its own, without the threads of other tests."""
    command = [sys.executable, "-m", "tests.expected", "--statistics"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=800, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
