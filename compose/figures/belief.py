"""A robot's belief over time: the error and the probability of its most probable pose."""

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
"""The smallest error drawn, in m. Smaller errors are drawn at this value."""
RANKS = 6
"""The number of hypotheses drawn as lines."""
BEYOND = 0.05
"""The end of the probability scale, as a fraction of 1 - confidence."""
SUREST = 1e-12
"""The smallest distance of the probability scale's ends from 0 and 1."""
SHORT = 20.0
"""The ratio of a logarithmic scale's ends below which powers of ten give too few tick labels."""
DENSE = 30
"""The number of ticks in a phase from which on single ticks get no marker."""


def draw_error(axes: Axes, story: Story) -> None:
    """Draw the position error of the most probable pose, with its claimed sigma."""
    over_time(axes, story)
    name_phases(axes, story)
    axes.set_yscale("log")
    name = "error of the anchor distance,\nbefore the encounter"
    distances = _distance_errors(story)
    marked = _marked(story, [tick for tick, _ in distances])
    _plot(axes, distances, "-o", ms=1.5, markevery=marked, color="0.45", gid="error-of-distance", label=name)
    others = [(one.tick, error(pose, truth)) for one, truth in story.placed for pose in story.others(one)]
    name = name_of_others(story)
    _plot(axes, others, "x", ms=3.5, mew=0.8, color=GHOST, gid="errors-of-others", label=name)
    sigmas = [
        (one.tick, one.covariance.position_sigma) for one, _ in story.likeliest if one.covariance is not None
    ]
    _plot(axes, sigmas, "--", color=AGES(0.6), gid="sigma", label="claimed sigma")
    errors = [(one.tick, error(one.world[0], truth)) for one, truth in story.likeliest]
    marked = _marked(story, [tick for tick, _ in errors])
    name = "error, most probable pose" if story.weighed else "error"
    _plot(axes, errors, "-D", ms=3, markevery=marked, color=AGES(1.0), gid="error", label=name)
    if story.exact:
        limit, gid, name = TOLERANCE, "tolerance", "tolerance: 1e-6 m"
    else:
        limit = story.recording.scenario.mission.accuracy
        gid, name = "accuracy", f"required sigma: {limit:g} m"
    if not distances and not story.placed:  # the axis can only be scaled to the limit
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
    axes.set_ylabel("position error [m]")


def _plot(axes: Axes, points: Sequence[tuple[int, float]], style: str, **look: Any) -> None:
    """Plot `points`, (tick, value) pairs, if there are any."""
    if points:
        ticks, values = zip(*points, strict=True)
        axes.plot(ticks, np.maximum(values, LEAST), style, **{"lw": 1.2, **look})


def _distance_errors(story: Story) -> list[tuple[int, float]]:
    """Return the errors of the distance to the anchor, in m, as (tick, error) pairs before the encounter.

    Until the encounter any rotation about the anchor is possible, so no other position error is defined.
    """
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
    """Shade the errors within the claimed 3 sigma, down to the end of the logarithmic scale."""
    if not sigmas:
        return
    ticks, values = np.array(sigmas).T
    _plot(axes, [(tick, SIGMAS * sigma) for tick, sigma in sigmas], "-", lw=0.6, color=AGES(0.25))
    low, high = axes.get_ylim()
    axes.fill_between(
        ticks, low, np.maximum(SIGMAS * values, low), color=AGES(0.25), alpha=0.35, lw=0, zorder=0,
        gid="envelope", label="claimed 3 sigma",
    )  # fmt: skip
    axes.set_ylim(low, high)


def draw_probability(axes: Axes, story: Story) -> None:
    """Draw the probability of each hypothesis, or, with exact sensors, the number of possible poses."""
    over_time(axes, story)
    if story.weighed:
        _draw_probability(axes, story)
    else:
        _draw_count(axes, story)
    placed = next((one.tick for one, _ in story.placed), None)
    words: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 8, "color": "0.3"}
    axes.text(0.0, 1.05, "branches in the anchor's frame", **words)
    if placed is not None:
        axes.axvline(placed, color="0.3", lw=0.8, ls=":", gid="placed")
        axes.text(1.0, 1.05, f"from tick {placed}: placements of the pair", ha="right", **words)


def _draw_probability(axes: Axes, story: Story) -> None:
    """Draw the probabilities on a logit scale, on which 99 % and 99.99 % are easy to distinguish."""
    confidence = story.recording.scenario.mission.confidence
    edge = max(SUREST, BEYOND * (1.0 - confidence))
    axes.set_yscale("logit")
    for rank in reversed(range(RANKS)):
        for placed in (False, True):
            _draw_rank(axes, story, rank, placed, edge)
    axes.plot([], [], "-D", ms=3, lw=1.4, color=AGES(1.0), label="most probable hypothesis")
    if any(len(one.probabilities) > 1 for one, _ in story.estimates):
        axes.plot([], [], "-x", ms=3, lw=0.8, color=GHOST, label=name_of_others(story))
    axes.axhline(
        confidence, color="k", lw=0.9, ls="-.", gid="confidence", label=f"required: {percent(confidence)}"
    )
    tails = [10.0**-k for k in range(2, 13, 2) if 10.0**-k > edge]
    ticks = [*tails[::-1], 0.5, *[1.0 - tail for tail in tails]]
    axes.set_yticks([edge, *ticks, 1.0 - edge], ["less", *map(percent, ticks), "more"])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(edge, 1.0 - edge)
    axes.set_ylabel("probability of a hypothesis")


def _draw_rank(axes: Axes, story: Story, rank: int, placed: bool, edge: float) -> None:
    """Draw the probability of the hypothesis at `rank`: of placements if `placed`, else of branches."""
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
    """Return the indices of the ticks whose phase is short enough for a marker at each tick."""
    sparse: set[int] = set()
    for span in story.phases:
        if span.last - span.first < DENSE:
            sparse.update(range(span.first, span.last + 1))
    return [i for i, tick in enumerate(ticks) if tick in sparse]


def percent(probability: float) -> str:
    """Return a probability as a percentage with all its significant digits."""
    return f"{round(100.0 * probability, 10):.12g} %"


def _draw_count(axes: Axes, story: Story) -> None:
    """Draw the number of possible poses. It is undefined while the robot may be anywhere on a circle."""
    counts = [(one.tick, len(one.world or one.local) or math.nan) for one, _ in story.estimates]
    if counts:
        ticks, held = zip(*counts, strict=True)
        axes.plot(
            ticks, held, "-D", ms=3, lw=1.2, drawstyle="steps-post", color=AGES(1.0), gid="count",
            markevery=_marked(story, ticks), label="possible poses",
        )  # fmt: skip
    axes.axhline(1.0, color="k", lw=0.9, ls="-.", label="one pose")
    axes.set_ylim(0.0, 1.0 + max([len(one.world or one.local) for one, _ in story.estimates], default=1))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axes.set_ylabel("possible poses")
