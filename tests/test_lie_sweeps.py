"""The sweep over attacks: its labels describe the false data, and its figures show the outcomes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from compose.sweep import axis_figures, execution, spec
from compose.sweep.cells import cells, setting_of
from protocol.attack import Attack
from protocol.network.inbox import Inbox

SPEC = """
name = "few-attacks"
scenario = "random"
trials = 4
seed = 4

[[axis]]
name = "attack"
field = "robot.a.attack"
paired = true
labels = ["honest", "scale orbit 0.5", "rotate encounter 15 deg"]
values = [
    {kind = "scale", part = "all", size = 1.0},
    {kind = "scale", part = "orbit", size = 0.5},
    {kind = "rotate", part = "encounter", size = 0.26},
]

[[axis]]
name = "sigma"
paired = true
fields = ["mission.noise.anchor_sigma", "mission.noise.mutual_sigma"]
labels = ["0 m", "0.01 m"]
values = [[0.0, 0.0], [0.01, 0.01]]
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> execution.Results:
    """Return the results of a few missions with a few attacks."""
    folder = tmp_path_factory.mktemp("attacks")
    (folder / "few.toml").write_text(SPEC)
    progress = execution.Progress(say=lambda _: None, begin=lambda *_: None, done=lambda _: None)
    sweep = spec.load(str(folder / "few.toml"))
    return execution.sweep(
        sweep, folder / "out", execution.ExecutionOptions(workers=1), Inbox("test"), progress
    )


def test_the_shipped_sweep_has_the_attacks_of_its_labels() -> None:
    sweep = spec.load("attacks")
    seen: dict[str, Attack | None] = {}
    for cell in cells(sweep):
        setting = setting_of(sweep, cell)
        a, b = setting.scenario.robots
        assert b.attack is None
        seen[sweep.axes[0].label(cell.place[0])] = a.attack
    assert seen.pop("honest") == Attack("scale", 1.0), "which is no lie"
    for label, attack in seen.items():
        assert attack is not None
        kind, *part, size = label.removesuffix(" deg").removesuffix(" m").split()
        assert (attack.kind, attack.part) == (kind, part[0] if part else "all")
        assert attack.size == pytest.approx(math.radians(float(size)) if "deg" in label else float(size))


@pytest.mark.long
def test_honest_missions_localise_and_attacks_are_inconsistent(results: execution.Results) -> None:
    outcomes: dict[tuple[int, ...], set[str]] = {cell.place: set() for cell in results.cells}
    places = {cell.index: cell.place for cell in results.cells}
    for row in results.table.to_pylist():
        outcomes[places[row["cell"]]].add(row["outcome"])
    assert outcomes == {(i, j): {"inconsistent" if i else "localised"} for i in range(3) for j in range(2)}


@pytest.mark.long
def test_a_figure_shows_how_often_each_attack_is_found(results: execution.Results, tmp_path: Path) -> None:
    axis_figures.draw(results, tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == {
        f"{name}-{axis}" for name in ("success", "inconsistent", "ticks") for axis in ("attack", "sigma")
    }
    found = axis_figures.points(results, 0, axis_figures.STATISTICS["inconsistent"])
    rates = [
        (line, attack, 1.0 if attack else 0.0) for line in ("0 m", "0.01 m") for attack in range(3)
    ]  # fmt: skip
    assert [(one.line, one.value, one.estimate) for one in found] == rates
    assert all(one.low < one.high for one in found), "four trials leave an interval"
