"""The whole mission from above, like Figs. 3(a) and 4(a): paths, anchors, sensing ranges and orbits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compose.figures.pair import PairRecord, Side
from compose.figures.sheet import ANCHORS, LABEL, NO_PLACES, Absent, Sheet, Window, around, circle
from compose.figures.style import INK, PALE, ROLE_MARKERS, SCREEN, Medium
from compose.view.colours import COLOURS, line_style
from protocol.mission import ROLES, Role
from protocol.motion import Pose

TALLEST_TRAJECTORY = 4.6
"""The maximum height of the plane, in inches."""
MANY = 160
"""The maximum number of markers on a path."""
RANGE_ARROW = 0.35
"""The length of a heading arrow, as a fraction of the sensing range."""


def draw(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure: the plane with the key below it."""
    if not pair.placed:
        return Absent(NO_PLACES)
    sheet = Sheet(medium, True, [pair.title])
    draw_plane(sheet.panels["plane"], pair)
    sheet.plane("plane", window(pair), TALLEST_TRAJECTORY)
    sheet.key(sheet.panels["plane"])
    return sheet.finished()


def draw_plane(axes: Axes, pair: PairRecord, about: Role | None = None) -> None:
    """Draw the mission from above, with the last positions; `about` one robot, its peer is pale instead."""
    for role in ROLES:
        draw_anchor(axes, pair, role)
        one = pair.robot(role)
        if one.on_orbit:
            circle(
            axes, (one.anchor.x, one.anchor.y), one.orbit.radius, lw=0.6, color=COLOURS[role], alpha=0.5,
            gid=f"orbit-{one.id}", label=f"orbit of {one.id}, {one.orbit.radius:.4g} m",
        )  # fmt: skip
    for role in ROLES:
        _path(axes, pair, role, pale=about not in {None, role})
    axes.plot([], [], "s", ms=6, mfc="white", mec=INK, mew=1.2, label="start")
    for phase in sorted(
        {phase for role in ROLES for phase in pair.robot(role).phases[pair.robot(role).first :]}
    ):
        axes.plot([], [], ls=line_style(phase), lw=1.2, color=PALE, label=f"path in phase {phase}")
    _meetings(axes, pair)
    if about is None:
        _last(axes, pair)


def window(pair: PairRecord) -> Window:
    """Return the window that contains both paths, sensing ranges and orbits."""
    points = [(pose.x, pose.y) for role in ROLES for pose in pair.robot(role).way]
    for role in ROLES:
        one = pair.robot(role)
        reach = max(pair.mission.sensing_range, one.orbit.radius if one.on_orbit else 0.0)
        points += [(one.anchor.x + dx, one.anchor.y + dy) for dx in (-reach, reach) for dy in (-reach, reach)]
    return around(points, 0.03)


def draw_anchor(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the anchor of the robot with `role`, and its sensing range."""
    one, reach = pair.robot(role), pair.mission.sensing_range
    place, first = (one.anchor.x, one.anchor.y), role == "a"
    axes.plot(
        *place, "x", color="k", ms=6, mew=1.4, gid=f"anchor-{one.id}", zorder=4, ls="",
        label="anchors $M_1$, $M_2$" if first else None,
    )  # fmt: skip
    axes.annotate(
        f"${ANCHORS[role]}$", place, xytext=(5, 5), textcoords="offset points", zorder=6, bbox=LABEL
    )
    circle(
        axes, place, reach, ls=(0, (4, 3)), lw=0.8, color="k", gid=f"range-{one.id}",
        label=f"sensing range, {reach:g} m" if first else None,
    )  # fmt: skip


def _path(axes: Axes, pair: PairRecord, role: Role, *, pale: bool) -> None:
    """Draw a path: positions as markers, joined in the line style of each phase, from the start pose on."""
    one, colour, alpha = pair.robot(role), COLOURS[role], 0.4 if pale else 1.0
    draw_trail(axes, one, role, range(one.first, len(one.path)), alpha=alpha)
    axes.plot(
        [p.x for p in one.way], [p.y for p in one.way], ls="", ms=2.6, mew=0.7, color=colour, alpha=alpha,
        markevery=max(1, math.ceil(len(one.way) / MANY)), gid=f"path-{one.id}", zorder=3,
        **ROLE_MARKERS[role],
    )  # fmt: skip
    label = f"true path of {one.id}" if pair.true else f"path of {one.id}, from its claim"
    axes.plot(
        [], [], "-", lw=1.2, ms=3.5, mew=0.8, color=colour, alpha=alpha, label=label, **ROLE_MARKERS[role]
    )
    start = one.path[one.first]
    axes.plot(
        start.x, start.y, "s", ms=6, mfc="white", mec=colour, mew=1.2, zorder=4, gid=f"released-{one.id}",
        alpha=alpha,
    )  # fmt: skip
    heading(axes, start, RANGE_ARROW * pair.mission.sensing_range, colour)


def draw_trail(
    axes: Axes, one: Side, role: Role, ticks: Sequence[int], lw: float = 1.2, alpha: float = 1.0
) -> None:
    """Join the positions in successive `ticks` by lines, one line style per phase."""
    for phase, group in groupby(ticks[:-1], key=one.phase):
        piece = list(group)
        poses = one.path[piece[0] : piece[-1] + 2]
        axes.plot(
            [p.x for p in poses], [p.y for p in poses], ls=line_style(phase), lw=lw, color=COLOURS[role],
            alpha=alpha, zorder=2.5, gid=f"trail-{one.id}-{piece[0]}-{phase}",
        )  # fmt: skip


def heading(axes: Axes, pose: Pose, length: float, colour: str, zorder: float = 4.5) -> None:
    """Draw an arrow of `length` m along the heading of `pose`."""
    axes.annotate(
        "",
        (pose.x + length * math.cos(pose.heading), pose.y + length * math.sin(pose.heading)),
        (pose.x, pose.y),
        arrowprops={
            "arrowstyle": "-|>", "color": colour, "lw": 1.1, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8
        },
        zorder=zorder,
    )  # fmt: skip


def _meetings(axes: Axes, pair: PairRecord) -> None:
    """Draw the separation of the robots at the first contact and where the encounter begins."""
    contact = next((first for first, _ in pair.contacts), None)
    met = pair.encounter_tick
    found = {
        "contact": (contact, "first contact", ":"),
        "met": (met, "encounter", (0, (1, 1))),
    }
    if contact == met:
        del found["contact"]
    for gid, (tick, name, style) in found.items():
        if tick is not None and tick < pair.placed:
            ends = [pair.robot(role).path[tick] for role in ROLES]
            axes.plot(
                [p.x for p in ends], [p.y for p in ends], ls=style, color=INK, lw=1.4, zorder=5, gid=gid,
                label=f"{name}, $k$ = {tick}",
            )  # fmt: skip


def _last(axes: Axes, pair: PairRecord) -> None:
    """Draw the last positions."""
    for role in ROLES:
        end = pair.robot(role).path[-1]
        axes.plot(
            end.x, end.y, "*", ms=9, mfc=COLOURS[role], mec="white", mew=0.6, zorder=6,
            gid=f"last-{pair.robot(role).id}",
        )  # fmt: skip
    last = sorted({len(pair.robot(role).path) - 1 for role in ROLES})
    label = f"last position, $k$ = {' and '.join(map(str, last))}"
    axes.plot([], [], "*", ms=8, mfc=PALE, mec="white", ls="", label=label)
