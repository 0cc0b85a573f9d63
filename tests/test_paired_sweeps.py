"""Cells of a paired axis have the same draws, and only they are compared; sweeps beside expected results."""

from __future__ import annotations

import csv
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import inspect

import tandem
from compose.scenario.scenario_file import scenario_table, validate
from compose.scenario.scenario_tables import ScenarioFile
from compose.sweep import axis_figures, spec
from compose.sweep import report as sweep_report
from compose.sweep.cells import cells, label
from compose.sweep.field_paths import steps, with_value
from compose.sweep.field_users import USERS
from compose.sweep.paired_differences import mean_interval, paired_differences, rate_interval
from compose.sweep.spec import Sweep
from compose.sweep.table import of_rows, schema_of
from compose.sweep.trial import TrialRow, lost, refused
from protocol import documents
from protocol.messages import Command, Observation
from tests.commands import tandem as command
from tests.expected.__main__ import main, report
from tests.expected.comparison import (
    Count,
    Place,
    Run,
    compare,
    conditional,
    findings,
    number_changed,
    quantile_test,
)
from tests.expected.results import Expected, Trials, expected, path_of, quantiles, read, toml_text
from world.scenario import Scenario
from world.tick import World, advance, observations, release

PLANNERS = {"planner.name": ["paper", "assured"]}
OTHER: dict[str, Any] = {
    "name": "other",
    "max_ticks": 500,
    "planner.name": "paper",
    "kill": [{"who": "a", "tick": 3}],
    "clock": [{"who": "a", "offset": 1.0}],
    "robot.attack": {"kind": "scale", "part": "orbit", "size": 0.9},
    "group.attack": {"kind": "scale", "part": "orbit", "size": 0.9},
    "team.attack": {"kind": "scale", "size": 0.9},
    "mission.accuracy": 0.3,
    "mission.confidence": 0.99,
    "mission.safety_distance": 0.3,
    "mission.tolerates": 1,
    "mission.survey": 0.07,
    "mission.noise.range_bias": 0.1,
    "mission.noise.pair_bias": 0.1,
    "mission.noise.range_scale": 0.01,
    "mission.noise.slow_sigma": 0.01,
    "mission.noise.slow_time": 3.0,
    "mission.noise.wheel_scale": 0.01,
    "mission.noise.gyro_bias": 0.01,
    "mission.noise.sigma_degrees": 10.0,
    "mission.noise.survey_error": 0.01,
    "mission.noise.range_delay": 0.01,
    "mission.noise.range_depth": 0.0,  # others are refused
    "mission.noise.strays": 0.01,
    "mission.noise.odometry_strays": 0.01,
    "mission.noise.anchor_sigma": 0.2,
    "mission.noise.mutual_sigma": 0.2,
    "mission.noise.outliers": 0.2,
    "mission.noise.outlier_bias": [0.1, 0.2],
    "mission.noise.drop_outs": 0.2,
    "mission.noise.profile": "uwb",
    **{
        f"mission.noise.{of}.{name}": 0.02
        for of in ("actuation", "odometry")
        for name in ("v", "omega", "v_floor", "omega_floor")
    },
}
"""Another value of each field that the world does not use, or that its own noise can replace."""
WHITE = {"v": 0.01, "omega": 0.01, "v_floor": 0.01, "omega_floor": 0.01}
ALL_NOISE = {
    "anchor_sigma": 0.05,
    "mutual_sigma": 0.05,
    "outliers": 0.1,
    "outlier_bias": [0.3, 2.0],
    "drop_outs": 0.1,
    "actuation": WHITE,
    "odometry": WHITE,
}
"""Noise of the world for which it takes nothing from that of the mission."""


