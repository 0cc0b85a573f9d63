"""The figures of an estimate from a range recording: paths with ellipses, and its quality over time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import cycle
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from compose.figures.sheet import Sheet, around
from compose.figures.style import INK, PALE, ROLE_MARKERS, SCREEN, Medium
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.estimating.estimate_run import RecordingEstimate
from compose.recording.estimating.recorded_measurements import Measurements, listed
from compose.recording.ranging.range_recording import Numbers, TruePath
from compose.view.colours import COLOURS
from compose.view.outlines import OUTLINE_SIGMAS, outline
from protocol.mission import ROLES
from protocol.motion import Covariance, Pose

TALL, TALLEST = 1.0, 5.0
"""The height of a panel over time, and the largest height of the plane, in inches."""
OUTLINES_PER_PATH = 12
"""The largest number of outlines along a path of where the robot is."""
NEES_BOUND = 11.34
"""The NEES that 99 % of right covariances do not exceed: chi-square of three degrees of freedom."""
PATH_MARGIN = 0.03
LEAST_ERROR = 1e-3
"""The smallest error drawn, in m."""
OUTLIER = 0.5
"""The weight below which a range is drawn as an outlier."""
TOO_WIDE = 1.0
"""The sigma (m) of a position above which no outline is drawn: it would cover all others."""


MOST_PAIRS = 16
"""The largest number of pairs of radios of a group whose residuals are drawn."""
ANCHOR_MARKS = "sDPX"
"""The markers of anchors; they differ from those of robots."""


TEN = "o^vs<>pdh8"
"""The markers of the robots of a group, which repeat after ten."""


class Look(NamedTuple):
    """The colour and the marks of a robot."""

    colour: str
    marks: dict[str, Any]


class Drawn(NamedTuple):
    """The content of the figures."""

    problem: Measurements
    estimates: RecordingEstimate

    @property
    def looks(self) -> list[Look]:
        """The colour and the marker of each robot; those of one and of two are those of the paper's roles."""
        count = len(self.problem.robots)
        if count <= len(ROLES):
            return [Look(COLOURS[role], ROLE_MARKERS[role]) for role in ROLES[:count]]
        colours = matplotlib.colormaps["tab10" if count <= len(TEN) else "turbo"]
        hues = [colours(i if count <= len(TEN) else (i + 0.5) / count) for i in range(count)]
        return [Look(to_hex(hue), {"marker": TEN[i % len(TEN)], "color": hue}) for i, hue in enumerate(hues)]

    def rows(self, i: int) -> list[PoseEstimateRow]:
        """Return the rows of the robot with index `i`."""
        name = self.problem.robots[i].id
        return [row for row in self.estimates.rows if row.robot == name]

    @property
    def ranged(self) -> list[tuple[str, str]]:
        """The pairs of radios that have ranges at the end; of a group, the first MOST_PAIRS."""
        counts = self.estimates.epochs[-1].ranges
        found = [pair for pair, count in zip(self.problem.joint.radios, counts, strict=True) if count]
        return found if len(self.problem.robots) <= len(ROLES) else found[:MOST_PAIRS]

    def truth(self, i: int) -> TruePath | None:
        """Return the true path of the robot with index `i`, if there is one."""
        return self.problem.robots[i].recorded.truth

    def since_begin(self, times: Any) -> Any:
        """Return times in s from the first odometry of both robots on."""
        return np.asarray(times, float) - self.problem.t0

    def from_claim(self, i: int) -> list[PoseEstimateRow]:
        """Return the rows of a robot from its first claim on, or those of its last probable hypothesis."""
        rows = self.rows(i)
        first = next((k for k, row in enumerate(rows) if row.claim), None)
        if first is None:
            doubtful = [k for k, row in enumerate(rows[:-1]) if row.probability < PROBABLE]
            first = doubtful[-1] + 1 if doubtful else 0
        return rows[first:]


PROBABLE = 0.99
"""The probability from which on the path of a robot without a claim is drawn."""


