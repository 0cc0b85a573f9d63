"""The geometry of a meeting, like Fig. 2: a circle of phase 1 with eta, the orbits of phase 2 with Omega."""

from __future__ import annotations

import math
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc

from agent.planning.drive import inside_arc
from compose.figures.pair import PairRecord
from compose.figures.sheet import LABEL, NO_PLACES, Absent, Sheet, around, circle, heading, trace
from compose.figures.style import INK, PALE, SCREEN, Medium
from compose.figures.trajectory import RANGE_ARROW, TALLEST_PLANE, anchor, draw_trail, window
from compose.view.colours import COLOURS
from protocol.mission import ROLES, Role
from protocol.motion import TAU, Pose

CIRCLE_ANGLE, ORBIT_ANGLE, BESIDE = 0.4, 0.35, 1.25
"""The radii of the arcs of eta and Omega, in those of circle and orbit, and the place of their names."""
SPAN = 2.2
"""The width of the panel of the orbits, in widths of that of the circle."""


def draw(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure: the circle of a robot in phase 1 if one drove it, and the orbits of the pair."""
    if not pair.placed:
        return Absent(NO_PLACES)
    if not pair.a.on_orbit:
        return Absent("the robots of this meeting do not meet on orbits")
    circled = next((one for role in ROLES if (one := _circled(pair, role)) is not None), None)
    names, widths = (["orbits"], [1.0]) if circled is None else (["circle", "orbits"], [1.0, SPAN])
    sheet = Sheet(medium, circled is None, [pair.title], [names, ["key"] * len(names)], widths)
    if circled is not None:
        _circle(sheet, pair, *circled)
    _orbits(sheet, pair)
    sheet.key(sheet.panels["orbits"])
    return sheet.finished()


def _circled(pair: PairRecord, role: Role) -> tuple[Role, int, range] | None:
    """Return the role, the tick of the first range, and the ticks on the circle of phase 1, if any."""
    tasks = [
        one.task if one is not None and one.phase == 1 else ""
        for one in pair.robot(role).commands[: pair.placed]
    ]
    first = tasks.index("circling") if "circling" in tasks else 0
    starts = [k for k in range(first) if tasks[k] == "straight" and tasks[k - 1 : k] != ["straight"]]
    if not starts:
        return None
    last = next((k for k in range(first, len(tasks)) if tasks[k] != "circling"), len(tasks) - 1)
    return role, starts[-1], range(first, last + 1)


def _circle(sheet: Sheet, pair: PairRecord, role: Role, tick: int, ticks: range) -> None:
    """Draw the way from p_0, where the first range is, and the arc 2 eta of the circle out of range."""
    one, axes, radius = pair.robot(role), sheet.panels["circle"], pair.mission.first_straight
    reach, start = pair.mission.sensing_range, one.path[tick]
    outward = math.atan2(start.y - one.anchor.y, start.x - one.anchor.x)
    rho = math.dist((start.x, start.y), (one.anchor.x, one.anchor.y))
    eta = math.pi - 0.5 * inside_arc(rho, radius, reach)
    anchor(axes, pair, role, orbit=False)
    circle(axes, (start.x, start.y), radius, lw=0.9, color=PALE, gid="circle")
    trace(
        axes, [Pose(one.anchor.x, one.anchor.y, 0.0), _off(start, radius, outward)], "-", lw=0.6, color=PALE
    )
    for side in (-eta, eta):
        trace(axes, [start, _off(start, radius, outward + side)], "-", lw=0.8, color=INK, gid="eta")
    _angle(axes, start, CIRCLE_ANGLE * radius, (outward, outward + eta), r"$\eta$")
    draw_trail(axes, one, role, range(tick, ticks[-1] + 1), lw=1.6)
    for k in range(tick, ticks[-1] + 1):
        face = COLOURS[role] if one.anchor_ranges[k] is not None else "white"
        trace(axes, [one.path[k]], "o", ms=4, mfc=face, mec=COLOURS[role], mew=1.0, zorder=4)
    heading(axes, one.path[tick], RANGE_ARROW * reach, COLOURS[role])
    axes.annotate(
        "$p_0$", (start.x, start.y), xytext=(-9, -9), textcoords="offset points", bbox=LABEL, zorder=6
    )
    title = rf"(a) phase 1 of {one.id}: $\eta$ = {eta:.3f} rad,"
    axes.set_title(title + f"\n$A_0$ = {radius:.4g} m, " + rf"$\rho_0$ = {rho:.4g} m", loc="left", pad=3)
    points = [(place.x, place.y) for place in one.path[tick : ticks[-1] + 1]]
    points += [(start.x + dx, start.y + dy) for dx in (-radius, radius) for dy in (-radius, radius)]
    sheet.plane("circle", around([*points, (one.anchor.x, one.anchor.y)], 0.15))


def _orbits(sheet: Sheet, pair: PairRecord) -> None:
    """Draw both orbits, a where b is nearest, and the half angle Omega at which a reaches b's."""
    axes, a, b = sheet.panels["orbits"], pair.a, pair.b
    apart = math.dist((a.anchor.x, a.anchor.y), (b.anchor.x, b.anchor.y))
    along = math.atan2(b.anchor.y - a.anchor.y, b.anchor.x - a.anchor.x)
    waits = b.orbit.v == 0.0
    reached = pair.mission.sensing_range - b.orbit.radius if waits else b.orbit.radius
    cosine = (a.orbit.radius**2 + apart**2 - reached**2) / (2.0 * a.orbit.radius * apart)
    half = math.acos(min(1.0, max(-1.0, cosine)))
    for role in ROLES:
        anchor(axes, pair, role)
    if waits:
        look: dict[str, Any] = {"lw": 0.8, "ls": ":", "color": COLOURS["b"], "gid": "reached"}
        circle(axes, (b.anchor.x, b.anchor.y), reached, label=f"surely in range of {b.id}", **look)
    centre = Pose(a.anchor.x, a.anchor.y, 0.0)
    other = Pose(b.anchor.x, b.anchor.y, 0.0)
    trace(axes, [centre, other], "-", lw=0.6, color=PALE, zorder=1)
    for side in (-half, half):
        end = _off(centre, a.orbit.radius, along + side)
        trace(axes, [centre, end], "-", lw=0.8, color=INK, gid="omega")
        if not waits:
            trace(axes, [other, end], "-", lw=0.8, color=PALE)
    _angle(axes, centre, ORBIT_ANGLE * a.orbit.radius, (along, along + half), r"$\Omega$")
    ends = [_off(centre, a.orbit.radius, along), _off(other, b.orbit.radius, along + math.pi)]
    for role, end in zip(ROLES, ends, strict=True):
        orbit = pair.robot(role).orbit
        trace(axes, [end], "o", ms=5, mfc=COLOURS[role], mec="white", mew=0.6, zorder=5, gid=f"at-{role}")
        if orbit.v:
            out = along if role == "a" else along + math.pi
            turned = Pose(end.x, end.y, out + math.copysign(0.25 * TAU, orbit.omega))
            heading(axes, turned, RANGE_ARROW * pair.mission.sensing_range, COLOURS[role])
    between = math.dist(*[(end.x, end.y) for end in ends])
    trace(axes, ends, ":", lw=1.3, color=INK, label=f"{between:.4g} m between the robots", zorder=3)
    letter = "(b) " if "circle" in sheet.panels else ""
    axes.set_title(rf"{letter}phase 2: $D$ = {apart:.4g} m, $\Omega$ = {half:.3f} rad", loc="left", pad=3)
    sheet.plane("orbits", window(pair), TALLEST_PLANE, low="circle" not in sheet.panels)


def _angle(axes: Axes, at: Pose, radius: float, between: tuple[float, float], name: str) -> None:
    """Mark the angle at `at` between two directions (rad) by an arc, and name it."""
    low, high = map(math.degrees, between)
    axes.add_patch(
        Arc((at.x, at.y), 2 * radius, 2 * radius, theta1=low, theta2=high, lw=0.9, color=INK, gid="arc")
    )
    middle = _off(at, BESIDE * radius, 0.5 * sum(between))
    axes.annotate(name, (middle.x, middle.y), ha="center", va="center", bbox=LABEL, zorder=6)


def _off(pose: Pose, distance: float, direction: float) -> Pose:
    """Return the position `distance` m from `pose` in `direction` (rad)."""
    return Pose(pose.x + distance * math.cos(direction), pose.y + distance * math.sin(direction), direction)
