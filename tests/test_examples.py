"""The examples in docs/examples run, are short, and are listed on the page of the Python API."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
SMALL: dict[str, dict[str, Any]] = {"run_and_plot": {}, "loss_sweep": {"trials": 1, "workers": 1}}
"""The arguments with which `main` of each example takes seconds."""
MAX_LINES = 100


def test_every_example_is_run_and_listed() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == SMALL.keys()
    page = (EXAMPLES.parent / "python-api.md").read_text()
    for name in SMALL:
        assert f"`docs/examples/{name}.py`" in page


@pytest.mark.parametrize("name", SMALL)
def test_an_example_runs_and_writes_its_figure(name: str, tmp_path: Path) -> None:
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) < MAX_LINES
    import_module(f"docs.examples.{name}").main(str(tmp_path / "figure.png"), **SMALL[name])
    assert (tmp_path / "figure.png").stat().st_size > 1000
