"""The whole mission from above, like Figs. 3(a) and 4(a): paths, anchors, sensing ranges and orbits."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compose.figures.pair import ROLES, PairRecord
from compose.figures.sheet import ANCHORS, NO_PLACES, Absent, Sheet, around, circle, equal, fitted
from compose.figures.style import COLOURS, DASHES, INK, MARKS, PALE
from protocol.mission import Role
from protocol.motion import Pose

WIDTH, BESIDE, TALLEST = 4.9, 1.95, 6.0
"""The maximum width of the plane, the width of the key, and the maximum height of the plane, in inches."""
MANY = 160
"""The maximum number of markers on a path."""
LABEL = {"facecolor": "white", "alpha": 0.75, "pad": 0.6, "lw": 0}


def draw(pair: PairRecord) -> Figure | Absent:
    """Return the figure: the plane with the key beside it."""
    if not pair.placed:
        return Absent(NO_PLACES)
    window = around(_extent(pair), 0.03)
    width, height = fitted(window, WIDTH, TALLEST)
    tall = max(height, 2.9)
    sheet = Sheet(0.6 + width + BESIDE, 0.5 + tall, [pair.title])
    axes = sheet.panel(0.55, 0.42 + (tall - height), width, height)
    for role in ROLES:
        draw_anchor(axes, pair, role)
        _orbit(axes, pair, role)
    for role in ROLES:
        draw_path(
            axes, role, pair.robot(role).path, gid=f"path-{role}", label=f"path of {pair.robot(role).id}"
        )
    for role in ROLES:
        released(axes, role, pair.robot(role).path[0], _arrow(pair))
    _marks(axes, pair)
    equal(axes, window)
    axes.set_xlabel("$x$ [m]")
    axes.set_ylabel("$y$ [m]")
    sheet.key(axes, 0.55 + width + 0.12, 0.42 + tall)
    return sheet.figure


def _extent(pair: PairRecord) -> list[tuple[float, float]]:
    points = [(pose.x, pose.y) for role in ROLES for pose in pair.robot(role).path]
    for role in ROLES:
        one = pair.robot(role)
        reach = max(pair.mission.sensing_range, one.orbit.radius)
        points += [(one.anchor.x + dx, one.anchor.y + dy) for dx in (-reach, reach) for dy in (-reach, reach)]
    return points


def _arrow(pair: PairRecord) -> float:
    """Return the length of a heading arrow, in m."""
    return 0.35 * pair.mission.sensing_range


def draw_anchor(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the anchor of the robot with `role`, and its sensing range."""
    one, reach = pair.robot(role), pair.mission.sensing_range
    place, first = (one.anchor.x, one.anchor.y), role == "a"
    axes.plot(
        *place, "x", color="k", ms=7, mew=1.6, gid=f"anchor-{role}", zorder=4, ls="",
        label="anchors $M_1$, $M_2$" if first else None,
    )  # fmt: skip
    axes.annotate(
        f"${ANCHORS[role]}$",
        place,
        xytext=(6, 6),
        textcoords="offset points",
        fontsize=10,
        zorder=6,
        bbox=LABEL,
    )
    circle(
        axes, place, reach, ls=(0, (4, 3)), lw=1.0, color="k", gid=f"range-{role}",
        label=f"sensing range $R$ = {reach:g} m" if first else None,
    )  # fmt: skip


def _orbit(axes: Axes, pair: PairRecord, role: Role) -> None:
    one = pair.robot(role)
    radius = one.orbit.radius
    circle(
        axes, (one.anchor.x, one.anchor.y), radius, ls=DASHES[role], lw=0.9, color=COLOURS[role],
        gid=f"orbit-{role}", label=f"orbit of {one.id}, {radius:.4g} m",
    )  # fmt: skip


def draw_path(axes: Axes, role: Role, poses: Sequence[Pose], gid: str, label: str | None) -> None:
    """Draw successive positions, joined by lines as in the paper."""
    axes.plot(
        [p.x for p in poses], [p.y for p in poses], "-", lw=1.3, ms=3.6, mew=0.8, color=COLOURS[role],
        markevery=max(1, math.ceil(len(poses) / MANY)), gid=gid, label=label, zorder=3, **MARKS[role],
    )  # fmt: skip


def released(axes: Axes, role: Role, start: Pose, length: float) -> None:
    """Draw the start pose of a robot, with a heading arrow of `length` m."""
    axes.plot(
        start.x, start.y, "s", ms=7, mfc="white", mec=COLOURS[role], mew=1.5, zorder=4,
        gid=f"released-{role}",
    )  # fmt: skip
    heading(axes, start, length, COLOURS[role])


def heading(axes: Axes, pose: Pose, length: float, colour: str, zorder: float = 4.5) -> None:
    """Draw an arrow of `length` m along the heading of `pose`."""
    axes.annotate(
        "",
        (pose.x + length * math.cos(pose.heading), pose.y + length * math.sin(pose.heading)),
        (pose.x, pose.y),
        arrowprops={
            "arrowstyle": "-|>", "color": colour, "lw": 1.3, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9
        },
        zorder=zorder,
    )  # fmt: skip


def _marks(axes: Axes, pair: PairRecord) -> None:
    """Draw the first contact and the last positions."""
    axes.plot([], [], "s", ms=7, mfc="white", mec=INK, mew=1.5, label="start pose")
    tick = next((first for first, _ in pair.contacts if first < pair.placed), None)
    if tick is not None:
        ends = [pair.robot(role).path[tick] for role in ROLES]
        axes.plot(
            [p.x for p in ends], [p.y for p in ends], ":", color=INK, lw=1.6, zorder=5, gid="contact",
            label=f"first contact, $k$ = {tick}",
        )  # fmt: skip
    for role in ROLES:
        end = pair.robot(role).path[-1]
        axes.plot(
            end.x, end.y, "*", ms=11, mfc=COLOURS[role], mec="white", mew=0.7, zorder=6, gid=f"last-{role}"
        )
    last = sorted({len(pair.robot(role).path) - 1 for role in ROLES})
    label = f"last position, $k$ = {' and '.join(map(str, last))}"
    axes.plot([], [], "*", ms=10, mfc=PALE, mec="white", ls="", label=label)
