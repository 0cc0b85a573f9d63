"""The figure of one robot's mission: the plane, the position error, and the hypotheses."""

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
"""The widths of the figure, of its left column, and of its right column, in inches."""
NEAR, KEY, KEYS, ERROR, PROBABILITY, REST = 2.7, 0.9, 2.2, 1.9, 1.9, 0.6
"""Heights in inches.

NEAR is the enlarged panel, KEY and KEYS the keys in one row and in one column, ERROR and PROBABILITY the
panels over time, and REST the title.
"""
WIDE = 3.9
"""The height of the plane, in inches, below which the keys are placed below it."""
OVER_TIME: list[Any] = [["error", "error key"], ["probability", "probability key"]]
RIGHT: list[Any] = [["plane", "near"], ["plane", "key"], *OVER_TIME]
BELOW: list[Any] = [["plane", "near"], ["key", "key"], *OVER_TIME]
LINE = 100
"""The maximum length of a title line, in characters."""


def figure_of(story: Story) -> Figure:
    """Return the figure: panels in the left column, the enlarged panel and the keys in the right column."""
    left, right, low, high = plane.window(story)
    tall = min(PLANE * (high - low) / (right - left), PLANE)
    if tall < WIDE:
        layout, heights = BELOW, [max(tall, NEAR), KEY, ERROR, PROBABILITY]
    else:
        layout, heights = RIGHT, [NEAR, max(tall, NEAR + KEYS) - NEAR, ERROR, PROBABILITY]
    figure = Figure(figsize=(WIDTH, sum(heights) + REST), layout="constrained")
    panels = figure.subplot_mosaic(layout, height_ratios=heights, width_ratios=[PLANE, BESIDE])
    for key in ("key", "error key", "probability key"):
        panels[key].set_axis_off()
    plane.draw(panels["plane"], story)
    plane.draw_near(panels["near"], story)
    belief.draw_error(panels["error"], story)
    belief.draw_probability(panels["probability"], story)
    columns = 1 if layout is RIGHT else 3
    legend = key_of(panels["key"], panels["plane"], "upper left", columns)
    if story.likeliest:
        panels["key"].add_artist(legend)
        corner: Corner = "lower left" if layout is RIGHT else "upper right"
        key_of(panels["key"], panels["near"], corner, 3, title="estimates, by tick")
    key_of(panels["error key"], panels["error"], "upper left")
    key_of(panels["probability key"], panels["probability"], "upper left")
    figure.suptitle(_title(story), x=0.012, ha="left", fontsize=9.5)
    return figure


def key_of(beside: Axes, panel: Axes, corner: Corner, columns: int = 1, title: str | None = None) -> Legend:
    """Draw the legend of `panel` in the empty axes `beside` it, and return it."""
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
    """Return the title: the robot, the outcome of the mission, and the robot's claim."""
    recording, claim = story.recording, story.claim
    end = (
        "the recording breaks off"
        if recording.end is None
        else ended(recording.end.outcome, story.last, recording.end.reason)
    )
    lines = [f"Robot {story.own.id} of {recording.scenario.name}, seed {recording.scenario.seed}: {end}"]
    if claim is None:
        lines.append("The robot claims no pose.")
    else:
        errors = f"errors {claim.position_error:.2g} m and {claim.heading_error:.2g} rad"
        sigma = claim.covariance
        sigmas = f" (sigmas {sigma.position_sigma:.2g} m and {sigma.heading_sigma:.2g} rad)" if sigma else ""
        lines.append(f"The robot claims its pose in tick {claim.tick}: {errors}{sigmas}.")
    return "\n".join([part for line in lines for part in textwrap.wrap(line, LINE)])
