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

from compose.figures.sheet import Sheet, around, entry
from compose.figures.style import INK, PALE, ROLE_MARKERS, SCREEN, Medium
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.estimating.estimate_run import RecordingEstimate
from compose.recording.estimating.recorded_measurements import Measurements
from compose.recording.ranging.range_recording import Numbers, TruePath
from compose.recording.reasons import listed
from compose.view.colours import COLOURS
from compose.view.outlines import OUTLINE_SIGMAS, Point, outline
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
PROBABLE = 0.99
"""The probability from which on the path of a robot without a claim is drawn."""
MOST_PAIRS = 16
"""The largest number of pairs of radios of a group whose residuals are drawn."""
ANCHOR_MARKS = "sDPX"
"""The markers of anchors; they differ from those of robots."""
TEN = "o^vs<>pdh8"
"""The markers of the robots of a group, which repeat after ten."""


class Estimated(NamedTuple):
    """A robot, with its colour and marks, its rows, and the truth if it is known."""

    id: str
    colour: str
    marks: dict[str, Any]
    rows: list[PoseEstimateRow]
    truth: TruePath | None
    times: Numbers
    """The time of each row in s, from the first odometry of both robots on."""

    @property
    def claim(self) -> int | None:
        """The index of the row of its first claim."""
        return next((k for k, row in enumerate(self.rows) if row.claim), None)

    def values(self, name: str, least: float = -math.inf) -> list[float]:
        """Return a column of its rows; NaN without a value."""
        found = [getattr(row, name) for row in self.rows]
        return [math.nan if one is None else max(one, least) for one in found]


class Drawn(NamedTuple):
    """The content of the figures."""

    problem: Measurements
    estimates: RecordingEstimate
    robots: list[Estimated]

    @property
    def ranged(self) -> list[str]:
        """The pairs of radios that have ranges at the end; of a group, the first MOST_PAIRS."""
        counts = self.estimates.epochs[-1].ranges
        radios = zip(self.problem.joint.radios, counts, strict=True)
        found = ["-".join(pair) for pair, count in radios if count]
        return found if len(self.problem.robots) <= len(ROLES) else found[:MOST_PAIRS]

    @property
    def title(self) -> list[str]:
        """The robots, the recording and the noise."""
        robots = [one.id for one in self.problem.robots]
        names = " and ".join(robots) if len(robots) < 3 else listed(robots)
        frame = f", frame of {to}" if (to := self.problem.relative_to) is not None else ""
        return [f"{names} in {self.problem.source.rpartition('/')[2]}, noise {self.problem.noise}{frame}"]

    def since_begin(self, times: Any) -> Numbers:
        """Return times in s from the first odometry of both robots on."""
        return np.asarray(times, float) - self.estimates.summary.begin_s


def _robots(problem: Measurements, estimates: RecordingEstimate) -> list[Estimated]:
    """Return the robots; the colours and marks of one and of two are those of the paper's roles."""
    count, found = len(problem.robots), []
    colours = matplotlib.colormaps["tab10" if count <= len(TEN) else "turbo"]
    for i, one in enumerate(problem.robots):
        hue = to_hex(colours(i if count <= len(TEN) else (i + 0.5) / count))
        marks: dict[str, Any] = {"marker": TEN[i % len(TEN)], "color": hue}
        if count <= len(ROLES):
            hue, marks = COLOURS[ROLES[i]], ROLE_MARKERS[ROLES[i]]
        rows = [row for row in estimates.rows if row.robot == one.id]
        times = np.array([row.t_s for row in rows]) - estimates.summary.begin_s
        found.append(Estimated(one.id, hue, marks, rows, one.recorded.truth, times))
    return found


def estimate_figures(
    problem: Measurements, estimates: RecordingEstimate, medium: Medium = SCREEN
) -> Iterator[tuple[str, Figure]]:
    """Yield the figures and their names; none if there was never a hypothesis."""
    drawn = Drawn(problem, estimates, _robots(problem, estimates))
    if not estimates.rows:
        return
    yield "estimate-path", _path(drawn, medium)
    yield "estimate-over-time", _over_time(drawn, medium)


def _path(drawn: Drawn, medium: Medium) -> Figure:
    sheet = Sheet(medium, narrow=False, title=drawn.title)
    axes = sheet.panels["plane"]
    points: list[Point] = []
    for one in drawn.robots:
        if one.truth is not None:
            label = f"{one.id}, truth"
            axes.plot(*one.truth.poses[:, :2].T, color=one.colour, lw=2.6, alpha=0.3, label=label)
            points += [(float(x), float(y)) for x, y in one.truth.poses[:, :2]]
        if not one.rows:
            continue
        claim, label = one.claim, f"{one.id}, from its first claim on"
        if claim is None:  # then from the last probable hypothesis on
            doubtful = [k for k, row in enumerate(one.rows[:-1]) if row.probability < PROBABLE]
            claim, label = max(doubtful, default=-1) + 1, f"{one.id}, never claimed"
        rows = one.rows[claim:]
        places = [(row.x, row.y) for row in rows]
        axes.plot(*zip(*places, strict=True), color=one.colour, lw=1.0)
        entry(axes, label, **{**one.marks, "color": one.colour, "lw": 1.0, "ms": 5})
        points += places
        for row in rows[:: math.ceil(len(rows) / OUTLINES_PER_PATH)]:
            if math.sqrt(row.xx + row.yy) <= TOO_WIDE:
                covariance = Covariance(row.xx, row.xy, row.xh, row.yy, row.yh, row.hh)
                shape = outline(Pose(row.x, row.y, row.heading), covariance)
                axes.add_patch(Polygon(shape, facecolor=one.colour, edgecolor=one.colour, alpha=0.18, lw=0.8))
                points += shape
        axes.plot(*places[0], ls="", ms=5, **one.marks)
    for anchor, marker in zip(drawn.problem.anchors, cycle(ANCHOR_MARKS), strict=False):
        estimated = drawn.estimates.summary.anchors.get(anchor.id)
        at = estimated.position if estimated is not None else (anchor.x, anchor.y)
        if math.isfinite(at[0]):
            axes.plot(*at, ls="", marker=marker, ms=5, color=INK, label=f"anchor {anchor.id}")
            points.append(at)
    entry(axes, "3 sigma", color=PALE, lw=6.0, alpha=0.3, solid_capstyle="butt")
    sheet.plane("plane", around(points, PATH_MARGIN), TALLEST)
    sheet.key(axes)
    return sheet.finished()


