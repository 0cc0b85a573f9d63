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

from tests.series import series

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
SMALL: dict[str, dict[str, Any]] = {
    "run_and_plot": {},
    "loss_sweep": {"trials": 1, "workers": 1},
    "greedy_planner": {"trials": 1, "workers": 1},
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


INTERVAL = re.compile(
    r"(?P<what>[^:\n]+): .*?[+-][\d.]+ ticks \((?P<low>[+-][\d.]+) to (?P<high>[+-][\d.]+)\)"
)
"""The line of a difference with its interval, as examples print it and pages show it."""


@pytest.mark.long
@pytest.mark.timeout(600)
def test_figures_that_a_page_shows_agree_with_what_fewer_trials_print(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The 200 trials of the page take minutes; the first 10 of the same trials must not contradict them."""
    page = (EXAMPLES.parent / "own-planner.md").read_text()
    shown = page.partition("<!-- printed by: greedy_planner -->")[2]
    import_module("docs.examples.greedy_planner").main(str(tmp_path / "figure.png"), trials=10)
    printed = capsys.readouterr().out
    few, many = ({one["what"]: one for one in INTERVAL.finditer(text)} for text in (printed, shown))
    assert {*few} == {*many} == {"greedy - assured"}
    one, other = few["greedy - assured"], many["greedy - assured"]
    assert float(one["low"]) <= float(other["high"])
    assert float(other["low"]) <= float(one["high"])
    assert printed.splitlines()[-1] == shown.partition("\n```\n")[0].splitlines()[-1]


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