def fields(kind: inspect.Type, path: str = "") -> Iterator[str]:
    """Yield the paths of all single values in a table, without indices."""
    match kind:
        case inspect.Metadata():
            yield from fields(kind.type, path)
        case inspect.UnionType(types=several) if not all(
            isinstance(one, inspect.StrType | inspect.IntType | inspect.FloatType) for one in several
        ):
            for one in several:
                yield from fields(one, path)
        case inspect.ListType(item_type=item):
            yield from fields(item, path)
        case inspect.StructType(fields=several):
            for field in several:
                yield from fields(field.type, f"{path}.{field.encode_name}".lstrip("."))
        case inspect.NoneType():
            pass
        case _:
            yield path


def test_every_field_of_a_scenario_has_one_user() -> None:
    every = set(fields(inspect.type_info(ScenarioFile)))
    assert "mission.noise.odometry.v_floor" in every
    used: set[str] = set()
    for path in every:
        found = [one for one in USERS if path == one or path.startswith(f"{one}.")]
        assert len(found) == 1, f"{path}: {found}: add it to compose.sweep.field_users"
        used.add(found[0])
    assert used == {*USERS}
    covered = {one for one in USERS if USERS[one] != "world"}
    assert {one if one in covered else one.partition(".")[0] for one in OTHER} == covered


def seen(scenario: Scenario) -> list[list[Observation]]:
    """Return everything that the robots observe if they drive the same, whatever they know."""
    world, found = release(scenario), []
    for tick in range(25):
        found.append(observations(world))
        commands = {
            robot.id: Command(tick, robot.id, 0.4, 0.5, phase=1, task="straight") for robot in scenario.robots
        }
        onward = advance(world, commands)
        assert isinstance(onward, World)
        world = onward
    return found


BASES = {
    "group.attack": "random-group",
    "mission.tolerates": "random-group",
    "mission.survey": "survey",
    "team.attack": "room",
}
"""The scenarios of the fields that pairs do not have."""


@pytest.mark.parametrize("name", ["random", "random-group", "survey", "room"])
def test_what_robots_observe_does_not_depend_on_fields_that_the_world_does_not_use(name: str) -> None:
    base = scenario_table(name)
    base["world"] = {"noise": ALL_NOISE, "radio": {"model": "fading"}}
    base["mission"]["noise"] = {"anchor_sigma": 0.05, "mutual_sigma": 0.05, "gyro_bias": 0.0002}
    base["fault"] = [{"loss": 0.3, "delay": [0, 2]}]
    if name == "random":
        base["robot"][1]["anchor"] = [4.0, 0.0]  # in range of each other soon
    if name == "room":  # all places are drawn
        base |= {"anchor": [], "robot": [], "team": {"robots": 3, "side": 10.0, "anchors": 4}}
        base["mission"]["tolerates"] = 1
    as_it_is = seen(validate(base, "base").seeded(7))
    for field, value in OTHER.items():
        if BASES.get(field, "random") != name:
            continue
        path = field.replace("robot.", "robot[0].")
        table = with_value(base, steps(path, base), value)
        axis = {"field": path, "values": [value]}
        sweep = {"name": "x", "scenario": "x", "trials": 1, "axis": [axis]}
        (found,) = spec.validated(sweep, "x", Path(), base=base).axes
        assert found.paired, field
        assert seen(validate(table, field).seeded(7)) == as_it_is, field
    assert any(one.contacts for sensed in as_it_is for one in sensed) or name == "random-group"


def test_an_axis_is_paired_unless_what_is_drawn_depends_on_it() -> None:
    def paired(*changed: str, base: dict[str, Any] | None = None, **more: Any) -> bool:
        table = base or scenario_table("noisy")
        axis = {"name": "n", "fields": [*changed], "values": [[1.0] * len(changed)]}
        sweep = {"name": "x", "scenario": "x", "trials": 1, "axis": [axis, *more.pop("axes", [])], **more}
        return spec.validated(sweep, "x", Path(), base=table).axes[0].paired

    told = scenario_table("noisy") | {"world": {"noise": {"anchor_sigma": 0.1}}}
    assert paired("planner.options.turns", "mission.accuracy", "robot.a.attack", "mission.noise.gyro_bias")
    assert not paired("mission.max_speed")
    assert not paired("planner.options.turns", "fault[0].loss")
    assert not paired("mission.noise.anchor_sigma"), "the sensors have it, too"
    assert paired("mission.noise.anchor_sigma", base=told), "the sensors have their own"
    assert not paired("mission.noise", base=told), "it has other fields"
    instead = {"field": "world.noise", "values": [{}]}
    assert not paired("mission.noise.anchor_sigma", base=told, axes=[instead])
    scaled = {"field": "mission.max_speed", "uniform": [0.1, 0.2], "times": ["mission.accuracy"]}
    assert not paired("mission.accuracy", draw=[scaled])


