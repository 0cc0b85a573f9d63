"""What a robot held for true, over time: how far off its likeliest pose was, and how likely it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from compose.figures.plane import AGES, GHOST, SIGMAS, name_of_others
from compose.figures.story import Story, error
from compose.figures.timeline import name_phases, over_time
from protocol.rounding import TOLERANCE

LEAST = 1e-16
"""m: what an error is drawn as that is less"""
RANKS = 6
"""hypotheses of which each has a line"""
BEYOND = 0.05
"""of the doubt that is allowed: how far the scale of probability goes"""
SUREST = 1e-12
"""the least doubt on that scale"""
SHORT = 20.0
"""the largest value on a scale over its smallest, where powers of ten are too few to name"""
DENSE = 30
"""ticks of a phase, too many to mark each"""


def draw_error(axes: Axes, story: Story) -> None:
    """The likeliest pose's error, and what is claimed of it."""
    over_time(axes, story)
    name_phases(axes, story)
    axes.set_yscale("log")
    name = "at first: of its distance\nto its anchor"
    distances = _distance_errors(story)
    marked = _marked(story, [tick for tick, _ in distances])
    _plot(axes, distances, "-o", ms=1.5, markevery=marked, color="0.45", gid="error-of-distance", label=name)
    others = [(one.tick, error(pose, truth)) for one, truth in story.placed for pose in story.others(one)]
    name = name_of_others(story)
    _plot(axes, others, "x", ms=3.5, mew=0.8, color=GHOST, gid="errors-of-others", label=name)
    sigmas = [
        (one.tick, one.covariance.position_sigma) for one, _ in story.likeliest if one.covariance is not None
    ]
    _plot(axes, sigmas, "--", color=AGES(0.6), gid="sigma", label="sigma, as claimed")
    errors = [(one.tick, error(one.world[0], truth)) for one, truth in story.likeliest]
    marked = _marked(story, [tick for tick, _ in errors])
    name = "of its likeliest pose" if story.weighed else "of its pose"
    _plot(axes, errors, "-D", ms=3, markevery=marked, color=AGES(1.0), gid="error", label=name)
    if story.exact:
        limit, gid, name = TOLERANCE, "tolerance", "wrong, if more: 1e-6 m"
    else:
        limit = story.recording.scenario.mission.accuracy
        gid, name = "accuracy", f"sigma asked for: {limit:g} m"
    if not distances and not story.placed:  # there is nothing to fit but the limit
        axes.set_ylim(limit / 10.0, limit * 10.0)
    axes.axhline(limit, color="k", lw=0.9, ls="-.", gid=gid, label=name)
    _envelope(axes, sigmas)
    _in_metres(axes)


def _in_metres(axes: Axes) -> None:
    low, high = axes.get_ylim()
    named = (1.0, 2.0, 5.0) if high < SHORT * low else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=named, numticks=6))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}".replace("e-0", "e-")))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("")
    axes.set_ylabel("error of position [m]")


def _plot(axes: Axes, points: Sequence[tuple[int, float]], style: str, **look: Any) -> None:
    """Nothing, where there are none."""
    if points:
        ticks, values = zip(*points, strict=True)
        axes.plot(ticks, np.maximum(values, LEAST), style, **{"lw": 1.2, **look})


def _distance_errors(story: Story) -> list[tuple[int, float]]:
    """All that can be off before the two have met: until then any rotation about the anchor is possible."""
    anchor = story.own.anchor
    return [
        (
            one.tick,
            abs(
                math.hypot(one.local[0].x, one.local[0].y)
                - math.hypot(truth.x - anchor.x, truth.y - anchor.y)
            ),
        )
        for one, truth in story.estimates
        if one.local and not one.world
    ]


def _envelope(axes: Axes, sigmas: Sequence[tuple[int, float]]) -> None:
    """What should hold the error, if sigma is true; down to the end of the scale, on which there is no 0."""
    if not sigmas:
        return
    ticks, values = np.array(sigmas).T
    _plot(axes, [(tick, SIGMAS * sigma) for tick, sigma in sigmas], "-", lw=0.6, color=AGES(0.25))
    low, high = axes.get_ylim()
    axes.fill_between(
        ticks, low, np.maximum(SIGMAS * values, low), color=AGES(0.25), alpha=0.35, lw=0, zorder=0,
        gid="envelope", label="within 3 sigma, as claimed",
    )  # fmt: skip
    axes.set_ylim(low, high)


