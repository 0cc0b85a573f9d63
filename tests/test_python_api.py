"""The Python API: runs, scenarios, sweeps and recordings as values, arrays and tables."""

from __future__ import annotations

import doctest
import math
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import tandem
from compose import extras
from compose.audit.rules import audit_run
from compose.recording import run as recorded
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.rows import tick_rows
from compose.recording.run import read
from compose.recording.summary_json import summary
from protocol.messages import Command
from protocol.motion import REST
from tandem.columns import Table
from tests.benchmark import in_process as benchmark
from tests.commands import tandem as command
from tests.range_tables import SAMPLE
from tests.series import series

MODULES = (
    "",
    ".clash",
    ".columns",
    ".missions",
    ".results",
    ".scenarios",
    ".sweeps",
    ".worlds",
    ".estimates",
)
TABLES = ("truth", "observations", "commands", "estimates", "messages", "claims")


@pytest.fixture(scope="module")
def run() -> tandem.Run:
    return tandem.run("random", seed=3, faults="a->b: loss=0.3")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of the same run by the command line."""
    out = tmp_path_factory.mktemp("api") / "recording"
    ended = command("run", "random", "--seed", "3", "--fault", "a->b: loss=0.3", "--out", str(out))
    assert ended.status == 0, ended
    return out


def same(one: Table, other: Table) -> bool:
    return one.columns == other.columns and all(
        np.array_equal(one[name], other[name], equal_nan=one[name].dtype == float) for name in one.columns
    )


@pytest.mark.parametrize("module", series(MODULES, len(MODULES) - 1))  # estimates take longest
def test_the_examples_in_docstrings_give_what_they_show(module: str) -> None:
    found = doctest.testmod(import_module(f"tandem{module}"), optionflags=doctest.ELLIPSIS)
    assert found.failed == 0


def test_every_public_name_is_there_and_listed() -> None:
    assert set(tandem.__all__) <= set(dir(tandem))
    for name in tandem.__all__:
        assert getattr(tandem, name) is not None
    with pytest.raises(AttributeError, match="module 'tandem' has no attribute 'rnu'"):
        _ = tandem.rnu


# --- the simulator ------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", ["noisy", "group-8"])
def test_a_world_that_gets_the_commands_of_a_run_gives_its_observations_truth_and_outcome(
    scenario: str,
) -> None:
    lossy = tandem.Scenario.load(scenario).with_faults({"loss": 0.3})
    run = tandem.run(lossy)
    world, seen, there = tandem.World(lossy), [], []
    for tick in run.model.ticks:
        seen += [one.anchor_range for one in world.observe().values()]
        there += [pose.x for pose in world.truth.values()]
        assert world.observe() == world.observe()
        world = world.step(tick.commands)
    assert np.array_equal(np.array(seen, float), run.observations["anchor_range"], equal_nan=True)
    assert there == run.truth["x"].tolist()
    assert (world.outcome, world.tick) == (run.outcome, run.ticks)
    with pytest.raises(tandem.UserError, match="the world has ended: localised"):
        world.step({})


def test_steps_from_one_world_are_futures_of_it_and_leave_it_as_it_is() -> None:
    world = tandem.World("noisy", seed=7)
    before = world.truth, world.observe()
    ahead = [world.step({"a": command}) for command in ((1.0, 0.0), np.array([1.0, 0.0]), REST, (9.0, 0.0))]
    assert ahead[0].observe() == ahead[1].observe()
    assert ahead[0].truth == ahead[3].truth  # limited to v_max
    assert ahead[2].truth == world.truth
    assert (world.truth, world.observe()) == before


@pytest.mark.parametrize(
    ("commands", "why"),
    [
        ({"aa": (0.0, 0.0)}, "commands: no robot 'aa'; there are a, b"),
        ({"a": (0.0,)}, "commands: a: not (v, omega) in m/s and rad/s: (0.0,)"),
        ({"a": "up"}, "commands: a: not (v, omega) in m/s and rad/s: 'up'"),
        ({"a": (float("nan"), 0.0)}, "commands: a: not (v, omega) in m/s and rad/s: (nan, 0.0)"),
        ({"b": np.zeros(3)}, "commands: b: not (v, omega) in m/s and rad/s: array([0., 0., 0.])"),
        ({"b": Command(3, "b", 0.0, 0.0, 1, "")}, "commands: b: a Command of b in tick 3, not 0"),
        ({"b": Command(0, "b", float("nan"), 0.0, 1, "")}, "commands: b: a Command that cannot be sent: Exp"),
        ({"b": (10**400, 0)}, "commands: b: not (v, omega) in m/s and rad/s: (1000"),
        ({0: (0.0, 0.0)}, "commands: no robot '0'; there are a, b"),
        ([], "commands: not a dict of commands by robot: list"),
    ],
)
def test_a_command_that_is_none_is_refused_in_one_line(commands: dict[str, Any], why: str) -> None:
    with pytest.raises(tandem.UserError, match=re.escape(why)):
        tandem.World("noisy").step(commands)


# --- runs ---------------------------------------------------------------------------------------------


def test_a_run_in_one_process_has_everything_that_a_recording_has(run: tandem.Run, recording: Path) -> None:
    opened = tandem.open(recording)
    for name in TABLES:
        assert same(getattr(run, name), getattr(opened, name)), name
    assert run.audit() == opened.audit() == audit_run(read(recording))
    assert run.audit().violations == ()
    assert opened.mode == "processes"
    assert opened.wall_s is not None


def test_a_saved_run_has_the_bytes_of_the_recording(run: tandem.Run, recording: Path, tmp_path: Path) -> None:
    saved = run.save(tmp_path / "saved")
    for name in ("world.journal", "agent-a.journal", "agent-b.journal", "ticks.csv"):
        assert (saved / name).read_bytes() == (recording / name).read_bytes(), name
    assert (saved / "summary.json").exists()
    assert command("replay", str(saved)).status == 0
    with pytest.raises(tandem.UserError, match=r"already contains a recording; choose another folder$"):
        run.save(saved)


def test_a_run_as_processes_with_a_kill_has_the_same_data() -> None:
    alone = tandem.run("paper-1")
    killed = tandem.run("paper-1", processes=True, kills="a@17")
    for name in TABLES:
        assert same(getattr(killed, name), getattr(alone, name)), name
    assert (alone.mode, killed.mode) == ("in-process", "processes")


def test_the_tables_hold_what_the_files_hold(run: tandem.Run) -> None:
    ticks = list(tick_rows(run.model))
    for name in ("tick", "robot", "x", "y", "heading"):
        assert run.truth[name].tolist() == [getattr(row, name) for row in ticks]
    for name in ("anchor_range", "mutual_range"):
        assert [None if np.isnan(one) else one for one in run.observations[name]] == [
            getattr(row, name) for row in ticks
        ]
    assert run.commands["state"].tolist() == [row.state for row in ticks]
    robots = summary(run.model, None, None)["robots"]
    for name in ("position_error_m", "heading_error_rad", "mutual_ranges", "reports_heard"):
        assert run.claims[name].tolist() == [robot[name] for robot in robots.values()]
    assert len(run.messages) == sum(len(one.frames) for one in run.model.journals.values())
    assert run.summary["outcome"] == run.outcome == "localised"


@pytest.mark.long
def test_estimates_have_errors_only_where_a_pose_is_known_and_probabilities_that_sum_to_one() -> None:
    found = tandem.run("noisy", seed=7).estimates
    local = found["frame"] == "local"
    assert np.isnan(found["position_error_m"][local]).all()
    assert (found["position_error_m"][~local] >= 0.0).all()
    for robot in ("a", "b"):
        of = found.where(robot=robot)
        known = ~np.isnan(of["probability"])
        sums = np.bincount(of["tick"][known], of["probability"][known])
        assert sums[sums > 0.0] == pytest.approx(1.0)
    assert found.where(localised=True)["nees"].max() < 30.0


def test_figures_of_a_run_are_those_of_the_command(run: tandem.Run) -> None:
    found = run.figures("trajectory", "ranges", paper=True)
    assert list(found) == ["trajectory-a-b", "ranges-a-b"]
    with pytest.raises(tandem.UserError, match=r"there is no figure 'range'; .*; did you mean 'ranges'"):
        run.figures("range")


def test_a_plot_is_the_first_figure_of_its_kind(run: tandem.Run) -> None:
    assert {"path-a", "path-b", "range-a"} <= names_in(run.plot())
    assert names_in(run.plot("ranges")) == names_in(run.figures("ranges")["ranges-a-b"])
    with pytest.raises(tandem.UserError, match=r"^random, .*: there is no figure 'meetings' of it$"):
        run.plot("meetings")
    with pytest.raises(tandem.UserError, match="there is no figure 'range'"):
        run.plot("range")


def names_in(figure: Figure) -> set[str | None]:
    """Return the names of what a figure shows."""
    return {artist.get_gid() for artist in figure.findobj()}


def test_a_notebook_shows_the_outcome_and_the_picture(run: tandem.Run) -> None:
    page = run._repr_html_()
    assert "localised after" in page
    assert '<img src="data:image/svg+xml;base64,' in page
    assert "<td>a</td>" in page


def test_without_matplotlib_a_notebook_shows_the_outcome(
    run: tandem.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda _: None)
    page = run._repr_html_()
    assert "localised after" in page
    assert "<img" not in page
    with pytest.raises(tandem.UserError, match=r"^needs matplotlib: install `tandem-ranging\[lab\]`$"):
        run.figures()


# --- tables -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TABLES)
def test_a_table_converts_to_arrow_pandas_and_polars(run: tandem.Run, name: str) -> None:
    table: Table = getattr(run, name)
    arrow, pandas, polars = table.arrow(), table.pandas(), table.polars()
    assert (*arrow.column_names,) == (*pandas.columns,) == (*polars.columns,) == table.columns
    assert len(arrow) == len(pandas) == len(polars) == len(table) > 0
    for column in table.columns:
        missing = pandas[column].isna().sum()
        assert arrow[column].null_count == polars[column].null_count() == missing


def test_a_table_is_read_by_libraries_of_arrow_streams(run: tandem.Run) -> None:
    polars = pytest.importorskip("polars")
    assert polars.DataFrame(run.truth).shape == (len(run.truth), 6)


def test_an_array_of_a_table_cannot_be_changed_by_accident(run: tandem.Run) -> None:
    with pytest.raises(ValueError, match="read-only"):
        run.truth["x"][0] = 0.0
    frame = run.truth.pandas()
    frame.loc[0, "x"] = 0.0
    assert run.truth["x"][0] != 0.0


def test_an_unknown_column_is_named_with_the_known_ones(run: tandem.Run) -> None:
    with pytest.raises(KeyError, match=r"no column 'headng'; there are tick, .*; did you mean 'heading'\?"):
        run.truth["headng"]
    with pytest.raises(KeyError, match="no column 'robt'"):
        run.truth.where(robt="a")


@pytest.mark.long
def test_a_recording_of_hardware_mode_has_no_truth_and_no_errors(tmp_path: Path) -> None:
    saved = tandem.run("noisy", seed=7).save(tmp_path / "recording")
    for name in ("world.journal", "summary.json"):
        (saved / name).unlink()
    run = tandem.open(saved)
    assert (run.outcome, run.seed, run.mode, len(run.truth)) == ("localised", None, None, 0)
    assert run.claims["localised"].all()
    assert not np.isnan(run.claims["x"]).any()
    assert np.isnan(run.claims["position_error_m"]).all()
    assert np.isnan(run.estimates["position_error_m"]).all()
    assert run.audit().violations == ()
    assert "hardware mode" in run._repr_html_()
    with pytest.raises(tandem.UserError, match=r"there is no world\.journal$"):
        _ = run.summary
    again = tandem.open(run.save(tmp_path / "again"))
    assert same(again.messages, run.messages)


@pytest.mark.parametrize(("method", "library"), [("arrow", "pyarrow"), ("pandas",) * 2, ("polars",) * 2])
def test_a_missing_library_is_named_with_its_extra(
    run: tandem.Run, method: str, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda _: None)
    with pytest.raises(tandem.UserError, match=rf"^needs {library}.*: install `tandem-ranging\[tables\]`$"):
        getattr(run.truth, method)()


# --- errors: the text of the command -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words", "kind"),
    [
        ({"scenario": "papr-1"}, ["papr-1"], tandem.BadScenario),
        ({"scenario": "noise"}, ["noise"], tandem.BadScenario),
        ({"scenario": "paper-1", "faults": "a->c: loss=1"}, ["paper-1", "--fault", "a->c: loss=1"], None),
        ({"scenario": "paper-1", "faults": ["los=1"]}, ["paper-1", "--fault", "los=1"], tandem.BadScenario),
        ({"scenario": "paper-1", "kills": "c@3"}, ["paper-1", "--kill", "c@3"], tandem.BadKill),
    ],
)
def test_an_invalid_argument_raises_the_line_of_the_command(
    arguments: dict[str, str], words: list[str], kind: type[Exception] | None
) -> None:
    with pytest.raises(kind or tandem.UserError) as raised:
        tandem.run(**arguments)  # type: ignore[arg-type]
    ended = command("run", *words)
    assert ended.status == 2
    assert ended.err.splitlines() == [f"tandem run: {raised.value}"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"kills": "a@3"}, "kills: a run in one process has no processes to kill; set processes=True"),
        ({"rate": 1.0}, "rate: a run in one process cannot run in real time; set processes=True"),
        ({"processes": True, "timeout": 0}, "timeout: 0 is not a positive number"),
        ({"seed": -1}, "paper-1: seed: expected a whole number >= 0"),
    ],
)
def test_an_argument_that_does_not_fit_is_refused_in_one_line(
    arguments: dict[str, object], text: str
) -> None:
    with pytest.raises(tandem.UserError) as raised:
        tandem.run("paper-1", **arguments)  # type: ignore[arg-type]
    assert str(raised.value) == text


def test_a_folder_without_a_recording_is_an_error_of_one_line(tmp_path: Path) -> None:
    with pytest.raises(tandem.UserError, match=r"contains no recording: there is no world\.journal$"):
        tandem.open(tmp_path)


# --- scenarios ----------------------------------------------------------------------------------------


def test_a_scenario_is_changed_by_paths_and_stays_as_it_is() -> None:
    scenario = tandem.Scenario.load("random")
    changed = scenario.with_({"robot.a.start": np.array([1.0, 0.0, 0.5]), "planner.name": "paper"}, seed=9)
    assert changed.table["robot"][0]["start"] == [1.0, 0.0, 0.5]
    assert (changed.seed, changed.template.scenario.planner_name) == (9, "paper")
    assert "start" not in scenario.table["robot"][0]
    assert tandem.Scenario.from_dict(changed.table) == tandem.Scenario.from_dict(changed.table)


def test_the_seed_of_a_run_is_that_of_its_scenario() -> None:
    scenario = tandem.Scenario.load("random").with_(seed=5)
    assert same(tandem.run(scenario).truth, tandem.run("random", seed=5).truth)


def test_faults_are_texts_or_tables() -> None:
    scenario = tandem.Scenario.load("random")
    assert (
        scenario.with_faults("a->b: loss=0.5").template.scenario.faults
        == scenario.with_faults({"link": "a->b", "loss": 0.5}).template.scenario.faults
        == scenario.with_({"fault": [{"link": "a->b", "loss": 0.5}]}).template.scenario.faults
    )


@pytest.mark.parametrize("name", ["random", "noisy", "random-group"])
def test_another_seed_gives_the_scenario_that_its_file_with_this_seed_gives(name: str) -> None:
    scenario = tandem.Scenario.load(name)
    assert scenario.with_(seed=5) == tandem.Scenario.from_dict({**scenario.table, "seed": 5}, name)
    for wrong, why in ((-1, ">= 0"), (2**63, "<= "), (True, "got true or false"), ("5", "got text")):
        with pytest.raises(tandem.BadScenario, match=f"{name}: seed: .*{why}"):
            scenario.with_(seed=wrong)


@pytest.mark.parametrize(
    "changed", [{}, {"fault[0].loss": 0.5}, {"planner.name": "paper"}, {"name": "group"}]
)
def test_a_run_equals_what_is_read_from_its_journals(changed: dict[str, Any]) -> None:
    name = "random-group" if changed.get("name") == "group" else "random"
    run = tandem.run(tandem.Scenario.load(name).with_(changed), seed=2).model
    read = recorded.of_frames({file: one.frames for file, one in run.journals.items()}, run.source)
    assert (run.world, run.agents, run.journals) == (read.world, read.agents, read.journals)
    assert [*run.agents] == [*read.agents]
    assert [*run.journals] == [*read.journals]


@pytest.mark.long
def test_the_api_takes_at_most_twice_the_time_of_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "BY_API", {"random": 50})
    ratios = [
        benchmark.missions_by_api(number)["tandem.run / engine (at most 1.6), random"] for number in range(3)
    ]
    assert median(ratios) < 2.0


# --- sweeps -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def results() -> tandem.SweepResults:
    return tandem.sweep("random", {"fault[0].loss": [0.0, 0.9]}, trials=2, workers=1)


def test_a_sweep_of_a_scenario_has_a_row_per_trial_and_per_cell(results: tandem.SweepResults) -> None:
    assert results.cells["fault[0].loss"].tolist() == [0.0, 0.9]
    assert results.cells["trials"].tolist() == [2, 2]
    assert results.trials["outcome"].tolist() == ["localised"] * 4
    assert results.trials.arrow()["ticks"].to_pylist() == results.trials["ticks"].tolist()
    assert "<td>0.9</td>" in results._repr_html_()


def test_a_trial_of_a_sweep_can_be_run_again(results: tandem.SweepResults) -> None:
    again = tandem.run(results.scenario(1, 1))
    assert again.ticks == results.trials.where(cell=1, trial=1)["ticks"].item()
    with pytest.raises(tandem.UserError, match="random has no cell 7"):
        results.scenario(7, 0)


def test_a_sweep_is_given_by_a_dict_and_its_folder_is_that_of_the_command(
    results: tandem.SweepResults, tmp_path: Path
) -> None:
    axis = {"field": "fault[0].loss", "values": [0.0, 0.9]}
    content = {"name": "random", "scenario": tandem.Scenario.load("random"), "trials": 2, "axis": [axis]}
    same_results = tandem.sweep(content, out=tmp_path / "out", workers=1)
    for name in ("seed", "ticks", "outcome"):
        assert same_results.trials[name].tolist() == results.trials[name].tolist()
    assert (tmp_path / "out" / "trials.parquet").exists()


def test_a_mistake_in_a_sweep_is_one_line() -> None:
    for arguments, text in (
        (
            ("random", {"fault[0].los": [1.0]}),
            "random: axis[0].field: 'fault[0].los': .*; did you mean 'loss'",
        ),
        (("nose",), "nose: neither a file nor a shipped sweep .*; did you mean 'noise'"),
        ((tandem.Scenario.load("random"),), "sweep: a scenario needs axes"),
    ):
        with pytest.raises(tandem.UserError, match=text.replace("[", r"\[")):
            tandem.sweep(*arguments)


@pytest.mark.parametrize("workers", [0, -1, 10**30, 1.5, "3"])
@pytest.mark.parametrize("of", [tandem.sweep, tandem.arena])
def test_a_number_of_workers_that_no_machine_has_is_refused(of: Callable[..., object], workers: Any) -> None:
    with pytest.raises(tandem.UserError, match=f"^workers: {workers!r} is not a whole number from 1"):
        of("random", workers=workers)


def test_importing_tandem_imports_no_other_package() -> None:
    code = (
        "import sys; before = {*sys.modules}; import tandem; "
        "loaded = {name.partition('.')[0] for name in {*sys.modules} - before}; "
        "print(*loaded - sys.stdlib_module_names)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["tandem"]


# --- estimates ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_estimates_are_those_of_the_command(tmp_path: Path) -> None:
    words = ("--noise", "uwb-calibrated", "--window", "0..12", "--out", "found")
    assert command("estimate", str(SAMPLE), *words, cwd=tmp_path).status == 1, (
        "12 s are not enough for a claim"
    )
    found = tandem.estimate(SAMPLE, noise="uwb-calibrated", window=(0.0, 12.0))
    assert "makes no claim" in repr(found)
    saved = found.save(tmp_path / "saved")
    for name in ("estimate.csv", "estimate.json"):
        assert (saved / name).read_bytes() == (tmp_path / "found" / name).read_bytes()
    assert found.rows.columns == PoseEstimateRow.__struct_fields__
    for name, figure in found.figures().items():
        assert names_in(found.plot(name.removeprefix("estimate-"))) == names_in(figure)  # type: ignore[arg-type]
    with pytest.raises(tandem.UserError, match=r"^there is no figure 'paths'; .*; did you mean 'path'\?$"):
        found.plot("paths")  # type: ignore[arg-type]
    assert {*found.figures()} == {path.stem for path in (tmp_path / "found").glob("*.svg")}
    assert "<td>A</td>" in found._repr_html_()


@pytest.mark.long
def test_a_run_and_its_recording_have_the_same_estimates(tmp_path: Path) -> None:
    run = tandem.run("noisy")
    found, again = tandem.estimate(run), tandem.estimate(run.save(tmp_path / "recording"))
    assert same(found.rows, again.rows)
    last = found.rows["t_s"] == max(found.rows["t_s"])
    assert tuple(found.rows["robot"][last]) == found.robots


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"accuracy": 0.0}, "accuracy: 0.0 is not a positive number"),
        ({"confidence": 1.0}, "confidence: 1.0 is not a probability from 0.5 to below 1"),
        ({"robots": ["C"]}, "has no robot C; it has A, B"),
        ({"robots": []}, "--robots: it names no robot"),
        ({"robots": ["A", "A"]}, "--robots: it names a robot twice"),
        ({"window": (1.0,)}, "window: (1.0,) is not the begin and the end of an interval in s"),
        ({"window": 3.0}, "window: 3.0 is not the begin and the end of an interval in s"),
        ({"window": (5.0, 1.0)}, "window: 5 s is not before 1 s"),
        ({"window": (0.0, math.nan)}, "window: 0 s is not before nan s"),
        ({"noise": "uwbb"}, "uwbb"),
    ],
)
def test_a_wrong_argument_of_an_estimate_is_one_line(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(tandem.UserError, match=re.escape(says)) as found:
        tandem.estimate(SAMPLE, **arguments)
    assert "\n" not in str(found.value)


def test_a_run_is_not_made_from_the_path_of_a_recording(tmp_path: Path) -> None:
    with pytest.raises(tandem.UserError, match=r"is no run; open a recording with tandem\.open$"):
        tandem.Run(str(tmp_path))  # type: ignore[arg-type]


def test_a_scenario_of_another_type_is_an_error_that_names_its_type() -> None:
    with pytest.raises(
        tandem.UserError, match=r"^scenario: not a name, path, dict or tandem\.Scenario: int$"
    ):
        tandem.run(3)  # type: ignore[arg-type]