def test_planners_get_the_same_trials_and_their_difference_is_that_of_the_pairs(tmp_path: Path) -> None:
    results = tandem.sweep("random", PLANNERS, trials=8, seed=3, workers=1, audit=False, out=tmp_path / "out")
    paper, assured = (results.trials.where(cell=cell) for cell in (0, 1))
    assert paper["seed"].tolist() == assured["seed"].tolist()
    starts = [tandem.run(results.scenario(cell, 2)).truth.where(tick=0)["x"] for cell in (0, 1)]
    assert (starts[0] == starts[1]).all()
    both = (paper["outcome"] == "localised") & (assured["outcome"] == "localised")
    found = {name: values.item() for name, values in dict(results.differences).items()}
    assert (found["value"], found["reference"]) == ("assured", "paper")
    assert found["pairs"] == 8
    assert found["both_localised"] == both.sum() == 8 - found["only_value"] - found["only_reference"]
    assert found["ticks"] == pytest.approx(np.mean(assured["ticks"][both] - paper["ticks"][both]))
    assert found["ticks_low"] < found["ticks"] < found["ticks_high"] < 0.0
    (row,) = csv.DictReader((tmp_path / "out" / "differences.csv").read_text().splitlines())
    assert float(row["ticks_high"]) == found["ticks_high"]
    assert ">assured</td>" in results._repr_html_().rpartition("<table")[2]
    with pytest.raises(tandem.UserError, match=r"axis\[0\].paired is true in the folder and false in this"):
        tandem.sweep("random", PLANNERS, trials=8, seed=3, paired=False, out=tmp_path / "out")


@pytest.mark.long
def test_an_axis_of_the_api_is_paired_as_the_caller_says_and_no_other_is_compared(
    capsys: pytest.CaptureFixture[str],
) -> None:
    axes: dict[str, list[Any]] = {"fault[0].loss": [0.0, 0.5], **PLANNERS}
    for paired, each in ((None, [False, True]), (True, [True, True]), (False, [False, False])):
        results = tandem.sweep("random", axes, trials=1, paired=paired, workers=1, audit=False)
        assert [axis.paired for axis in results.sweep.axes] == each, paired
        assert len(set(results.trials["seed"])) == 4 // 2 ** sum(each)
        assert len(results.differences) == 2 * sum(each)
        sweep_report.show(results.results, Path("out"), quiet=False)
        shown = capsys.readouterr().out
        assert shown.count("assured - paper") == 2 * each[1]
        apart = [name for name, one in zip(axes, each, strict=True) if not one]
        assert ("other random draws at each value of " + ", ".join(apart) in shown) == bool(apart)
        for place, one in enumerate(each):
            ticks = axis_figures.STATISTICS["ticks"]
            points = axis_figures.points(results.results, place, ticks)
            label = axis_figures.over_axis(results.sweep, place, ticks, points).axes[0].get_xlabel()
            assert label.endswith("(other random draws at each value)") == (not one)
    with pytest.raises(tandem.UserError, match=r"paired: 'mission\.period' is none of the axes fault"):
        tandem.sweep("random", axes, paired=["fault[0].loss", "mission.period"])
    with pytest.raises(tandem.UserError, match="paired: it needs axes"):
        tandem.sweep("loss", paired=True)


