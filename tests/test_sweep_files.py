"""Sweep files: their cells and seeds, and each mistake in one line that names the field."""

from __future__ import annotations

from pathlib import Path

import pytest

from compose.errors import UserError
from compose.sweep import spec
from compose.sweep.cells import cells, trial_seed
from tests.commands import refused, tandem
from tests.sweep_runs import BOTH, RANDOM, played, with_files


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