def draw_probability(axes: Axes, story: Story) -> None:
    """How likely each hypothesis was; or how many poses were possible, where none is likelier."""
    over_time(axes, story)
    if story.weighed:
        _draw_probability(axes, story)
    else:
        _draw_count(axes, story)
    placed = next((one.tick for one, _ in story.placed), None)
    words: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 8, "color": "0.3"}
    axes.text(0.0, 1.05, "of where its anchor is", **words)
    if placed is not None:
        axes.axvline(placed, color="0.3", lw=0.8, ls=":", gid="placed")
        axes.text(1.0, 1.05, f"from tick {placed}: of how both lie in the plane", ha="right", **words)


def _draw_probability(axes: Axes, story: Story) -> None:
    """On a scale on which 99.99 % is as far from 99 % as that from evens."""
    confidence = story.recording.scenario.mission.confidence
    edge = max(SUREST, BEYOND * (1.0 - confidence))
    axes.set_yscale("logit")
    for rank in reversed(range(RANKS)):
        for placed in (False, True):
            _odds_of(axes, story, rank, placed, edge)
    axes.plot([], [], "-D", ms=3, lw=1.4, color=AGES(1.0), label="the likeliest hypothesis")
    if any(len(one.probabilities) > 1 for one, _ in story.estimates):
        axes.plot([], [], "-x", ms=3, lw=0.8, color=GHOST, label=name_of_others(story))
    axes.axhline(
        confidence, color="k", lw=0.9, ls="-.", gid="confidence", label=f"asked for: {percent(confidence)}"
    )
    doubts = [10.0**-k for k in range(2, 13, 2) if 10.0**-k > edge]
    ticks = [*doubts[::-1], 0.5, *[1.0 - doubt for doubt in doubts]]
    axes.set_yticks([edge, *ticks, 1.0 - edge], ["less", *map(percent, ticks), "more"])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(edge, 1.0 - edge)
    axes.set_ylabel("probability of a hypothesis")


def _odds_of(axes: Axes, story: Story, rank: int, placed: bool, edge: float) -> None:
    """Those of the hypothesis that is so likely, before or after they are about the plane."""
    points = [
        (
            one.tick,
            min(max(one.probabilities[rank], edge), 1.0 - edge)
            if rank < len(one.probabilities)
            else math.nan,
        )
        for one, _ in story.estimates
        if bool(one.world) == placed
    ]
    if all(math.isnan(probability) for _, probability in points):
        return
    ticks, probability = zip(*points, strict=True)
    gid = f"probability-{rank + 1}-{'plane' if placed else 'anchor'}"
    if rank:
        axes.plot(ticks, probability, "-x", ms=3, mew=0.8, lw=0.8, color=GHOST, gid=gid)
    else:
        marked = _marked(story, ticks)
        axes.plot(
            ticks,
            probability,
            "-D",
            ms=3,
            lw=1.4,
            color=AGES(1.0),
            gid=gid,
            markevery=marked,
            clip_on=False,
            zorder=4,
        )


def _marked(story: Story, ticks: Sequence[int]) -> list[int]:
    """The places of those that have room to be marked each."""
    sparse: set[int] = set()
    for span in story.phases:
        if span.last - span.first < DENSE:
            sparse.update(range(span.first, span.last + 1))
    return [i for i, tick in enumerate(ticks) if tick in sparse]


def percent(probability: float) -> str:
    """In as many digits as tell it from certainty."""
    return f"{round(100.0 * probability, 10):.12g} %"


def _draw_count(axes: Axes, story: Story) -> None:
    """Before there are some to be counted, it may be anywhere on a circle."""
    counts = [(one.tick, len(one.world or one.local) or math.nan) for one, _ in story.estimates]
    if counts:
        ticks, held = zip(*counts, strict=True)
        axes.plot(
            ticks, held, "-D", ms=3, lw=1.2, drawstyle="steps-post", color=AGES(1.0), gid="count",
            markevery=_marked(story, ticks), label="poses held possible",
        )  # fmt: skip
    axes.axhline(1.0, color="k", lw=0.9, ls="-.", label="one is left")
    axes.set_ylim(0.0, 1.0 + max([len(one.world or one.local) for one, _ in story.estimates], default=1))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axes.set_ylabel("poses held possible")
