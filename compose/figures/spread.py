"""The meetings of a group: the wake-up tree in the plane, with all paths, and the robots over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from matplotlib.ticker import MaxNLocator

from compose.figures.sheet import NO_TRUTH, Absent, Sheet, around, circle, entry, trace
from compose.figures.style import INK, PALE, SCREEN, Medium
from compose.figures.trajectory import TALLEST_PLANE
from compose.recording.run import Run
from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.colours import COLOURS
from protocol.messages import Command, Localised
from protocol.mission import Role
from protocol.motion import Pose

LANE, MOST_LANES = 0.17, 8.0
"""The height of a robot's lane, and the maximum height of all of them, in inches."""
MOST_AXIS_TICKS = 16
"""The largest number of robots with whose anchors the ticks of their claims are written."""
LANE_COLOURS: dict[bool, Role] = {False: "b", True: "a"}
"""The colours of robots before and after they are localised, by role as in other figures."""
LANE_WIDTHS = {False: 1.6, True: 4.5}
"""The widths of lanes, in points: wide in meetings."""
LANE_NAMES = {False: "not yet localised", True: "localised"}


def draw(run: Run, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the group in `run`: the plane, and the lanes of the robots over time."""
    setup = run.setup
    if run.world is None or setup is None:
        return Absent(NO_TRUTH)
    claims = {one.id: claim.tick for one in setup.robots if (claim := run.claim(one.id)) is not None}
    robots = sorted(setup.robots, key=lambda one: claims.get(one.id, math.inf))
    title = [run.title(run.robots), f"Meetings: {len(claims)} of {len(robots)} robots localised"]
    sheet = Sheet(medium, False, title, [["plane"], ["key"], ["lanes"]])
    axes, reach = sheet.panels["plane"], setup.mission.sensing_range
    for one in robots:
        label = f", $k$ = {claims[one.id]}" if one.id in claims and len(robots) <= MOST_AXIS_TICKS else ""
        _robot(sheet, one, run.truth(one.id), claims.get(one.id), reach, one.id + label)
    _tree(axes, setup, claims)
    entry(axes, "anchor", "x", color="k", ms=4, mew=1.2)
    if len(setup.anchored) < len(robots):
        entry(axes, "start of a robot without an anchor", "^", color=COLOURS["a"], ms=5)
    entry(axes, f"sensing range, {reach:g} m", "-", lw=0.8, color=COLOURS["a"])
    for known, role in LANE_COLOURS.items():
        entry(axes, f"true path, {LANE_NAMES[known]}", "-", lw=1.4, color=COLOURS[role])
    entry(axes, "meeting: visitor to visited", "->", ms=4, lw=0.7, color=PALE)
    entry(axes, "localised", "*", ms=7, color=INK)
    points = [(pose.x, pose.y) for one in robots for pose in run.truth(one.id)]
    for at in [one.anchor for one in setup.anchored]:
        points += [(at.x - reach, at.y - reach), (at.x + reach, at.y + reach)]
    sheet.plane("plane", around(points, 0.03), TALLEST_PLANE)
    sheet.key(axes)
    _lanes(sheet.tall("lanes", min(LANE * len(robots) + LANE, MOST_LANES)), run, setup, robots, claims)
    return sheet.finished()


def _robot(
    sheet: Sheet, one: RobotSetup, path: Sequence[Pose], claimed: int | None, reach: float, label: str
) -> None:
    """Draw the anchor of a robot, its sensing range, and its path in two colours, before and after its claim.

    A robot without an anchor has a triangle where it starts.
    """
    axes, radius = sheet.panels["plane"], reach if one.given_anchor is not None else 0.0
    hue, at = COLOURS[LANE_COLOURS[claimed is not None]], one.given_anchor or path[0]
    x, y = at.x, at.y
    if one.given_anchor is not None:
        axes.plot(x, y, "x", color="k", ms=4, mew=1.2, zorder=4, gid=f"anchor-{one.id}")
        circle(axes, (x, y), reach, ls="-", lw=0.8, color=hue, gid=f"range-{one.id}")
    else:
        axes.plot(x, y, "^", color=hue, ms=5, zorder=4, gid=f"start-{one.id}")
    sheet.label(label, (x, y), radius, gid=f"localised-{one.id}")
    since = claimed if claimed is not None else len(path)
    for known, poses in ((False, path[: since + 1]), (True, path[since:])):
        if len(poses) > 1:
            gid = f"path-{one.id}-{LANE_NAMES[known].replace(' ', '-')}"
            trace(axes, poses, "-", lw=1.1, color=COLOURS[LANE_COLOURS[known]], zorder=3, gid=gid)


def _tree(axes: Axes, setup: RunSetup, claims: Mapping[str, int]) -> None:
    """Draw an arrow between the anchors of each meeting, dotted if it did not localise the visited robot."""
    for a, b in setup.links():
        reach, length = (
            setup.mission.sensing_range,
            math.dist((a.anchor.x, a.anchor.y), (b.anchor.x, b.anchor.y)),
        )
        if length > 2.0 * reach:
            x, y = (reach / length * one for one in (b.anchor.x - a.anchor.x, b.anchor.y - a.anchor.y))
            start, end = (a.anchor.x + x, a.anchor.y + y), (b.anchor.x - x, b.anchor.y - y)
            style: Any = {"arrowstyle": "-|>", "mutation_scale": 7, "shrinkA": 0, "shrinkB": 0}
            look: Any = {"lw": 0.7, "color": PALE, "ls": "-" if b.id in claims else ":", "zorder": 2}
            axes.add_patch(FancyArrowPatch(start, end, gid=f"meeting-{a.id}-{b.id}", **style, **look))


def _lanes(
    axes: Axes, run: Run, setup: RunSetup, robots: Sequence[RobotSetup], claims: Mapping[str, int]
) -> None:
    """Draw a lane for each robot: wide in meetings, with a star where it is localised, and its bound."""
    rows = {one.id: row for row, one in enumerate(robots)}
    beside: Any = {"transform": axes.get_yaxis_transform(), "color": PALE}
    for row, one in enumerate(robots):
        states = [_state(run.command(one.id, tick)) for tick in range(run.length)]
        for (known, meets), group in groupby(range(run.length), key=states.__getitem__):
            ticks = list(group)
            axes.plot(
                [ticks[0], ticks[-1] + 1], [row, row], "-", lw=LANE_WIDTHS[meets],
                color=COLOURS[LANE_COLOURS[known]], solid_capstyle="butt", zorder=2,
                gid=f"lane-{one.id}-{ticks[0]}",
            )  # fmt: skip
        if one.id in claims:
            axes.plot(claims[one.id], row, "*", ms=7, color=INK, mec="white", mew=0.4, zorder=4)
        if one.id in setup.bounds_s:
            bound = setup.bounds_s[one.id] / setup.mission.period
            axes.text(1.01, row, f"{bound:.0f}", va="center", gid=f"bound-{one.id}", **beside)
    for visit in setup.visits:
        if (tick := claims.get(visit.visited)) is not None:
            ends, gid = (rows[visit.visitor], rows[visit.visited]), f"at-{visit.visitor}-{visit.visited}"
            axes.plot([tick, tick], ends, "-", lw=0.7, color=INK, zorder=1, gid=gid)
    axes.text(1.01, -0.9, "bound", **beside)
    axes.set_yticks(range(len(robots)), [one.id for one in robots])
    axes.set_ylim(len(robots) - 0.4, -0.6)
    axes.set_xlim(0, run.length)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"tick ({setup.mission.period:g} s)")
    axes.grid(axis="x", lw=0.4, color="0.9")


def _state(command: Command | None) -> tuple[bool, bool]:
    """Return whether a robot is localised, and whether it is in a meeting."""
    if command is None:
        return False, False
    return isinstance(command.verdict, Localised), command.phase == 3 and command.task != "localised"
