"""Draws two of the README's pictures: `uv run docs/picture.py`."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from compose import inline, scenario
from compose.figures.robot import Story, draw
from compose.figures.style import COLOURS, look
from compose.record import Record, estimates

PAPER = Path(__file__).with_name("paper-1.svg")
NOISY = Path(__file__).with_name("noisy-a.svg")


def main() -> None:
    """The paper's first simulation, and a robot's mission under noise."""
    with look():
        draw_paper()
    draw_noisy()


def draw_noisy() -> None:
    """What `tandem run noisy --out DIR` and `tandem figures DIR` leave in DIR/figures/robot-a.svg."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record = inline.play(scenario.load("noisy"), folder)
        svg, _ = draw(Story(record, 0, estimates(folder, "a")), folder / "figures")
        shutil.copyfile(svg, NOISY)


def draw_paper() -> None:
    """As Fig. 3(a) shows it."""
    figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    record = inline.play(scenario.load("paper-1"))
    draw_anchors(axes, record)
    draw_robots(axes, record)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False)
    figure.savefig(PAPER, metadata={"Date": None})


def draw_anchors(axes: Axes, record: Record) -> None:
    """Each anchor, its sensing range and the orbit about it."""
    for robot in record.scenario.robots:
        colour, place = COLOURS[robot.role], (robot.anchor.x, robot.anchor.y)
        orbit = robot.rendezvous.a if robot.role == "a" else robot.rendezvous.b
        axes.plot(*place, "k+", markersize=10)
        name = "$M_1$" if robot.role == "a" else "$M_2$"
        axes.annotate(name, place, xytext=(5, 5), textcoords="offset points", parse_math=True)
        axes.add_patch(
            Circle(place, record.scenario.mission.sensing_range, fill=False, ls="--", lw=0.8, color="0.4")
        )
        axes.add_patch(Circle(place, orbit.radius, fill=False, ls="--", lw=0.8, color=colour, alpha=0.6))


def draw_robots(axes: Axes, record: Record) -> None:
    """Each robot's true path, where it was released, and where the two find out where they are."""
    for i, robot in enumerate(record.scenario.robots):
        path = [moment.truth.poses[i] for moment in record.moments]
        colour = COLOURS[robot.role]
        axes.plot(
            [p.x for p in path], [p.y for p in path], "-o", ms=2.5, lw=1.2, color=colour, label=robot.id
        )
        axes.plot(path[0].x, path[0].y, "s", ms=7, mfc="white", mec=colour, mew=1.5)
        axes.plot(path[-1].x, path[-1].y, "*", ms=12, color=colour)
    ends = [record.moments[-1].truth.poses[i] for i in range(2)]
    axes.plot([p.x for p in ends], [p.y for p in ends], ":", color="0.2", lw=1.2)
    axes.plot([], [], "s", mfc="white", mec="0.2", label="released")
    axes.plot([], [], "*", color="0.2", ms=10, label="both know where they are")


if __name__ == "__main__":
    main()
