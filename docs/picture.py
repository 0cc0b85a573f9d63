"""Draws the pictures of single missions in README and on the pages: `uv run docs/picture.py`."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from compose.figures import PICTURES, catalogue
from compose.figures.account import account
from compose.figures.pair import of_record
from compose.figures.sheet import Absent
from compose.figures.style import save
from compose.launch import in_process
from compose.scenario import scenario_file

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
}
"""by scenario: of the pictures that `tandem figures` makes, those that are shown, and their names here"""


def main() -> None:
    """What `tandem run SCENARIO --out DIR` and `tandem figures DIR --format svg` leave in DIR/figures."""
    for name, shown in SHOWN.items():
        with tempfile.TemporaryDirectory() as folder:
            draw(name, shown, Path(folder))


def draw(name: str, shown: Mapping[str, str], folder: Path) -> None:
    """Play the scenario, and take those pictures of it that are `shown`."""
    recording = in_process.play(scenario_file.load(name), folder)
    robots = [robot.id for robot in recording.scenario.robots]
    pair = of_record(recording, (0, 1), {robot: account(folder, robot) for robot in robots})
    for kind in PICTURES:
        with catalogue.settings(kind):
            for title, figure in catalogue.pictures(pair, kind):
                if title in shown and not isinstance(figure, Absent):
                    (svg,) = save(figure, folder / title, ["svg"])
                    shutil.copyfile(svg, DOCS / f"{shown[title]}.svg")


if __name__ == "__main__":
    main()
