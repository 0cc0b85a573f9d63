"""The examples in docs/examples run, are short, and are listed on the page of the Python API."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import tandem
from tests.series import series

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