def _over_time(drawn: Drawn, medium: Medium) -> Figure:
    """Return the figure of errors, NEES, hypotheses and residuals over time; the first two need the truth."""
    known = any(row.nees is not None for row in drawn.estimates.rows)
    position = "position\nerror [m]" if known else "position [m]"
    panels = {position: _positions, **({"NEES": _nees} if known else {}), "probability": _hypotheses}
    rows = [[name] for label in panels for name in (label, f"{label} key")]
    sheet = Sheet(medium, False, drawn.title, [*rows, *[[pair] for pair in drawn.ranged]])
    for label, draw in panels.items():
        axes = sheet.tall(label, TALL)
        draw(axes, drawn)
        for one in drawn.robots if label != "probability" else ():
            if one.claim is not None:
                axes.axvline(one.times[one.claim], color=one.colour, lw=0.8, ls=":", zorder=0)
        if label == position and any(one.claim is not None for one in drawn.robots):
            entry(axes, "first claim", ls=":", lw=0.8, color=PALE)
        sheet.key(axes, f"{label} key")
    for which, pair in enumerate(drawn.ranged):
        _residuals(sheet.tall(pair, TALL), drawn, which)
    end = float(drawn.since_begin(drawn.estimates.epochs[-1].t))
    for label in (*panels, *drawn.ranged):
        axes = sheet.panels[label]
        axes.set_xlim(0.0, end)
        axes.grid(color="0.9", lw=0.5)
        axes.set_ylabel(label if label in panels else f"residual\n{label} [m]")
    axes.set_xlabel("time [s]")
    sheet.figure.align_ylabels()
    return sheet.finished()


def _positions(axes: Axes, drawn: Drawn) -> None:
    for one in drawn.robots:
        errors = one.values("position_error_m", LEAST_ERROR)
        if not all(map(math.isnan, errors)):
            axes.plot(one.times, errors, color=one.colour, lw=1.2, label=f"{one.id}, error")
    for one in drawn.robots:
        bounds = [OUTLINE_SIGMAS * math.sqrt(max(row.xx + row.yy, 0.0)) for row in one.rows]
        axes.plot(one.times, bounds, color=one.colour, ls="--", lw=1.0, label=f"{one.id}, 3 sigma")
    axes.set_yscale("log")


def _nees(axes: Axes, drawn: Drawn) -> None:
    for one in drawn.robots:
        axes.plot(one.times, one.values("nees"), color=one.colour, lw=1.2, label=f"{one.id}, NEES")
    axes.axhline(NEES_BOUND, color=PALE, lw=0.8, ls="--", label="99 % limit")
    axes.set_yscale("log")


def _hypotheses(axes: Axes, drawn: Drawn) -> None:
    epochs = [one for one in drawn.estimates.epochs if one.hypotheses]
    times = drawn.since_begin([one.t for one in epochs])
    best = [one.hypotheses[0].probability for one in epochs]
    counts = [len(one.hypotheses) for one in epochs]
    look: dict[str, Any] = {"color": PALE, "lw": 1.0, "ls": "-", "drawstyle": "steps-post"}
    axes.plot(times, best, color=INK, lw=1.2, label="probability of the first hypothesis")
    entry(axes, "hypotheses (right)", **look)
    axes.set_ylim(0.0, 1.05)
    right = axes.twinx()
    right.plot(times, counts, **look)
    right.set_ylim(0.0, max(counts) + 0.5)


def _residuals(axes: Axes, drawn: Drawn, which: int) -> None:
    """Draw the residuals of one pair of radios by the last fit; outliers are crosses."""
    fitted = drawn.estimates.epochs[-1].fitted
    if fitted is None:
        return
    fit, used = fitted
    _, rows = used.ranges.pairs[which]
    times = drawn.since_begin(drawn.problem.time_of(fit.ticks[rows]))
    residuals, good = fit.residuals[rows], fit.weights[rows] > OUTLIER
    axes.axhline(0.0, color=PALE, lw=0.6)
    axes.plot(times[good], residuals[good], ls="", marker="o", ms=2.5, color=INK)
    axes.plot(times[~good], residuals[~good], ls="", marker="x", ms=4, color=COLOURS["b"])