@pytest.mark.long
def test_the_command_compares_paired_cells_and_says_which_are_not(tmp_path: Path) -> None:
    text = """name = "s"\nscenario = "random"\ntrials = 2\n
[[axis]]\nfield = "mission.max_speed"\nvalues = [0.5, 1.0]
[[axis]]\nfield = "planner.name"\nvalues = ["assured", "paper"]\n"""
    (tmp_path / "s.toml").write_text(text)
    shown = command("sweep", "s.toml", "--out", "paired", cwd=tmp_path).out
    assert shown.count("paper - assured") == 2
    assert "not paired: trials have other random draws at each value of mission.max_speed, so" in shown
    (tmp_path / "s.toml").write_text(text + "paired = false\n")
    shown = command("sweep", "s.toml", "--out", "apart", cwd=tmp_path).out
    assert "difference" not in shown
    assert not (tmp_path / "apart" / "differences.csv").exists()


def test_a_folder_of_a_version_that_drew_otherwise_is_refused(tmp_path: Path) -> None:
    tandem.sweep("random", PLANNERS, trials=1, paired=False, workers=1, audit=False, out=tmp_path / "out")
    before = (tmp_path / "out" / "trials.parquet").read_bytes()
    with pytest.raises(
        tandem.UserError,
        match=r"contains another sweep: axis\[0\].paired is false in the folder and true in this sweep; ",
    ):
        tandem.sweep("random", PLANNERS, trials=2, workers=1, audit=False, out=tmp_path / "out")
    assert (tmp_path / "out" / "trials.parquet").read_bytes() == before


def test_a_pair_is_two_trials_that_ran_and_ticks_are_those_of_two_that_localised() -> None:
    axis = {"field": "planner.name", "values": ["paper", "assured"]}
    table = {"name": "x", "scenario": "x", "trials": 5, "axis": [axis]}
    sweep = spec.validated(table, "x", Path(), base=scenario_table("random"))
    both = {cell.index: cell for cell in cells(sweep)}

    def row(cell: int, trial: int, ticks: int, outcome: Any = "localised") -> TrialRow:
        return TrialRow(cell, trial, 0, outcome, ticks=ticks)

    rows = [row(0, 0, 50), row(0, 1, 60), row(0, 2, 99, "undecided"), refused(0, 3, 0, "", {}), row(0, 4, 9)]
    rows += [row(1, 0, 40), row(1, 1, 54), row(1, 2, 30), row(1, 3, 30), lost(1, 4, 0, "hung", None)]
    trials = of_rows(rows, sweep, both, schema_of(sweep, [*both.values()]))
    (found,) = paired_differences(sweep, [*both.values()], trials)
    assert (found.pairs, found.both_localised, found.only_value, found.only_reference) == (3, 2, 1, 0)
    assert found.ticks == -8.0
    assert found.rate == pytest.approx(1 / 3)


def test_intervals_hold_the_truth_in_95_of_100_cases() -> None:
    draw = np.random.default_rng(1)
    held = []
    for _ in range(2000):
        _, low, high = mean_interval(draw.normal(3.0, 2.0, 12))
        only_value, only_reference, _ = draw.multinomial(60, (0.3, 0.1, 0.6))
        _, low_rate, high_rate = rate_interval(int(only_value), int(only_reference), 60)
        assert low is not None
        assert high is not None
        assert low_rate is not None
        assert high_rate is not None
        held.append((low <= 3.0 <= high, low_rate <= 0.2 <= high_rate))
    assert np.mean(held, axis=0) == pytest.approx((0.95, 0.95), abs=0.015)
    assert mean_interval(np.zeros(0)) == (None, None, None)
    assert mean_interval(np.ones(1)) == (1.0, None, None)
    assert rate_interval(0, 0, 0) == (None, None, None)


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
        alarms[1] += quantile_test(Place("cell", "", ""), "ticks", "p50", before, new).p <= 0.1
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
