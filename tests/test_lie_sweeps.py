"""The sweep over attacks: its labels describe the false data, and its figures show the outcomes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from compose.sweep import attack_figures, axis_figures, execution, spec
from compose.sweep.cells import RefusedCell, cells, setting_of
from protocol.attack import Attack
from protocol.network.inbox import Inbox

SPEC = """
name = "few-attacks"
scenario = "random"
trials = 4
seed = 3

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
        assert not isinstance(setting, RefusedCell)
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
def test_the_figures_show_the_outcomes_of_each_attack(results: execution.Results, tmp_path: Path) -> None:
    axis_figures.draw(results, tmp_path)
    assert {f"{name}.{kind}" for name in ("attacks", "roc") for kind in ("svg", "pdf", "png")} <= {
        path.name for path in tmp_path.iterdir()
    }
    place = attack_figures.attack_axis(results)
    assert place == 0
    exact, noisy = attack_figures.outcomes(results, place).axes
    for panel in (exact, noisy):
        widths = [[bar.get_width() for bar in bars] for bars in panel.containers]
        assert np.allclose(widths, [[0.0, 1.0, 1.0], [0.0] * 3, [1.0, 0.0, 0.0], [0.0] * 3])
    roc = attack_figures.roc(results, place)
    assert roc is not None
    (panel,) = roc.axes
    assert [line.get_label() for line in panel.lines] == ["scale orbit", "rotate encounter"]
    assert all(np.all(line.get_ydata() == 1.0) for line in panel.lines), "every lie before any honest one"


@pytest.mark.long
def test_a_sweep_without_attacks_has_no_figures_of_attacks(tmp_path: Path) -> None:
    (tmp_path / "few.toml").write_text('name = "few"\nscenario = "random"\ntrials = 2\nseed = 1\n')
    progress = execution.Progress(say=lambda _: None, begin=lambda *_: None, done=lambda _: None)
    sweep = spec.load(str(tmp_path / "few.toml"))
    results = execution.sweep(
        sweep, tmp_path / "out", execution.ExecutionOptions(workers=1), Inbox("test"), progress
    )
    assert attack_figures.attack_axis(results) is None
    axis_figures.draw(results, tmp_path / "figures")
    assert not (tmp_path / "figures" / "roc.svg").exists()
