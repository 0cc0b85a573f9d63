"""Sweep files, mistakes in them, and what a sweep leaves: folder, summary, audits, figures."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.stats import binom, binomtest  # type: ignore[import-untyped]

from compose.cli.sweep import status_of
from compose.errors import UserError
from compose.scenario.scenario_file import load
from compose.sweep import axis_figures, report, spec
from compose.sweep.cells import cells, label, setting_of, trial_seed
from compose.sweep.statistics import quantile, wilson
from protocol.noise import Noise, VelocityNoise
from tests.commands import on_a_terminal, refused, tandem
from tests.sweep_runs import BOTH, RANDOM, nothing_left, played, rows, summary_rows, sweep, with_files
from world.world_noise import WorldNoise


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return with_files(tmp_path)


def test_a_seed_follows_from_the_sweep_the_cell_and_the_trial(folder: Path) -> None:
    def seeds(text: str) -> dict[tuple[str, ...], int]:
        (folder / "x.toml").write_text(text)
        sweep = spec.load(str(folder / "x.toml"))
        return {tuple(map(str, cell.fields.values())): trial_seed(5, cell.key, 0) for cell in cells(sweep)}

    before = seeds(BOTH)
    assert trial_seed(5, '{"robot.b.anchor[0]":10}', 0) == before["10.0", "paper"] == 2706173664366694412
    more = seeds(BOTH.replace("[10.0, 8]", "[1.5, 8, 10]"))
    assert more["10", "assured"] == before["10.0", "assured"], "cells beside it, and how numbers are written"
    assert more["8", "paper"] == before["8", "paper"] != before["10.0", "paper"]
    assert seeds(BOTH.replace("paired = true", "")) == before, "planners are paired by default"
    unpaired = seeds(BOTH.replace("paired = true", "paired = false"))
    assert len(set(unpaired.values())) == 4
    assert len(set(before.values())) == 2
    assert trial_seed(6, "{}", 0) != trial_seed(5, "{}", 0) != trial_seed(5, "{}", 1)
    assert all(0 <= trial_seed(5, "{}", k) < 2**63 for k in range(100))


@pytest.mark.parametrize("noise", ["3", "[]", '"little"', "{odometry = [1]}", "{odometry = 0.01}"])
def test_a_base_scenario_whose_table_is_none_is_one_line(noise: str, folder: Path) -> None:
    (folder / "base.toml").write_text(RANDOM.replace("[mission]", f"[mission]\nnoise = {noise}"))
    (folder / "bad.toml").write_text(BOTH.replace("robot.b.anchor[0]", "mission.noise.odometry.v"))
    where = "mission.noise.odometry" if noise.startswith("{") else "mission.noise"
    with pytest.raises(UserError) as refused:
        played(folder, "bad.toml", "out")
    assert str(refused.value) == (
        f"{folder / 'bad.toml'}: axis[0].field: 'mission.noise.odometry.v': "
        f"{where} of the base scenario is not a table"
    )


ROWS = """
name = "rows"
scenario = "base.toml"
trials = 2
seed = 5
[set]
"mission.noise.anchor_sigma" = 0.01
"mission.noise.mutual_sigma" = 0.01
"mission.accuracy" = 0.2
[[axis]]
name = "sensors"
paired = true
rows = [
    {label = "as told", set = {}},
    {label = "10 % outliers", set = {"world.noise.outliers" = 0.1}},
    {label = "a is biased", set = {"world.noise.anchor_bias" = {a = 0.1}, "mission.accuracy" = 0.3}},
]
"""


@pytest.mark.parametrize(
    ("was", "new", "says"),
    [
        ("rows = [", "values = [1]\nrows = [", "axis[0]: needs either 'values' or 'rows'"),
        ('name = "sensors"', "", "axis[0].name: missing: an axis with 'rows' needs a name"),
        ("paired = true", 'labels = ["x"]', "axis[0].labels: an axis with 'rows' has none"),
        ('"as told"', '"a is biased"', "axis[0].rows[2].label: equal to that of rows[0]"),
        ('label = "as told", ', "", "axis[0].rows[0]: missing field 'label'"),
        (
            "noise.outliers",
            "noise.outlier",
            "axis[0].rows[1].set: 'world.noise.outlier': world.noise: unknown field",
        ),
        (
            'outliers" = 0.1',
            'outliers" = nan',
            "axis[0].rows[1].set: 'world.noise.outliers': must be a number",
        ),
        (
            '"mission.accuracy" = 0.3',
            '"world.noise" = {}',
            "axis[0].rows[2].set: 'world.noise' is already set by",
        ),
        (
            '"mission.accuracy" = 0.2',
            '"mission.acuracy" = 1',
            "set: 'mission.acuracy': mission: unknown field",
        ),
        ('outliers" = 0.1', 'outliers" = 1.0', "cell 1 (sensors = 10 % outliers): world.noise.outliers: "),
    ],
)
def test_a_mistake_in_a_row_is_one_line_that_names_it(was: str, new: str, says: str, folder: Path) -> None:
    assert was in ROWS
    (folder / "bad.toml").write_text(ROWS.replace(was, new, 1))
    with pytest.raises(UserError) as refused:
        played(folder, "bad.toml", "out")
    assert str(refused.value).startswith(f"{folder / 'bad.toml'}: {says}")


AXIS = 'field = "robot.b.anchor[0]"\nvalues = [10.0, 8]'


JOINT = 'name = "both"\nfields = ["mission.period", "mission.max_speed"]\nvalues = [[1.0, 1.0], [0.5, 1.0]]'


MISTAKES = {
    'name = "both"': {"name = 1": "name: expected", 'name = "a b"': "name: invalid name"},
    "trials = 12": {
        "": "missing field 'trials'",
        "trials = 0": "trials: ",
        'trials = "12"': "trials: ",
        "trails = 12": "unknown field 'trails'",
    },
    "seed = 5": {"seed = -1": "seed: ", "trial_timeout = 0": "trial_timeout: "},
    "base.toml": {"absent.toml": "scenario: 'absent.toml' is neither", "both.toml/x": "scenario: "},
    "name": {"name = ": "not TOML"},
    "paired = true": {"paird = true": "axis[1]: unknown field 'paird'"},
    "robot.b.anchor[0]": {
        "seed": "axis[0].field: 'seed': every trial has its own seed",
        "planner": "axis[1]: 'planner.name' is already set by axis[0] ('planner')",
        "planner.name": "axis[1]: another axis has the name 'planner.name'",
        **{
            field: f"axis[0].field: '{field}': {why}"
            for field, why in {
                "robot.b.anker": "robot[1]: unknown field 'anker'",
                "robot.c.anchor": "the base scenario has no robot",
                "robot[2].anchor": "robot[2]: missing field 'id'",
                "mission.noise.odometry.w": "mission.noise.odometry: unknown field 'w'",
                "robot..anchor": "not a path",
                "mission.period.x": "mission.period of the base scenario is not a table",
            }.items()
        },
    },
    "[10.0, 8]": {
        "[]": "axis[0].values: ",
        "[8, 8.0]": "axis[0].values[1]: equal to values[0]",
        "[8, 1979-05-27]": "axis[0].values[1]: must be a number",
        "[8, nan]": "axis[0].values[1]: must be a number",
        '[8, "x"]': "cell 2 (robot.b.anchor[0] = x; planner.name = paper): robot[1].anchor[0]: ",
        "[8, 0]": "cell 2 (robot.b.anchor[0] = 0; planner.name = paper): robot[1].anchor: ",
    },
    'field = "robot.b.anchor[0]"': {"": "axis[0]: needs either 'field', or 'name'"},
    AXIS: {
        AXIS + '\nlabels = ["x", "y"]': "axis[0].name: missing",
        AXIS + '\nname = "D"\nlabels = ["x", "x"]': "axis[0].labels: must be 2 different labels",
        AXIS + '\nname = "rate"\nlabels = ["x", "y"]': "axis: 2 columns would have the name 'rate'",
        JOINT.replace('name = "both"', ""): "axis[0].name: missing",
        JOINT.replace("[0.5, 1.0]", "[0.5]"): "axis[0].values[1]: must be a list of 2 values",
        JOINT.replace("n.period", "n.perod"): "axis[0].fields[0]: 'mission.perod': mission: unknown",
    },
}
"""The text of BOTH that is replaced, its replacement, and the error that follows."""


@pytest.mark.parametrize(("was", "new"), [(was, new) for was in MISTAKES for new in MISTAKES[was]])
def test_a_mistake_in_a_spec_is_one_line_that_names_the_field(was: str, new: str, folder: Path) -> None:
    assert was in BOTH
    (folder / "bad.toml").write_text(BOTH.replace(was, new, 1))
    with pytest.raises(UserError) as refused:
        played(folder, "bad.toml", "out")
    assert str(refused.value).startswith(f"{folder / 'bad.toml'}: {MISTAKES[was][new]}")
    assert not (folder / "out").exists()


def test_a_spec_that_is_not_there_is_named() -> None:
    refused(
        tandem("sweep", "nowhere"),
        "tandem sweep: nowhere: neither a file nor a shipped sweep (anchors, any-start, ",
    )


@pytest.fixture(autouse=True)
def nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with nothing_left(tmp_path, monkeypatch):
        yield


@pytest.mark.long
def test_more_trials_extend_a_sweep_and_fewer_leave_it(folder: Path) -> None:
    played(folder, "both.toml", "grown", trials=3)
    more: list[int] = []
    played(folder, "both.toml", "grown", done=more.append)
    assert sum(more) == 48 - 12, "what is there is not played again"
    assert len(played(folder, "both.toml", "grown", trials=3).table) == 48
    played(folder, "both.toml", "whole")
    assert rows(folder / "grown") == rows(folder / "whole")


def test_a_folder_of_another_sweep_is_refused(folder: Path) -> None:
    played(folder, "both.toml", "out", trials=1)
    before = rows(folder / "out")
    (folder / "other.toml").write_text(RANDOM.replace("period = 1.0", "period = 0.5"))
    for was, new, says in (
        ("seed = 5", "seed = 6", "seed is 5 in the folder and 6 in this sweep"),
        ("[10.0, 8]", "[10.0, 9]", "axis[0].values[1][0] is 8 in the folder and 9 in this sweep"),
        ("base.toml", "other.toml", "scenario.mission.period is 1 in the folder and 0.5 in this sweep"),
    ):
        (folder / "both.toml").write_text(BOTH.replace(was, new))
        with pytest.raises(UserError) as refused:
            played(folder, "both.toml", "out")
        assert str(refused.value).endswith(f"out contains another sweep: {says}; choose another folder")
    assert rows(folder / "out") == before


@pytest.mark.long
def test_results_are_left_in_a_folder_named_for_the_sweep_and_the_printed_command_runs_a_trial_again(
    folder: Path,
) -> None:
    ended = tandem("sweep", "both.toml", cwd=folder)
    out = folder / "sweep-both"
    drawn = {path.name: path.stat().st_size for path in (out / "figures").iterdir()}
    assert set(drawn) == {
        f"{name}.{kind}"
        for kind in ("svg", "pdf", "png")
        for name in (
            *("success-robot-b-anchor-0", "success-planner-name"),
            *("ticks-robot-b-anchor-0", "ticks-planner-name"),
        )
    }
    assert min(drawn.values()) > 5_000
    assert {path.name for path in out.iterdir()} == {
        *("sweep.json", "cells", "figures", "summary.csv", "differences.csv", "trials.parquet")
    }
    summary = summary_rows(out)
    assert [row["trials"] for row in summary] == ["12"] * 4
    assert list(summary[0])[:9] == [
        *("cell", "robot.b.anchor[0]", "planner.name"),
        *("trials", "localised", "undecided", "inconsistent", "wrong", "failed"),
    ]
    assert ended.out.splitlines()[-1] == "results: sweep-both"
    command = shlex.split(next(line for line in ended.out.splitlines() if line.startswith("  tandem run ")))
    assert command[0] == "tandem"
    tandem(*command[1:], cwd=folder)
    recording = folder / command[command.index("--out") + 1]
    again = json.loads((recording / "summary.json").read_text())
    cell = int(Path(command[2]).stem)
    row = next(row for row in rows(out) if (row["cell"], row["seed"]) == (cell, again["seed"]))
    for name in ("outcome", "reason", "ticks", "first_contact_tick", "t_max_s"):
        assert row[name] == again[name]
    for robot in ("a", "b"):
        said = again["robots"][robot]
        for name in ("branch", "alpha", "position_error_m", "heading_error_rad"):
            assert row[f"{robot}_{name}"] == said[name]
    assert row["bytes_sent"] == sum(robot["bytes_sent"] for robot in again["robots"].values())


@pytest.mark.long
def test_the_bar_of_a_sweep_says_what_its_times_are_and_fits_80_columns(folder: Path) -> None:
    (folder / "few.toml").write_text('name = "a-name-of-18-chars"\nscenario = "random"\ntrials = 40\n')
    status, shown = on_a_terminal("sweep", "few.toml", "--workers", "1", "--out", "out", cwd=folder)
    assert status == 0
    lines = [line for line in re.split("\x1b\\[2K|\r|\n", shown) if "left" in line]
    text = re.sub("\x1b\\[[?0-9;]*[a-zA-Z]", "", lines[-1])
    assert re.search(r"/40 [0-9.e+]+ trials/s [0-9:]+ elapsed, [0-9:]+ left", text)
    assert text.startswith("a-name-of-18-chars")
    assert len(text) <= 80


@pytest.mark.long
def test_a_narrow_terminal_shows_all_outcomes_and_breaks_no_word_and_no_command(folder: Path) -> None:
    columns = 40
    axes = '[[axis]]\nfield = "max_ticks"\nvalues = [9, 500]\n[[axis]]\nfield = "planner.name"\n'
    (folder / "narrow.toml").write_text(
        f'name = "narrow"\nscenario = "random"\ntrials = 2\n{axes}values = ["assured"]\n'
    )
    status, shown = on_a_terminal("sweep", "narrow.toml", columns=columns, cwd=folder)
    assert status == 1
    lines = re.split("\x1b\\[[?0-9;]*[a-zA-Z]|\r?\n|\r", shown)
    (command,) = [line for line in lines if line.startswith("  tandem run ")]
    assert re.fullmatch(
        r"  tandem run sweep-narrow/cells/000.toml --seed \d+ --out recording-narrow-0-\d", command
    )
    result = lines[next(i for i, line in enumerate(lines) if line.startswith("narrow: ")) :]
    assert [line for line in result if line != command and len(line) > columns] == []
    text = " ".join(" ".join(result).split())
    counts = "trials 2; localised 0; undecided 2; inconsistent 0; wrong 0; failed 0"
    rate = "rate 0.0000; rate_low 0.0000; rate_high 0.6576"
    assert f"cell 0, max_ticks 9, name assured: {counts}; {rate}; p50 -" in text
    assert "localised 2; undecided 0; inconsistent 0; wrong 0; failed 0; rate 1.0000; rate_low 0.3424" in text
    assert "\n\n\n" not in "\n".join(result)
    assert "(max_ticks: a, b not localised by then); to run it again:" in text


@pytest.mark.long
def test_of_more_cells_than_fit_a_screen_those_in_which_all_is_well_are_counted(folder: Path) -> None:
    starts = ", ".join([f"[{0.3 + 0.01 * i:.2f}, 0.1, 1.0]" for i in range(51)])
    axis = f'[[axis]]\nfield = "robot.a.start"\nvalues = [{starts}]\n'
    planner_name = '[[axis]]\nfield = "planner.name"\nvalues = ["assured", "paper"]\n'
    (folder / "many.toml").write_text(
        f'name = "many"\nscenario = "random"\ntrials = 1\nseed = 1\n{axis}{planner_name}'
    )
    ended = sweep(folder, "many.toml", "out")
    total = {row["cell"]: row["localised"] for row in summary_rows(folder / "out")}
    assert len(total) == 102
    poor = [cell for cell, localised in total.items() if localised == "0"]
    lines = ended.out.splitlines()
    listed = [line.split()[0] for line in lines if line[:1] == " " and line[1:2].isdigit()]
    assert listed == poor
    assert f"{102 - len(poor)} cells without a problem are not listed; see out/summary.csv" in lines
    assert 0 < len(poor) < 102


@pytest.mark.long
def test_a_trial_that_breaks_a_rule_fails_the_sweep_and_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = played(folder, "both.toml", "out", trials=4, play="tests.misbehaving:boastful")
    found = rows(folder / "out")
    assert [row["violations"] > 0 for row in found] == [row["trial"] == 2 for row in found]
    first = "tick 0, a, decision: in its Estimate, localised is true, expected false"
    assert {row["first_violation"] for row in found} == {first, None}
    summary = summary_rows(folder / "out")
    assert [(row["audited"], row["clean"]) for row in summary] == [("4", "3")] * 4
    assert [int(row["violations"]) for row in summary] == [
        row["violations"] for row in found if row["trial"] == 2
    ]
    assert status_of(results) == 3
    report.show(results, folder / "out", quiet=True)
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == f"audited: 16 of 16 trials, 12 clean; trial 2 of cell 0: {first}"
    report.show(results, folder / "out", quiet=False)
    said = capsys.readouterr().out.splitlines()
    assert any(line.startswith("look at trial 2 of cell 0 first: ") and first in line for line in said)
    heading = next(line for line in said if line.startswith(" cell")).split()
    line = next(line for line in said if line.startswith(" 0 ")).split()
    assert (heading[-1], line[-1]) == ("clean", "3")


@pytest.mark.long
def test_the_command_that_runs_a_trial_again_records_to_a_new_folder(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    results = played(folder, "both.toml", "out", trials=4, play="tests.misbehaving:boastful")
    monkeypatch.chdir(folder)
    for name in ("recording-both-0-2", "recording-both-0-2-2", "recording-both-0-2-3"):
        report.show(results, Path("out"), quiet=False)
        (line,) = [one for one in capsys.readouterr().out.splitlines() if one.startswith("  tandem run ")]
        assert line.endswith(f" --out {name}")
        Path(name).mkdir()


@pytest.mark.long
def test_a_sweep_without_audit_does_not_mention_it(folder: Path) -> None:
    ended = sweep(folder, "both.toml", "out", "--trials", "1", "--no-audit")
    assert "audited" not in ended.out
    assert {(row["violations"], row["first_violation"]) for row in rows(folder / "out")} == {(None, None)}
    assert [(row["audited"], row["clean"], row["violations"]) for row in summary_rows(folder / "out")] == [
        ("0", "0", "0")
    ] * 4


@pytest.mark.long
def test_a_cell_in_which_no_robots_can_meet_is_refused(folder: Path) -> None:
    slow = '[[axis]]\nname = "pace"\nfields = ["mission.max_speed", "mission.period"]\nvalues = '
    start = 'name = "slow"\nscenario = "base.toml"\ntrials = 2\n' + slow
    (folder / "slow.toml").write_text(start + "[[1.0, 1.0], [1e-6, 1e-3]]")
    ended = sweep(folder, "slow.toml", "out")
    assert ended.status in (0, 1)
    assert "cell 1 cannot run: mission: a robot moves at most " in ended.out
    summary = summary_rows(folder / "out")
    assert [row["trials"] for row in summary] == ["2", "0"]
    assert [bool(row["refused"]) for row in summary] == [False, True]
    (folder / "slow.toml").write_text(start + "[[1e-6, 1e-3]]")
    with pytest.raises(UserError, match="no cell can run; cell 0: mission: a robot moves at most"):
        played(folder, "slow.toml", "none")
    assert not (folder / "none").exists()


@pytest.mark.long
def test_a_sweep_in_which_none_localises_has_its_figures(folder: Path) -> None:
    (folder / "short.toml").write_text(
        'name = "short"\nscenario = "base.toml"\ntrials = 1\n[[axis]]\nfield = "max_ticks"\nvalues = [1, 2]\n'
    )
    ended = sweep(folder, "short.toml", "out", "--workers", "1")
    assert (ended.status, ended.err) == (1, "")
    assert (folder / "out" / "figures" / "ticks-max_ticks.svg").exists()


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (3, 10), (9990, 10_000), (0, 500), (500, 500)])
def test_a_rate_s_interval_is_wilson_s(k: int, n: int) -> None:
    interval = binomtest(k, n).proportion_ci(method="wilson")
    assert wilson(k, n) == pytest.approx((k / n, interval.low, interval.high), abs=1e-12)


def test_an_interval_of_a_quantile_holds_it_in_95_of_100_samples() -> None:
    """The numbers 1 to n of a sample are its ranks, so the bounds say which order statistics they are."""
    for n, p in ((20, 0.5), (100, 0.95), (1000, 0.5)):
        estimate, low, high = quantile(np.arange(1.0, n + 1.0), p)
        inside = binom.cdf(high - 1, n, p) - binom.cdf(low - 1, n, p)
        narrower = binom.cdf(high - 2, n, p) - binom.cdf(low - 1, n, p)
        assert inside >= 0.95
        assert narrower < 0.975
        assert low < estimate < high
    assert quantile(np.array([7.0]), 0.95) == (7.0, 7.0, 7.0)


def test_an_axis_reaches_into_tables_that_the_base_scenario_leaves_out(folder: Path) -> None:
    (folder / "nested.toml").write_text(
        'name = "nested"\nscenario = "base.toml"\ntrials = 1\n[[axis]]\nname = "noise"\n'
        'fields = ["mission.noise.odometry.v", "mission.noise.anchor_sigma", "mission.accuracy"]\n'
        "values = [[0, 0, 0.1], [0.01, 0.02, 0.3]]\n"
    )
    assert "noise" not in RANDOM
    results = played(folder, "nested.toml", "out")
    for cell, (v, sigma, accuracy) in zip(results.cells, [(0.0, 0.0, 0.1), (0.01, 0.02, 0.3)], strict=True):
        setting = setting_of(results.sweep, cell)
        assert load(str(folder / "out" / "cells" / cell.file_name)) == setting.scenario
        mission = setting.scenario.mission
        assert mission.noise == Noise(anchor_sigma=sigma, odometry=VelocityNoise(v=v))
        assert mission.accuracy == accuracy
    assert [row["mission.noise.odometry.v"] for row in rows(folder / "out")] == [0.0, 0.01]


@pytest.mark.long
def test_a_figure_distinguishes_the_values_of_the_other_axes_while_they_are_few(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, Figure] = {}
    monkeypatch.setattr(axis_figures, "save", lambda figure, path: drawn.update({path.name: figure}))
    third = '[[axis]]\nfield = "mission.noise.outliers"\nvalues = [0, 0.05]\n'
    third += '[[axis]]\nfield = "max_ticks"\nvalues = [1, 2, 3, 4]\npaired = false\n'
    (folder / "four.toml").write_text(BOTH + third)
    axis_figures.draw(played(folder, "four.toml", "out", trials=1), folder / "figures")

    def told_apart(name: str) -> list[str]:
        return [text.get_text() for text in drawn[name].legends[0].get_texts()]

    both = [f"{planner_name}, anchor[0] = {d}" for planner_name in ("paper", "assured") for d in (10, 8)]
    assert told_apart("success-mission-noise-outliers") == told_apart("success-max_ticks") == both
    assert told_apart("success-planner-name") == [
        f"anchor[0] = {d}, outliers = {share}" for d in (10, 8) for share in (0, 0.05)
    ]


@pytest.mark.long
def test_rows_differ_from_the_base_in_the_fields_that_they_set(folder: Path) -> None:
    (folder / "rows.toml").write_text(ROWS)
    results = played(folder, "rows.toml", "out")
    settings = [setting_of(results.sweep, cell) for cell in cells(results.sweep)]
    found = []
    for setting in settings:
        assert setting.scenario.mission.noise == Noise(anchor_sigma=0.01, mutual_sigma=0.01)
        noise = setting.scenario.world_noise or WorldNoise()
        found.append((setting.scenario.mission.accuracy, noise.outliers, noise.anchor_bias))
    assert found == [(0.2, None, 0.0), (0.2, 0.1, 0.0), (0.3, None, {"a": 0.1})]
    fields = ("sensors", "world.noise.outliers", "world.noise.anchor_bias", "mission.accuracy")
    assert [tuple(row[name] for name in fields) for row in rows(folder / "out")[::2]] == [
        ("as told", None, None, None),
        ("10 % outliers", 0.1, None, None),
        ("a is biased", None, '{"a":0.1}', 0.3),
    ]
    assert len({row["seed"] for row in rows(folder / "out")}) == 2, "the same starts in all rows"
    assert [tuple(row[name] for name in fields) for row in summary_rows(folder / "out")] == [
        ("as told", "", "", ""),
        ("10 % outliers", "0.1", "", ""),
        ("a is biased", "", '{"a":0.1}', "0.3"),
    ]
    assert label(results.sweep, list(cells(results.sweep))[1]) == "sensors = 10 % outliers"
