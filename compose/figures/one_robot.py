"""One robot's mission in a picture: the plane, how far off it was, and what it held possible."""

from __future__ import annotations

import textwrap
from typing import Any, Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend

from compose.figures import belief, plane
from compose.figures.story import Story
from compose.recording.summary_json import ended

Corner = Literal["upper left", "lower left", "upper right"]
WIDTH, PLANE, BESIDE = 8.6, 5.2, 2.4
"""inches: of all, of the plane and what is below it, of what stands beside these"""
NEAR, KEY, KEYS, ERROR, ODDS, REST = 2.7, 0.9, 2.2, 1.9, 1.9, 0.6
"""inches: the heights of what is close; of the keys below it, side by side, and one above the other; of the
panels over time; of the title"""
WIDE = 3.9
"""inches: a plane that is lower leaves room for the keys below it"""
OVER_TIME: list[Any] = [["error", "error key"], ["probability", "probability key"]]
RIGHT: list[Any] = [["plane", "near"], ["plane", "key"], *OVER_TIME]
BELOW: list[Any] = [["plane", "near"], ["key", "key"], *OVER_TIME]
LINE = 100
"""characters of the title"""


def figure_of(story: Story) -> Figure:
    """The panels at the left, and at their right what is close, and what the signs mean."""
    left, right, low, high = plane.window(story)
    tall = min(PLANE * (high - low) / (right - left), PLANE)
    if tall < WIDE:
        layout, heights = BELOW, [max(tall, NEAR), KEY, ERROR, ODDS]
    else:
        layout, heights = RIGHT, [NEAR, max(tall, NEAR + KEYS) - NEAR, ERROR, ODDS]
    figure = Figure(figsize=(WIDTH, sum(heights) + REST), layout="constrained")
    panels = figure.subplot_mosaic(layout, height_ratios=heights, width_ratios=[PLANE, BESIDE])
    for key in ("key", "error key", "probability key"):
        panels[key].set_axis_off()
    plane.draw(panels["plane"], story)
    plane.draw_near(panels["near"], story)
    belief.draw_error(panels["error"], story)
    belief.draw_probability(panels["probability"], story)
    columns = 1 if layout is RIGHT else 3
    signs = key_of(panels["key"], panels["plane"], "upper left", columns)
    if story.likeliest:
        panels["key"].add_artist(signs)
        corner: Corner = "lower left" if layout is RIGHT else "upper right"
        key_of(panels["key"], panels["near"], corner, 3, title="closer, by tick")
    key_of(panels["error key"], panels["error"], "upper left")
    key_of(panels["probability key"], panels["probability"], "upper left")
    figure.suptitle(_title(story), x=0.012, ha="left", fontsize=9.5)
    return figure


def key_of(beside: Axes, panel: Axes, corner: Corner, columns: int = 1, title: str | None = None) -> Legend:
    """What the signs in `panel` mean, `beside` it, where it hides nothing."""
    handles, labels = panel.get_legend_handles_labels()
    legend: Legend = beside.legend(
        handles,
        labels,
        loc=corner,
        title=title,
        title_fontsize=8,
        alignment="left",
        ncols=columns,
        handlelength=1.0 if title else 1.8,
        columnspacing=0.9,
        labelspacing=0.35,
        frameon=False,
        fontsize=8,
        borderaxespad=0.0,
    )
    return legend


def _title(story: Story) -> str:
    """Who it is, how the mission ended, and what the robot says at its end."""
    recording, claim = story.recording, story.claim
    end = (
        "the record breaks off"
        if recording.end is None
        else ended(recording.end.outcome, story.last, recording.end.reason)
    )
    lines = [f"Robot {story.own.id} of {recording.scenario.name}, seed {recording.scenario.seed}: {end}"]
    if claim is None:
        lines.append("It never claimed to know where it is.")
    else:
        off = f"off by {claim.position_error:.2g} m and {claim.heading_error:.2g} rad"
        sigma = claim.covariance
        said = f" (sigmas {sigma.position_sigma:.2g} m and {sigma.heading_sigma:.2g} rad)" if sigma else ""
        lines.append(f"It claims to know its pose in tick {claim.tick}: {off}{said}.")
    return "\n".join([part for line in lines for part in textwrap.wrap(line, LINE)])
