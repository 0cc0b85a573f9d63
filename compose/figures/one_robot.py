"""The figure of one robot's mission: its estimates in the plane, their errors, and its hypotheses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Wedge

from compose.figures.over_time import TALL, draw_errors, draw_hypotheses, timed
from compose.figures.pair import PairRecord, Side, others
from compose.figures.sheet import NO_TRUTH, Absent, Sheet, entry, heading, plain, trace
from compose.figures.style import INK, PALE, SCREEN, Medium
from compose.figures.trajectory import draw_plane, window
from compose.recording.reasons import ended
from compose.view.colours import COLOURS
from compose.view.outlines import OUTLINE_SIGMAS, Point, outline
from protocol.messages import Estimate
from protocol.mission import Role
from protocol.motion import Pose, travelled
from protocol.rounding import TOLERANCE

MOSAIC = (
    ("plane", "near"),
    ("key", "ages"),
    ("errors", "errors-key"),
    ("hypotheses", "hypotheses-key"),
)
WIDTHS, TALLEST = (1.7, 1.0), 4.4
"""The ratio of the widths of its columns, and the maximum height of the plane in inches."""
AGES: dict[Role, LinearSegmentedColormap] = {
    "a": LinearSegmentedColormap.from_list("ages-a", ["#9cc9ea", COLOURS["a"], "#04263f"]),
    "b": LinearSegmentedColormap.from_list("ages-b", ["#f2b79f", COLOURS["b"], "#4a1608"]),
}
"""The colours of estimates over time by role, from the first to the last: the robot's hue, ever darker."""
OUTLINES_PER_ROBOT = 5
"""The maximum number of outlines of where the robot is."""
SMALLER = 0.75
"""The largest size ratio, later over earlier, at which two overlapping outlines are both legible."""
LARGEST_PANEL = 2.2
"""The maximum half-width of the enlarged panel, as a multiple of the last outline's size."""
EXACTLY = 0.02
"""The minimum half-width of the enlarged panel with exact sensors, as a fraction of the sensing range."""
PANEL_ARROW = 0.55
"""The length of a heading arrow, as a fraction of that half-width."""


