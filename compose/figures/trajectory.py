"""The whole mission from above, like Figs. 3(a) and 4(a): paths, anchors, sensing ranges and orbits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compose.figures.pair import PairRecord, Side
from compose.figures.sheet import (
    ANCHORS,
    LABEL,
    NO_PLACES,
    Absent,
    Sheet,
    Window,
    around,
    circle,
    entry,
    heading,
    square,
    trace,
)
from compose.figures.style import INK, PALE, ROLE_MARKERS, SCREEN, Medium
from compose.view.colours import COLOURS, line_style
from compose.view.events import PHASE_NAMES
from protocol.mission import ROLES, Role

TALLEST_PLANE = 4.6
"""The maximum height of the plane, in inches."""
INSET, LEAST_ZOOM = 0.3, 1.6
"""The side of the inset as a fraction of the smaller one of the plane, and the least factor of its scale."""
MANY = 160
"""The maximum number of markers on a path."""
BAND = 7.0
"""The width of a band along a path, in points."""
PHASE_COLOURS = {1: "#bfe3b4", 2: "#bfe1f4", 3: "#f6d9a8"}
"""The colours of the bands of each phase: green and light blue as in the paper, and orange."""
RANGE_ARROW = 0.35
"""The length of a heading arrow, as a fraction of the sensing range."""


def draw(pair: PairRecord, medium: Medium = SCREEN, phases: bool = False) -> Figure | Absent:
    """Return the figure: the plane with the key below it; with `phases`, in their colours, as in Fig. 1."""
    if not pair.placed:
        return Absent(NO_PLACES)
    sheet = Sheet(medium, True, [pair.title])
    draw_plane(sheet.panels["plane"], pair, phases=phases)
    sheet.plane("plane", window(pair), TALLEST_PLANE)
    sheet.key(sheet.panels["plane"])
    figure = sheet.finished()
    _inset(sheet.panels["plane"], pair, phases)
    return figure


def _bands(axes: Axes, pair: PairRecord) -> None:
    """Draw both paths as bands in the colours of their phases."""
    for role in ROLES:
        one = pair.robot(role)
        draw_trail(axes, one, role, range(one.first, len(one.path)), lw=BAND, band=True)
    for phase, colour in PHASE_COLOURS.items():
        entry(axes, f"phase {phase}: {PHASE_NAMES[phase]}", "-", lw=BAND, color=colour, solid_capstyle="butt")


def _inset(axes: Axes, pair: PairRecord, phases: bool) -> None:
    """Draw the encounter larger in a corner without paths if it fills a small part of the plane only."""
    if pair.encounter_tick is None:
        return
    ways = {role: pair.robot(role).path[pair.encounter_tick :] for role in ROLES}
    left, right, low, high = square([(pose.x, pose.y) for way in ways.values() for pose in way], 0.2, 0.0)
    (first, last), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    side = INSET * min(last - first, top - bottom)
    if not 0.0 < right - left < side / LEAST_ZOOM:
        return
    paths = [pose for role in ROLES for pose in pair.robot(role).way]
    corners = [(x, y) for y in (top - side, bottom) for x in (first, last - side)]
    x, y = min(
        corners,
        key=lambda at: sum([at[0] < one.x < at[0] + side and at[1] < one.y < at[1] + side for one in paths]),
    )
    inset = axes.inset_axes((x, y, side, side), transform=axes.transData, zorder=7)
    draw_plane(inset, pair, phases=phases)
    for drawn in inset.findobj():
        drawn.set_gid(None)  # it is drawn a second time
    for text in inset.texts:
        text.set_clip_on(True)
    inset.set(xlim=(left, right), ylim=(low, high), xticks=[], yticks=[], aspect="equal")
    axes.indicate_inset_zoom(inset, edgecolor=PALE, lw=0.6)


def draw_plane(axes: Axes, pair: PairRecord, about: Role | None = None, phases: bool = False) -> None:
    """Draw the mission from above, with the last positions; `about` one robot, its peer is pale instead.

    With `phases`, bands have the colours of the phases.
    """
    if phases:
        _bands(axes, pair)
    for role in ROLES:
        anchor(axes, pair, role)
    for role in ROLES:
        _path(axes, pair, role, alpha=1.0 if about in (None, role) else 0.4)
    entry(axes, "start", "s", ms=6, mfc="white", mec=INK, mew=1.2)
    driven = {phase for role in ROLES for phase in pair.robot(role).phases[pair.robot(role).first :]}
    for phase in [] if phases else sorted(driven):
        entry(axes, f"path in phase {phase}", ls=line_style(phase), lw=1.2, color=PALE)
    met, contact = pair.encounter_tick, next((first for first, _ in pair.contacts), None)
    moments = {"contact": (contact, "first contact", ":"), "met": (met, "encounter", (0, (1, 1)))}
    for gid, (tick, name, style) in moments.items():
        if tick is not None and tick < pair.placed and (gid == "met" or tick != met):
            ends, label = [pair.robot(role).path[tick] for role in ROLES], f"{name}, $k$ = {tick}"
            trace(axes, ends, ls=style, color=INK, lw=1.4, zorder=5, gid=gid, label=label)
    if about is None:
        last = sorted({len(pair.robot(role).path) - 1 for role in ROLES})
        for role in ROLES:
            one, look = pair.robot(role), {"ms": 9, "mec": "white", "mew": 0.6, "zorder": 6}
            trace(axes, one.path[-1:], "*", mfc=COLOURS[role], gid=f"last-{one.id}", **look)
        label = f"last position, $k$ = {' and '.join(map(str, last))}"
        entry(axes, label, "*", ms=8, mfc=PALE, mec="white")


def window(pair: PairRecord) -> Window:
    """Return the window that contains both paths, sensing ranges and orbits."""
    points = [(pose.x, pose.y) for role in ROLES for pose in pair.robot(role).way]
    for role in ROLES:
        one = pair.robot(role)
        reach = max(pair.mission.sensing_range, one.orbit.radius if one.on_orbit else 0.0)
        points += [(one.anchor.x + dx, one.anchor.y + dy) for dx in (-reach, reach) for dy in (-reach, reach)]
    return around(points, 0.03)


def anchor(axes: Axes, pair: PairRecord, role: Role, orbit: bool = True) -> None:
    """Draw the anchor of the robot with `role`, its sensing range, and its `orbit` if it drives there."""
    one, reach, first = pair.robot(role), pair.mission.sensing_range, role == "a"
    place, label = (one.anchor.x, one.anchor.y), "anchors $M_1$, $M_2$" if first else None
    axes.plot(*place, "x", color="k", ms=6, mew=1.4, gid=f"anchor-{one.id}", zorder=4, label=label)
    name = f"${ANCHORS[role]}$"
    axes.annotate(name, place, xytext=(5, 5), textcoords="offset points", zorder=6, bbox=LABEL)
    label = f"sensing range, {reach:g} m" if first else None
    circle(axes, place, reach, ls=(0, (4, 3)), lw=0.8, color="k", gid=f"range-{one.id}", label=label)
    if orbit and one.on_orbit:
        label = f"orbit of {one.id}, {one.orbit.radius:.4g} m"
        look = {"lw": 0.6, "color": COLOURS[role], "alpha": 0.5, "gid": f"orbit-{one.id}", "label": label}
        circle(axes, place, one.orbit.radius, **look)


def _path(axes: Axes, pair: PairRecord, role: Role, alpha: float) -> None:
    """Draw a path: positions as markers, joined in the line style of each phase, from the start pose on."""
    one, colour, marks = pair.robot(role), COLOURS[role], ROLE_MARKERS[role]
    every = max(1, math.ceil(len(one.way) / MANY))
    draw_trail(axes, one, role, range(one.first, len(one.path)), alpha=alpha)
    trace(
        axes, one.way, ls="", ms=2.6, mew=0.7, color=colour, alpha=alpha, markevery=every,
        gid=f"path-{one.id}", zorder=3, **marks,
    )  # fmt: skip
    label = f"true path of {one.id}" if pair.true else f"path of {one.id}, from its claim"
    entry(axes, label, "-", lw=1.2, ms=3.5, mew=0.8, color=colour, alpha=alpha, **marks)
    gid = f"released-{one.id}"
    trace(axes, one.way[:1], "s", ms=6, mfc="white", mec=colour, mew=1.2, zorder=4, gid=gid, alpha=alpha)
    heading(axes, one.way[0], RANGE_ARROW * pair.mission.sensing_range, colour)


def draw_trail(
    axes: Axes,
    one: Side,
    role: Role,
    ticks: Sequence[int],
    lw: float = 1.2,
    alpha: float = 1.0,
    band: bool = False,
) -> None:
    """Join the positions in successive `ticks` by lines, one style per phase; a `band` has its colour."""
    for phase, group in groupby(ticks[:-1], key=one.phase):
        piece = list(group)
        look: dict[str, Any] = {"ls": line_style(phase), "color": COLOURS[role], "zorder": 2.5}
        if band:
            look = {"ls": "-", "color": PHASE_COLOURS[phase], "zorder": 1.5, "solid_capstyle": "butt"}
        gid = f"{'band' if band else 'trail'}-{one.id}-{piece[0]}-{phase}"
        trace(axes, one.path[piece[0] : piece[-1] + 2], lw=lw, alpha=alpha, gid=gid, **look)