def estimate_figures(
    problem: Measurements, estimates: RecordingEstimate, medium: Medium = SCREEN
) -> Iterator[tuple[str, Figure]]:
    """Yield the figures and their names; none if there was never a hypothesis."""
    drawn = Drawn(problem, estimates)
    if not estimates.rows:
        return
    yield "estimate-path", _path(drawn, medium)
    yield "estimate-over-time", _over_time(drawn, medium)


def _title(drawn: Drawn) -> str:
    robots = [one.id for one in drawn.problem.robots]
    names = " and ".join(robots) if len(robots) < 3 else listed(robots)
    return f"{names} in {drawn.problem.source.rpartition('/')[2]}, noise {drawn.problem.noise}"


def _path(drawn: Drawn, medium: Medium) -> Figure:
    sheet = Sheet(medium, narrow=False, title=[_title(drawn)])
    axes = sheet.panels["plane"]
    points: list[tuple[float, float]] = []
    for i, (colour, marks) in enumerate(drawn.looks):
        name = drawn.problem.robots[i].id
        truth = drawn.truth(i)
        if truth is not None:
            axes.plot(*truth.poses[:, :2].T, color=colour, lw=2.6, alpha=0.3, label=f"{name}, truth")
            points += [(float(x), float(y)) for x, y in truth.poses[:, :2]]
        rows = drawn.from_claim(i)
        if not rows:
            continue
        claimed = any(row.claim for row in rows)
        since = "from its first claim on" if claimed else "never claimed"
        axes.plot(
            [row.x for row in rows], [row.y for row in rows], color=colour, lw=1.0, label=f"{name}, {since}"
        )
        points += [(row.x, row.y) for row in rows]
        for row in rows[:: math.ceil(len(rows) / OUTLINES_PER_PATH)]:
            if math.sqrt(row.xx + row.yy) <= TOO_WIDE:
                around_it = outline(
                    Pose(row.x, row.y, row.heading),
                    Covariance(row.xx, row.xy, row.xh, row.yy, row.yh, row.hh),
                )
                axes.add_patch(Polygon(around_it, facecolor=colour, edgecolor=colour, alpha=0.18, lw=0.8))
                points += around_it
        axes.plot(rows[0].x, rows[0].y, ls="", ms=5, **marks)
    for anchor, marker in zip(drawn.problem.anchors, cycle(ANCHOR_MARKS), strict=False):
        estimated = drawn.estimates.summary.anchors.get(anchor.id)
        at = estimated.position if estimated is not None else (anchor.x, anchor.y)
        if math.isfinite(at[0]):
            axes.plot(*at, ls="", marker=marker, ms=5, color=INK, label=f"anchor {anchor.id}")
            points.append(at)
    axes.plot([], [], color=PALE, lw=6.0, alpha=0.3, label="3 sigma")
    sheet.plane("plane", around(points, PATH_MARGIN), TALLEST)
    sheet.key(axes)
    return sheet.finished()


def _over_time(drawn: Drawn, medium: Medium) -> Figure:
    """Return the figure of errors, NEES, hypotheses and residuals over time; the first two need the truth."""
    known = any(row.nees is not None for row in drawn.estimates.rows)
    panels = [_errors, _nees, _hypotheses] if known else [_sigmas, _hypotheses]
    pairs = ["-".join(pair) for pair in drawn.ranged]
    rows = [[name] for draw in panels for name in (draw.__name__, f"{draw.__name__} key")]
    sheet = Sheet(medium, False, [_title(drawn)], [*rows, *[[pair] for pair in pairs]])
    for draw in panels:
        draw(sheet.tall(draw.__name__, TALL), drawn)
        sheet.key(sheet.panels[draw.__name__], f"{draw.__name__} key")
    for which, pair in enumerate(pairs):
        _residuals(sheet.tall(pair, TALL), drawn, which, pair)
    end = float(drawn.since_begin(drawn.estimates.epochs[-1].t))
    over_time = [sheet.panels[name] for name in (*[draw.__name__ for draw in panels], *pairs)]
    for axes in over_time:
        axes.set_xlim(0.0, end)
        axes.grid(color="0.9", lw=0.5)
    over_time[-1].set_xlabel("time [s]")
    return sheet.finished()


