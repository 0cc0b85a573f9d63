"""The scripts in docs/ run; the examples run, are short, and are listed on the page of the Python API."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from PIL import Image, ImageSequence

import tandem
from docs import film, measured, peer_tables, peers, picture, rendezvous
from tests.series import series

ROOT = Path(__file__).parents[1]
IMAGE = re.compile(r"!\[[^]]*\]\((?:docs/)?([^)]+)\)")


def test_no_figure_of_the_documentation_is_stale() -> None:
    assert not list(picture.stale(quick=True)), "uv run docs/picture.py FIGURE draws them again"


@pytest.mark.long("slow")
def test_no_figure_of_a_sweep_or_an_estimate_is_stale() -> None:
    assert not list(picture.stale())


def test_the_animation_of_the_readme_is_small_and_lasts_as_long_as_guided_play() -> None:
    path = ROOT / "docs" / "page.gif"
    assert path.stat().st_size < 700_000
    with Image.open(path) as animation:
        assert animation.size == (film.WIDTH, film.HEIGHT)
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(animation)]
    assert 40_000 < sum(durations) < 60_000
    assert len(durations) > 30


def test_one_command_draws_every_figure_of_the_documentation() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    shown = {name for page in pages for name in IMAGE.findall(page.read_text("utf-8"))}
    files = {path.name for path in (ROOT / "docs").iterdir() if path.suffix in (".svg", ".png", ".gif")}
    assert sorted(picture.names_of_figures()) == sorted(shown) == sorted(files)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda made: made["noisy-a.svg"].update(file="0"), "the file is not the one"),
        (lambda made: made.pop("noisy-a.svg"), "the file is not the one"),
        (lambda made: made["noisy-a.svg"].update(code="0"), "the code that draws it"),
        (
            lambda made: made["noisy-a.svg"].update(decided="0", environment=picture.here()),
            "the missions that it shows decide otherwise",
        ),
        (lambda made: made["noisy-a.svg"].update(decided="0", environment="another"), None),
    ],
    ids=["file", "new", "code", "decisions", "decisions of another processor"],
)
def test_a_figure_is_stale_if_what_it_was_made_of_has_changed(
    change: Callable[[dict[str, Any]], object], reason: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = picture.recorded()
    change(made)
    monkeypatch.setattr(picture, "recorded", lambda: made)
    monkeypatch.setattr(picture, "SOURCES", [one for one in picture.SOURCES if "noisy-a.svg" in one.figures])
    lines = [line for line in picture.stale(quick=True) if line.startswith("noisy-a.svg: ")]
    assert len(lines) == (reason is not None)
    assert not lines or (reason or "") in lines[0]


def test_the_comparison_with_other_estimators_is_that_of_its_code() -> None:
    assert peer_tables.results().code == peer_tables.code_hash(), "uv run docs/peers.py measures it again"


@pytest.mark.long
def test_a_window_of_the_comparison_measures_what_the_pages_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    source, raw = peers.unpacked(tmp_path)
    few = ("gtsam LM, true start", "gtsam LM Huber, one random start", "EKF, the likeliest of 4 096")
    trials = (one for one in peer_tables.results().trials if one.recording == "TIERS")
    shown = {(one.ranges, one.window, one.estimator): one for one in trials}
    for window in (one for one in peers.tiers_windows(source) if one.name == "A B 0"):
        for now in peers.tried(window, raw, few):
            then = shown[now.ranges, now.window, now.estimator]
            stale = f"{now} is not {then}: uv run docs/peers.py"
            if now.estimator in (peer_tables.TANDEM, few[0]):
                assert now.errors_m == pytest.approx(then.errors_m, abs=0.01), stale
                assert now.claims == then.claims, stale
            if now.estimator == few[1]:  # one start, which does not lead to the truth
                assert max(one or 9.0 for one in now.errors_m) > 1.0, stale


def test_every_number_of_the_results_is_of_a_measurement_whose_command_and_code_are_recorded() -> None:
    assert not [*measured.unrecorded(measured.recorded())]


def test_a_number_that_changes_without_a_measurement_is_stale(tmp_path: Path) -> None:
    page = "# Results\n\nAll 10 robots are\nlocalised.\n\n- It takes `x=3` [3 s](there.md#3) or longer.\n"
    (only,) = measured.paragraphs(page)
    known = measured.Statement(
        "results.md", "All 10 robots", "tandem sweep ten", "0000000", measured.hashed(only)
    )

    def problems(before: str, after: str) -> list[str]:
        (tmp_path / "results.md").write_text(page.replace(before, after))
        return [*measured.unrecorded([known], tmp_path)]

    assert not problems("", "")
    assert not problems("are\nlocalised", "are localised")
    (changed,) = problems("localised", "localised in 3 ticks")
    assert changed.endswith("'All 10 robots' has changed: measure it by `tandem sweep ten`, then use --again")
    (added,) = problems("or longer", "or 4 s")
    assert added.startswith("results.md: no command measures '- It takes")
    (gone, unknown) = problems("All 10", "All 11")
    assert gone == "results.md: no paragraph begins with 'All 10 robots'"
    assert unknown.startswith("results.md: no command measures 'All 11 robots are")


def test_a_measurement_says_how_often_the_deciding_code_has_changed_since(tmp_path: Path) -> None:
    def git(*words: str) -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        return subprocess.run(
            ["git", *who, *words], cwd=tmp_path, capture_output=True, text=True, check=True
        ).stdout.strip()

    git("init", "-q")
    for path in ("agent", "compose"):
        (tmp_path / path).mkdir()
        (tmp_path / path / "a.py").write_text("")
    git("add", ".")
    git("commit", "-qm", "Begin")
    commit = git("rev-parse", "HEAD")
    for path, changes in (("compose", "of today's code"), ("agent", "commits since: 1")):
        (tmp_path / path / "a.py").write_text("1")
        git("commit", "-qam", "Change")
        line = measured.age(measured.Statement("results.md", "All", "tandem sweep ten", commit, ""), tmp_path)
        assert line == f"results.md: All...: {commit}, {changes}; `tandem sweep ten`"
    assert measured.changes_since("f" * 40, tmp_path) is None


@pytest.mark.long
def test_the_figures_of_the_rendezvous_are_printed_a_line_a_setting(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendezvous, "SETTINGS", [rendezvous.SECTION_IV])
    rendezvous.main(90, 25)
    heading, line = capsys.readouterr().out.splitlines()
    assert heading.split()[0] == "D,"
    setting, _, figures = line.partition("3.14 ")
    assert setting.split() == ["10,", "3,", "1,", "1,"]
    bound, mean, worst, paper_mean, paper_worst, *_ = (
        float(word) for word in figures.replace("/", " ").split()
    )
    assert worst <= bound
    assert mean <= 0.6 * paper_mean
    assert worst <= 0.6 * paper_worst


EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
SMALL: dict[str, dict[str, Any]] = {
    "run_and_plot": {},
    "loss_sweep": {"trials": 1, "workers": 1},
    "planners_and_radios": {"trials": 1, "workers": 1},
    "estimate_ranges": {},
}
"""The arguments with which `main` of each example takes seconds."""
WITHOUT_FIGURE = (
    "environment",
    "group_planner",
    "gtsam_solver",
    "last_manoeuvre",
    "own_driver",
    "own_radio",
    "seek",
)
"""The examples that only print."""
MAX_LINES = 120
"""The bound on the lines of an example: a factor graph takes the most."""


def test_every_example_is_run_and_listed() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*SMALL, *WITHOUT_FIGURE}
    page = (EXAMPLES.parent / "python-api.md").read_text()
    for name in (*SMALL, *WITHOUT_FIGURE):
        assert f"`docs/examples/{name}.py`" in page


@pytest.mark.parametrize("name", series(SMALL))
def test_an_example_runs_and_writes_its_figure(name: str, tmp_path: Path) -> None:
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) < MAX_LINES
    import_module(f"docs.examples.{name}").main(str(tmp_path / "figure.png"), **SMALL[name])
    assert (tmp_path / "figure.png").stat().st_size > 1000


@pytest.mark.long
@pytest.mark.timeout(600)
def test_the_planner_of_the_page_runs_in_the_arena_as_the_page_shows(tmp_path: Path) -> None:
    page = (EXAMPLES.parent / "own-planner.md").read_text()
    code = page.partition("```python\n")[2].partition("```")[0]
    (tmp_path / "mine.py").write_text(code)
    assert len(code.splitlines()) <= 40
    words = ("-m", "tandem", "arena", "assured", "mine:Circling", "--trials", "10")
    ended = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    shown = [line for line in page.splitlines() if line.startswith((" scenario", " noisy"))]
    own, shown = shown[3:], shown[:3]
    assert [line for line in ended.stdout.splitlines() if line in shown] == shown
    few = tandem.arena(("assured", "greedy"), trials=10)
    low, high = re.findall(r"\(([+-][\d.]+) to ([+-][\d.]+)\)", own[-1])[0]
    assert few["more_ticks_low"][1] <= float(high), "the first of 200 trials do not contradict them"
    assert float(low) <= few["more_ticks_high"][1]


@pytest.mark.parametrize("name", WITHOUT_FIGURE)
@pytest.mark.long
def test_an_example_without_a_figure_runs(name: str) -> None:
    if name == "gtsam_solver":
        pytest.importorskip("gtsam", reason="gtsam has no wheel for this platform or this Python")
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) < MAX_LINES
    import_module(f"docs.examples.{name}").main()


@pytest.mark.long
def test_the_notebook_runs_from_its_first_cell_to_its_last() -> None:
    notebook = json.loads((EXAMPLES / "tandem.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    code = "\n".join([*cells, "print(hasty.outcome, lossy.name)"])
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "localised random\n"
    assert "`docs/examples/tandem.ipynb`" in (EXAMPLES.parent / "python-api.md").read_text()
