"""The meetings of a group: the wake-up tree in the plane, with all paths, and the robots over time."""

from __future__ import annotations

import math
from itertools import groupby

import msgspec
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from matplotlib.ticker import MaxNLocator

from compose.figures.sheet import LABEL, NO_TRUTH, Absent, Sheet, Window, around, circle
from compose.figures.style import INK, PALE, SCREEN, Medium
from compose.recording.run import Run
from compose.recording.run_setup import RunSetup
from compose.view.colours import COLOURS
from protocol.messages import Command, Localised
from protocol.mission import Role
from protocol.motion import Pose

TALLEST_SPREAD = 4.6
"""The maximum height of the plane, in inches."""
LANE, MOST_LANES = 0.17, 8.0
"""The height of a robot's lane, and the maximum height of all of them, in inches."""
MOST_AXIS_TICKS = 16
"""The largest number of robots with whose anchors the ticks of their claims are written."""
LANE_COLOURS: dict[bool, Role] = {False: "b", True: "a"}
"""The colours of robots before and after they are localised, by role as in other figures."""
LANE_WIDTHS = {False: 1.6, True: 4.5}
"""The widths of lanes, in points: wide in meetings."""
LANE_NAMES = {False: "not yet localised", True: "localised"}


class GroupRobot(msgspec.Struct, frozen=True):
    """One robot of a group, with one entry per tick in each sequence."""

    id: str
    anchor: tuple[float, float] | None
    """The place of its anchor in m; None if it has none."""
    path: tuple[Pose, ...]
    """The true poses."""
    commands: tuple[Command | None, ...]
    """The commands; None in ticks whose Command missed the deadline."""
    localised: int | None
    """The tick of its standing claim (`Run.standing_claim`); None without one."""
    bound: float | None
    """The planned bound of that tick; None if it is unknown."""