def _times(drawn: Drawn, i: int) -> Numbers:
    times: Numbers = drawn.since_begin([row.t_s for row in drawn.rows(i)])
    return times


def _claim_line(axes: Axes, drawn: Drawn, i: int, colour: str) -> None:
    claimed = next((row for row in drawn.rows(i) if row.claim), None)
    if claimed is not None:
        at = float(drawn.since_begin(claimed.t_s))
        axes.axvline(at, color=colour, lw=0.8, ls=":", zorder=0)


def _sigmas(axes: Axes, drawn: Drawn) -> None:
    for i, (colour, _) in enumerate(drawn.looks):
        name = drawn.problem.robots[i].id
        bounds = [OUTLINE_SIGMAS * math.sqrt(max(row.xx + row.yy, 0.0)) for row in drawn.rows(i)]
        axes.plot(_times(drawn, i), bounds, color=colour, ls="--", lw=1.0, label=f"{name}, 3 sigma")
        _claim_line(axes, drawn, i, colour)
    axes.set_yscale("log")
    axes.set_ylabel("position [m]")


def _errors(axes: Axes, drawn: Drawn) -> None:
    for i, (colour, _) in enumerate(drawn.looks):
        name = drawn.problem.robots[i].id
        errors = [
            math.nan if row.position_error_m is None else max(row.position_error_m, LEAST_ERROR)
            for row in drawn.rows(i)
        ]
        axes.plot(_times(drawn, i), errors, color=colour, lw=1.2, label=f"{name}, error")
    _sigmas(axes, drawn)


def _nees(axes: Axes, drawn: Drawn) -> None:
    for i, (colour, _) in enumerate(drawn.looks):
        name = drawn.problem.robots[i].id
        values = [math.nan if row.nees is None else row.nees for row in drawn.rows(i)]
        axes.plot(_times(drawn, i), values, color=colour, lw=1.2, label=f"{name}, NEES")
        _claim_line(axes, drawn, i, colour)
    axes.axhline(NEES_BOUND, color=PALE, lw=0.8, ls="--", label="99 % of right covariances are below")
    axes.set_yscale("log")
    axes.set_ylabel("NEES")


def _hypotheses(axes: Axes, drawn: Drawn) -> None:
    epochs = [one for one in drawn.estimates.epochs if one.hypotheses]
    times = drawn.since_begin([one.t for one in epochs])
    best = [one.hypotheses[0].probability for one in epochs]
    counts = [len(one.hypotheses) for one in epochs]
    axes.plot(times, best, color=INK, lw=1.2, label="probability of the first hypothesis")
    axes.plot([], [], color=PALE, lw=1.0, ls="-", drawstyle="steps-post", label="hypotheses (right)")
    axes.set_ylim(0.0, 1.05)
    axes.set_ylabel("probability")
    right = axes.twinx()
    right.plot(times, counts, color=PALE, lw=1.0, drawstyle="steps-post")
    right.set_ylim(0.0, max(counts) + 0.5)


def _residuals(axes: Axes, drawn: Drawn, which: int, name: str) -> None:
    """Draw the residuals of one pair of radios by the last fit; outliers are crosses."""
    fitted = drawn.estimates.epochs[-1].fitted
    if fitted is None:
        return
    fit, used = fitted
    rows = used.ranges.pairs[which]
    measured = drawn.problem
    times = measured.time_of(fit.ticks[rows]) - measured.t0
    residuals, good = fit.residuals[rows], fit.weights[rows] > OUTLIER
    axes.axhline(0.0, color=PALE, lw=0.6)
    axes.plot(times[good], residuals[good], ls="", marker="o", ms=2.5, color=INK)
    axes.plot(times[~good], residuals[~good], ls="", marker="x", ms=4, color=COLOURS["b"])
    axes.set_ylabel(f"{name} [m]")