def draw(pair: PairRecord, role: Role, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure: the plane, the enlarged panel beside it, two panels over time, and their keys."""
    if not pair.true:
        return Absent(NO_TRUTH)
    sheet = Sheet(medium, False, _title(pair, role), MOSAIC, WIDTHS)
    axes, near = sheet.panels["plane"], sheet.panels["near"]
    draw_plane(axes, pair, role)
    draw_estimates(axes, pair, role)
    sheet.plane("plane", window(pair), TALLEST)
    sheet.key(axes)
    if pair.robot(role).likeliest:
        half = draw_near(near, pair, role)
        sheet.plane("near", (-half, half, -half, half))
        near.set(xlabel="x error [m]", ylabel="y error [m]")
        sheet.key(near, "ages", title="estimates, by tick")
    else:
        near.set_axis_off()
        sheet.panels["ages"].set_axis_off()
        middle: Any = {"transform": near.transAxes, "ha": "center", "va": "center", "color": PALE}
        near.text(0.5, 0.5, "The recording has no\nmost probable pose.", gid="nothing-near", **middle)
    for name in ("errors", "hypotheses"):
        axes = sheet.tall(name, TALL - 0.3)
        timed(axes, pair, role, phases=name == "errors", label=name == "hypotheses")
        if name == "errors":
            draw_errors(axes, pair, "position", role)
        else:
            draw_hypotheses(axes, pair, role)
        sheet.key(axes, f"{name}-key")
    return sheet.finished()


def _title(pair: PairRecord, role: Role) -> list[str]:
    """Return the title: the robot, the outcome of the mission, and the robot's claim."""
    one, scenario, ending = pair.robot(role), pair.run.scenario, pair.run.end
    end = "the recording breaks off" if ending is None else ended(ending, ending.tick)
    first = f"Robot {one.id} of {scenario.name}, seed {scenario.seed}: {end}"
    if one.claim is None:
        return [first, "The robot claims no pose."]
    errors = f"errors {one.claim.position_error:.2g} m and {one.claim.heading_error:.2g} rad"
    sigma = one.claim.covariance
    sigmas = f" (sigmas {sigma.position_sigma:.2g} m and {sigma.heading_sigma:.2g} rad)" if sigma else ""
    return [first, plain(f"The robot claims its pose in tick {one.claim.tick}: {errors}{sigmas}.")]


def draw_estimates(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the most probable pose over time, ever darker, legible outlines, and the other poses."""
    one, hues = pair.robot(role), _ages(pair.robot(role), role)
    left, right, low, high = window(pair)
    ghosts = [pose for estimate, _ in one.placed for pose in others(estimate)]
    within = [pose for pose in ghosts if left <= pose.x <= right and low <= pose.y <= high]
    if within:
        weighed = any(estimate.probabilities for estimate, _ in one.placed)
        label = "other hypotheses" if weighed else "hypotheses"
        trace(axes, within, "x", ms=3.6, mew=0.8, color=COLOURS[role], alpha=0.5, gid="ghosts", label=label)
    if not one.likeliest:
        return
    shown, poses = legible(pair, role), [estimate.world[0] for estimate, _ in one.likeliest]
    places: Any = {"s": 7, "marker": "D", "c": list(hues.values()), "zorder": 3, "gid": "estimates"}
    axes.scatter([p.x for p in poses], [p.y for p in poses], **places)
    for estimate, _ in shown:
        _draw_outline(axes, one, role, estimate, (0.0, 0.0), f"outline-{estimate.tick}")
    trace(axes, poses[-1:], "*", ms=9, mfc=AGES[role](1.0), mec="white", mew=0.6, zorder=5, gid="final")
    label, style = ("estimate, 3 sigma", "-") if shown else ("estimate", "")
    entry(axes, label, ls=style, marker="D", ms=3, lw=1.0, color=AGES[role](0.8))


def _ages(one: Side, role: Role) -> dict[int, str]:
    """Return the colours of the estimates in `one.likeliest`, by tick."""
    ticks = [estimate.tick for estimate, _ in one.likeliest]
    return {
        tick: to_hex(AGES[role](i / (len(ticks) - 1) if len(ticks) > 1 else 1.0))
        for i, tick in enumerate(ticks)
    }


def legible(pair: PairRecord, role: Role) -> list[tuple[Estimate, Pose]]:
    """Return the estimates whose outlines are drawn, with the true poses, in order of time.

    These are the last one and earlier ones that later outlines do not hide, OUTLINES_PER_ROBOT at most.
    Outlines larger than the sensing range R are omitted, because they carry no information.
    """
    chosen: list[tuple[Estimate, Pose]] = []
    for estimate, truth in reversed(pair.robot(role).likeliest):
        size = _size(estimate)
        if not 0.0 < size <= pair.mission.sensing_range or len(chosen) == OUTLINES_PER_ROBOT:
            continue
        if chosen:
            after = chosen[-1][0]
            apart = travelled(estimate.world[0], after.world[0])
            if apart < size + _size(after) and _size(after) > SMALLER * size:
                continue
        chosen.append((estimate, truth))
    return chosen[::-1]


def outline_of(estimate: Estimate) -> Sequence[Point]:
    """Return the closed outline of where the most probable position is; empty without a covariance."""
    return () if estimate.covariance is None else outline(estimate.world[0], estimate.covariance)


def _size(estimate: Estimate) -> float:
    """Return the largest distance in m of that outline from the position; 0 without one."""
    pose = estimate.world[0]
    return max([math.dist((pose.x, pose.y), one) for one in outline_of(estimate)], default=0.0)


def _draw_outline(axes: Axes, one: Side, role: Role, estimate: Estimate, origin: Point, gid: str) -> None:
    """Draw that outline relative to `origin`; the last one is filled."""
    colour, last = _ages(one, role)[estimate.tick], estimate is one.likeliest[-1][0]
    points = [(x - origin[0], y - origin[1]) for x, y in outline_of(estimate)]
    if points:
        face, width = to_rgba(colour, 0.12 if last else 0.0), 1.4 if last else 0.8
        axes.add_patch(Polygon(points, facecolor=face, edgecolor=colour, lw=width, zorder=4, gid=gid))


def draw_near(axes: Axes, pair: PairRecord, role: Role) -> float:
    """Draw the estimates relative to the true pose in the same tick, and return the half-width in m."""
    one, drawn = pair.robot(role), legible(pair, role)
    last, truth = one.likeliest[-1]
    sizes = [
        _size(estimate) + travelled(estimate.world[0], then) for estimate, then in [*drawn, one.likeliest[-1]]
    ]
    least = EXACTLY * pair.mission.sensing_range if pair.exact else TOLERANCE
    half = max(min(1.1 * max(sizes[:-1], default=sizes[-1]), LARGEST_PANEL * sizes[-1]), least)
    axes.set_title("relative to the true pose", color=PALE, pad=5, loc="left")
    heading(axes, Pose(0.0, 0.0, truth.heading), PANEL_ARROW * half, INK)
    axes.plot(0.0, 0.0, "o", ms=5, color=INK, gid="near-truth", label="true")
    hues = _ages(one, role)
    for estimate, then in drawn or [(last, truth)]:
        pose, (marker, size) = estimate.world[0], ("*", 9.0) if estimate is last else ("D", 3.5)
        _draw_outline(axes, one, role, estimate, (then.x, then.y), f"near-{estimate.tick}")
        axes.plot(
            pose.x - then.x, pose.y - then.y, marker, ms=size, color=hues[estimate.tick], mec="white",
            mew=0.5, zorder=6, label=str(estimate.tick),
        )  # fmt: skip
    pose, hue = last.world[0], to_hex(AGES[role](1.0))
    off = pose.x - truth.x, pose.y - truth.y
    heading(axes, Pose(*off, pose.heading), PANEL_ARROW * half, hue)
    if last.covariance is not None:
        spread = math.degrees(min(math.pi, OUTLINE_SIGMAS * last.covariance.heading_sigma))
        middle = math.degrees(pose.heading)
        sector = middle - spread, middle + spread
        axes.add_patch(Wedge(off, PANEL_ARROW * half, *sector, color=hue, alpha=0.15, lw=0))
    axes.grid(lw=0.4, color="0.9")
    return half
