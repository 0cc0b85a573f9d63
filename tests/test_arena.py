"""The arena: planners, also those of a user, on the same missions, in one table and one figure."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

import tandem
from compose.sweep.arena import BASELINES
from tandem.baselines import NEAR, ranges_after
from tandem.planning import Controls, Pose, step
from tests.commands import refused
from tests.commands import tandem as command
from tests.series import series

MISSION = tandem.World("noisy").config("a").mission


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an arena of two planners and two scenarios."""
    out = tmp_path_factory.mktemp("arena") / "out"
    scenarios = ("--scenario", "random", "--scenario", "paper-1")
    words = (
        "assured",
        "paper",
        *scenarios,
        "--trials",
        "3",
        "--seed",
        "4",
        "--workers",
        "1",
        "--out",
        str(out),
    )
    ended = command("arena", *words)
    assert re.search(
        r"paper-1 +paper +3/3 +0 +1\.00 \(0\.44 to 1\.00\) .* 48 \(48 to 48\) +\+36\.0 ", ended.out
    )
    assert "All planners have the same missions." in ended.out
    return out


def test_an_arena_is_a_row_a_planner_and_scenario_with_intervals_and_one_figure(folder: Path) -> None:
    rows = list(csv.DictReader((folder / "arena.csv").read_text().splitlines()))
    assert [(row["scenario"], row["planner"]) for row in rows] == [
        *(("random", "assured"), ("random", "paper"), ("paper-1", "assured"), ("paper-1", "paper")),
    ]
    for row in rows:
        assert float(row["rate_low"]) <= float(row["rate"]) <= float(row["rate_high"])
        assert float(row["wrong_rate"]) == 0.0 < float(row["wrong_rate_high"])
    assert [row["pairs"] for row in rows][::2] == ["", ""]
    assert rows[3]["pairs"] == "3"
    assert {path.suffix for path in folder.glob("arena.*")} == {".csv", ".svg", ".pdf", ".png"}
    figure = (folder / "arena.svg").read_text()
    assert figure.count("<!-- random -->") == figure.count("<!-- paper-1 -->") == 1, "both are in the legend"


@pytest.mark.long
def test_python_gives_the_same_table_and_the_trials_are_those_of_each_planner_alone(folder: Path) -> None:
    table = tandem.arena(["assured", "paper"], "random", trials=3, seed=4, out=folder / "again", workers=1)
    shown = list(csv.DictReader((folder / "arena.csv").read_text().splitlines()))[:2]
    assert (table["ticks"][0], table["rate"][1]) == (float(shown[0]["ticks"]), float(shown[1]["rate"]))
    alone = tandem.sweep("random", {"planner.name": ["assured"]}, trials=3, seed=4, workers=1, audit=False)
    assert np.median(alone.trials["ticks"]) == table["ticks"][0]
    noisy = tandem.arena("assured", trials=3, workers=1)
    assert noisy["nees_low"] < noisy["nees"] < noisy["nees_high"]


def test_an_arena_of_no_missions_is_refused() -> None:
    with pytest.raises(tandem.UserError, match=r"^noisy: trials: expected a whole number >= 1$"):
        tandem.arena("assured", trials=0)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ("mine:Own",),
            "noisy: cell 0 (planners = mine:Own): planner.name: mine:Own: there is no module 'mine'",
        ),
        (("assured", "assured"), "noisy: axis[0].rows[1].label: equal to that of rows[0]"),
        (("assured", "--scenario", "noisy", "--scenario", "noisy"), "arena: two scenarios are named 'noisy'"),
        (("assured", "--scenario", "nosy"), "nosy: neither a file nor a shipped scenario"),
    ],
)
def test_a_mistake_is_one_line(words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    refused(command("arena", *words, cwd=tmp_path), says)


def test_the_error_of_a_planner_is_told_below_the_table(tmp_path: Path) -> None:
    lines = ("from tandem.planning import Assured", "class Own(Assured):", "    def observe(self, *_): 1 / 0")
    (tmp_path / "mine.py").write_text("\n".join(lines))
    words = ("--scenario", "noisy", "--trials", "1", "--workers", "1")
    ended = command("arena", "mine:Own", *words, cwd=tmp_path)
    why = "observe() at tick 0 raises ZeroDivisionError: division by zero (mine.py:3)"
    assert "noisy, mine:Own: trial 0, failed: " in " ".join(ended.out.split())
    assert why in " ".join(ended.out.split())


def test_the_derivatives_with_which_baselines_plan_are_those_of_the_ranges() -> None:
    rng = np.random.default_rng(0)
    poses, m2, ways = (
        rng.normal(size=6),
        (2.0, 0.5),
        [Controls(0.5, 0.3), Controls(-0.2, 0.1), Controls(0.9, -1.0)],
    )

    def ranges(poses: np.ndarray) -> np.ndarray:
        a, b = (
            [step(Pose(*one.tolist()), way.v, way.omega, 2.0 * MISSION.period) for way in ways]
            for one in (poses[:3], poses[3:])
        )
        return np.array(
            [[(np.hypot(p.x - q.x, p.y - q.y), np.hypot(q.x - m2[0], q.y - m2[1])) for q in b] for p in a]
        )

    slopes, beyond = ranges_after(2, ways, poses, m2, MISSION)
    moved = [(ranges(poses + 1e-6 * one) - ranges(poses - 1e-6 * one)) / 2e-6 for one in np.eye(6)]
    sigmas = (MISSION.noise.mutual_sigma, MISSION.noise.anchor_sigma)
    assert slopes == pytest.approx(np.stack(moved, -1) / np.array(sigmas)[:, None], abs=1e-6)
    assert ((beyond > 0.0) == (ranges(poses) > NEAR * MISSION.sensing_range).any(-1)).all()


@pytest.mark.long
@pytest.mark.parametrize("name", series(["fisher", "greedy", "random"]))
def test_a_baseline_is_a_planner_by_its_name_and_breaks_no_rule(name: str) -> None:
    assert name in BASELINES
    run = tandem.run("noisy", planner=name, seed=3)
    assert run.outcome == "localised"
    assert run.audit().violations == ()
    others = [tandem.run("noisy", planner=one, seed=3).commands["omega"] for one in ("assured", name)]
    assert not np.array_equal(others[0], run.commands["omega"])
    assert np.array_equal(others[1], run.commands["omega"])