def draw(run: Run, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the group in `run`: the plane, and the lanes of the robots over time."""
    setup = run.setup
    if run.world is None or setup is None:
        return Absent(NO_TRUTH)
    robots = group_robots(run, setup)
    claimed = sum([one.localised is not None for one in robots])
    title = [run.title(run.robots), f"Meetings: {claimed} of {len(robots)} robots localised"]
    sheet = Sheet(medium, False, title, [["plane"], ["key"], ["lanes"]])
    axes = sheet.panels["plane"]
    reach = setup.mission.sensing_range
    for one in robots:
        _home(axes, one, reach, ticks=len(robots) <= MOST_AXIS_TICKS)
        _path(axes, one)
    _tree(axes, setup, robots)
    _key(axes, reach, unanchored=any(one.anchor is None for one in robots))
    sheet.plane("plane", _window(robots, reach), TALLEST_SPREAD)
    sheet.key(axes)
    _lanes(sheet.tall("lanes", min(LANE * len(robots) + LANE, MOST_LANES)), setup, robots)
    return sheet.finished()


def group_robots(run: Run, setup: RunSetup) -> list[GroupRobot]:
    """Return the robots of the group in the order in which they are localised, then those that are not."""
    robots = []
    for one in setup.robots:
        claim = run.claim(one.id)
        robots.append(
            GroupRobot(
                id=one.id,
                anchor=None if one.given_anchor is None else (one.given_anchor.x, one.given_anchor.y),
                path=run.truth(one.id),
                commands=tuple([run.command(one.id, tick) for tick in range(run.length)]),
                localised=claim.tick if claim is not None else None,
                bound=setup.bounds_s[one.id] / setup.mission.period if one.id in setup.bounds_s else None,
            )
        )
    return sorted(robots, key=lambda one: math.inf if one.localised is None else one.localised)


def _window(robots: list[GroupRobot], reach: float) -> Window:
    points = [(pose.x, pose.y) for one in robots for pose in one.path]
    for one in robots:
        if one.anchor is not None:
            x, y = one.anchor
            points += [(x + dx, y + dy) for dx in (-reach, reach) for dy in (-reach, reach)]
    return around(points, 0.03)


def _home(axes: Axes, one: GroupRobot, reach: float, *, ticks: bool) -> None:
    """Draw the anchor of a robot, its sensing range, and with `ticks`, when the robot is localised.

    A robot without an anchor has a triangle where it starts.
    """
    hue = COLOURS[LANE_COLOURS[one.localised is not None]]
    if one.anchor is not None:
        axes.plot(*one.anchor, "x", color="k", ms=4, mew=1.2, ls="", zorder=4, gid=f"anchor-{one.id}")
        circle(axes, one.anchor, reach, ls="-", lw=0.8, color=hue, gid=f"range-{one.id}")
        x, y = one.anchor[0], one.anchor[1] + reach
    else:
        x, y = one.path[0].x, one.path[0].y
        axes.plot(x, y, "^", color=hue, ms=5, ls="", zorder=4, gid=f"start-{one.id}")
    name = one.id if one.localised is None or not ticks else f"{one.id}, $k$ = {one.localised}"
    axes.annotate(
        name, (x, y), xytext=(0, 2), textcoords="offset points", ha="center",
        zorder=7, bbox=LABEL,
        gid=f"localised-{one.id}",
    )  # fmt: skip


def _path(axes: Axes, one: GroupRobot) -> None:
    """Draw the true path, in two colours: before and after the robot is localised."""
    since = one.localised if one.localised is not None else len(one.path)
    for known, poses in ((False, one.path[: since + 1]), (True, one.path[since:])):
        if len(poses) > 1:
            axes.plot(
                [p.x for p in poses], [p.y for p in poses], "-", lw=1.1, color=COLOURS[LANE_COLOURS[known]],
                zorder=3, gid=f"path-{one.id}-{LANE_NAMES[known].replace(' ', '-')}",
            )  # fmt: skip


def _tree(axes: Axes, setup: RunSetup, robots: list[GroupRobot]) -> None:
    """Draw an arrow between the anchors of each meeting, dotted if it did not localise the visited robot."""
    known = {one.id: one for one in robots}
    reach = setup.mission.sensing_range
    for visit in setup.visits:
        start, end = known[visit.visitor].anchor, known[visit.visited].anchor
        assert start is not None
        assert end is not None
        length = math.dist(start, end)
        if length <= 2.0 * reach:
            continue
        x, y = (reach / length * (to - at) for at, to in zip(start, end, strict=True))
        axes.add_patch(
            FancyArrowPatch(
                (start[0] + x, start[1] + y), (end[0] - x, end[1] - y), arrowstyle="-|>", mutation_scale=7,
                lw=0.7, color=PALE, shrinkA=0, shrinkB=0, zorder=2,
                ls="-" if known[visit.visited].localised is not None else ":",
                gid=f"meeting-{visit.visitor}-{visit.visited}",
            )
        )  # fmt: skip


def _key(axes: Axes, reach: float, *, unanchored: bool) -> None:
    """Add the entries of the legend, with that of robots without an anchor if there are `unanchored` ones."""
    axes.plot([], [], "x", color="k", ms=4, mew=1.2, ls="", label="anchor")
    if unanchored:
        axes.plot([], [], "^", color=COLOURS["a"], ms=5, ls="", label="start of a robot without an anchor")
    axes.plot([], [], "-", lw=0.8, color=COLOURS["a"], label=f"sensing range, {reach:g} m")
    for known in (False, True):
        axes.plot(
            [], [], "-", lw=1.4, color=COLOURS[LANE_COLOURS[known]], label=f"true path, {LANE_NAMES[known]}"
        )
    axes.plot([], [], "-", marker=">", ms=4, lw=0.7, color=PALE, label="meeting: visitor to visited")
    axes.plot([], [], "*", ms=7, color=INK, ls="", label="localised")


def _lanes(axes: Axes, setup: RunSetup, robots: list[GroupRobot]) -> None:
    """Draw a lane for each robot: wide in meetings, with a star where it is localised, and its bound."""
    rows = {one.id: row for row, one in enumerate(robots)}
    for row, one in enumerate(robots):
        for (known, meets), group in groupby(enumerate(one.commands), key=lambda two: _state(two[1])):
            ticks = [tick for tick, _ in group]
            axes.plot(
                [ticks[0], ticks[-1] + 1], [row, row], "-", lw=LANE_WIDTHS[meets],
                color=COLOURS[LANE_COLOURS[known]], solid_capstyle="butt", zorder=2,
                gid=f"lane-{one.id}-{ticks[0]}",
            )  # fmt: skip
        if one.localised is not None:
            axes.plot(one.localised, row, "*", ms=7, color=INK, mec="white", mew=0.4, ls="", zorder=4)
        if one.bound is not None:
            axes.text(
                1.01, row, f"{one.bound:.0f}", transform=axes.get_yaxis_transform(), va="center", color=PALE,
                gid=f"bound-{one.id}",
            )  # fmt: skip
    for visit in setup.visits:
        tick = next(one.localised for one in robots if one.id == visit.visited)
        if tick is not None:
            ends = rows[visit.visitor], rows[visit.visited]
            axes.plot(
                [tick, tick],
                ends,
                "-",
                lw=0.7,
                color=INK,
                zorder=1,
                gid=f"at-{visit.visitor}-{visit.visited}",
            )
    axes.text(1.01, -0.9, "bound", transform=axes.get_yaxis_transform(), color=PALE)
    axes.set_yticks(range(len(robots)), [one.id for one in robots])
    axes.set_ylim(len(robots) - 0.4, -0.6)
    axes.set_xlim(0, max([len(one.commands) for one in robots]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"tick ({setup.mission.period:g} s)")
    axes.grid(axis="x", lw=0.4, color="0.9")


def _state(command: Command | None) -> tuple[bool, bool]:
    """Return whether a robot is localised, and whether it is in a meeting."""
    if command is None:
        return False, False
    return isinstance(command.verdict, Localised), command.phase == 3 and command.task != "localised"
