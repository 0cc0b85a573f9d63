"""A time axis with ticks, the paper's phases, and the claim."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from compose.figures.story import Span, Story

PHASES = {1: "own anchor", 2: "search for the peer", 3: "encounter"}
SHADES = {1: "0.93", 2: "1.0", 3: "#fbf3dc"}
NARROW = 0.18
"""The fraction of the width below which a phase is too narrow, so that each phase gets its own scale."""
SHARES = (0.3, 0.45)
"""The bounds of a phase's fraction of the width in that case, before normalisation."""
DIGIT = 0.015
"""The fraction of the width that a digit of a tick label takes."""
MARKS = 13
"""The approximate number of tick labels on the axis."""


def over_time(axes: Axes, story: Story) -> None:
    """Set up the time axis of `axes`: tick labels, shaded phases, and a line at the claim."""
    ticks, shares = _edges(story)
    even = np.allclose(np.diff(ticks) / (ticks[-1] - ticks[0]), np.diff(shares))
    if not even:
        scales = (lambda x: _along(x, ticks, shares), lambda x: _along(x, shares, ticks))
        axes.set_xscale("function", functions=scales)
    axes.set_xlim(ticks[0], ticks[-1])
    for span, left, right in zip(story.phases, ticks, ticks[1:], strict=False):
        axes.axvspan(left, right, color=SHADES[span.phase], lw=0, zorder=-2, gid=f"phase-{span.phase}")
        if left > ticks[0]:
            axes.axvline(left, color="0.6", lw=0.6, zorder=-1)
    marked = _marks(story.phases, ticks, shares)
    axes.xaxis.set_major_locator(FixedLocator(marked))
    axes.xaxis.set_minor_locator(NullLocator())
    period = story.recording.scenario.mission.period
    if period == 1.0:
        axes.xaxis.set_major_formatter("{x:g}")
        label = "tick (1 s)"
    else:
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}\n{x * period:g} s"))
        label = "tick and time since the start"
    axes.set_xlabel(label if even else f"{label}; one scale per phase")
    if story.claim is not None:
        axes.axvline(
            story.claim.tick,
            color="0.1",
            lw=1.2,
            ls="--",
            gid="claim",
            label=f"claim, tick {story.claim.tick}",
        )


def name_phases(axes: Axes, story: Story) -> None:
    """Write the name of each phase above it, or only its number if the phase is too narrow."""
    shares = _edges(story)[1]
    for span, left, right in zip(story.phases, shares, shares[1:], strict=False):
        words = f"{span.phase}: {PHASES[span.phase]}" if right - left >= NARROW else str(span.phase)
        axes.text(
            (left + right) / 2, 1.03, words, transform=axes.transAxes, ha="center", fontsize=8, color="0.3"
        )


def _edges(story: Story) -> tuple[list[float], list[float]]:
    """Return the boundaries of the phases, in ticks and as fractions of the width."""
    spans = story.phases
    ticks = [spans[0].first - 0.5, *[span.last + 0.5 for span in spans]]
    shares = np.diff(ticks) / (ticks[-1] - ticks[0])
    if min(shares) < NARROW:
        shares = np.clip(shares, *SHARES)
        shares = shares / shares.sum()
    return ticks, [0.0, *np.cumsum(shares).tolist()]


def _along(values: Any, here: list[float], there: list[float]) -> Any:
    """Map `values` by the piecewise linear function from the knots `here` to `there`, with extrapolation."""
    x, begins, goals = np.asarray(values, float), np.asarray(here), np.asarray(there)
    piece = np.clip(np.searchsorted(begins, x) - 1, 0, len(begins) - 2)
    slopes = np.diff(goals) / np.diff(begins)
    return goals[piece] + slopes[piece] * (x - begins[piece])


def _marks(spans: tuple[Span, ...], ticks: list[float], shares: list[float]) -> list[float]:
    """Return the ticks with labels: round numbers in each phase that do not overlap."""
    marked: list[float] = []
    end = -1.0
    for span, share in zip(spans, np.diff(shares), strict=True):
        named = MaxNLocator(nbins=max(1, int(MARKS * share)), integer=True, steps=[1, 2, 5, 10])
        for tick in named.tick_values(span.first, span.last):
            half = 0.5 * DIGIT * (len(f"{tick:g}") + 1)
            at = float(_along(tick, ticks, shares))
            if span.first <= tick <= span.last and at - half >= end:
                marked.append(float(tick))
                end = at + half
    return marked
