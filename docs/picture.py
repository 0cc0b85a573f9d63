"""Draw the figures and the film of single missions in the documentation again: `uv run docs/picture.py`."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from compose.figures import PICTURES, catalogue
from compose.figures.agent_replay import agent_replay
from compose.figures.pair import pairs_of
from compose.figures.sheet import Absent
from compose.figures.style import SCREEN, look, save
from compose.launch import in_process
from compose.recording.run import read
from compose.scenario import scenario_file
from compose.view.web import film
from compose.view.web.standalone import standalone_page

DOCS = Path(__file__).parent
SHOWN: dict[str, dict[str, str]] = {
    "paper-1": {
        "trajectory-a-b": "paper-1",
        "phase-1-a": "paper-1-phase-1",
        "plan-b-47": "paper-1-plan",
        "encounter-a-b": "paper-1-encounter",
        "ranges-a-b": "paper-1-ranges",
    },
    "paper-2": {
        "trajectory-a-b": "paper-2",
        "plan-b-109": "paper-2-plan",
        "encounter-a-b": "paper-2-encounter",
    },
    "noisy": {"plan-a-b": "noisy-plan", "robot-a": "noisy-a"},
    "group-8": {"meetings": "group-8"},
}
"""By scenario: the titles of the figures of `tandem figures` that pages show, and their file names here."""

FILMED = "paper-1"
"""The scenario whose guided play is page.gif, and of which page.png is one picture."""
STILL = ("distance that a configuration predicts", (1360, 840))
"""The mark of the legend that page.png shows, and its size in pixels."""


def main() -> None:
    """Draw the figures that `tandem run SCENARIO --out DIR` and `tandem figures DIR --format svg` write."""
    for name, shown in SHOWN.items():
        with tempfile.TemporaryDirectory() as folder:
            draw(name, shown, Path(folder))
            if name == FILMED:
                page = standalone_page(Path(folder)).html
                (DOCS / "page.gif").write_bytes(film.gif(page, film.browser("page.gif")))
                (DOCS / "page.png").write_bytes(film.still(page, film.browser("page.png"), *STILL))


def draw(name: str, shown: Mapping[str, str], folder: Path) -> None:
    """Run the scenario in `folder`, and copy those of its figures to docs/ that `shown` names."""
    in_process.run_mission(scenario_file.load(name), folder)
    run = read(folder)
    pair = next(pairs_of(run, {robot: agent_replay(run, robot) for robot in run.robots}))
    for kind in PICTURES:
        with look(SCREEN):
            for title, figure in catalogue.pictures(pair, kind):
                if title in shown and not isinstance(figure, Absent):
                    (svg,) = save(figure, folder / title, ["svg"])
                    shutil.copyfile(svg, DOCS / f"{shown[title]}.svg")


if __name__ == "__main__":
    main()
