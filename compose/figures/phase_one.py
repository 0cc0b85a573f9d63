"""Phase 1 of a robot in its anchor's frame with both branches, like Fig. 3(b)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.estimation.exact import Branch
from agent.planning.state import RobotState
from compose.figures.pair import PairRecord
from compose.figures.sheet import ANCHORS, Absent, Sheet, around, circle, entry, trace
from compose.figures.style import INK, PALE, PALER, ROLE_MARKERS, SCREEN, Medium
from compose.view.colours import COLOURS
from protocol.mission import Role
from protocol.motion import ORIGIN, Pose, compose, travelled

TALLEST_PHASE_ONE = 4.2
"""The maximum height of the plane, in inches."""
FEW = 4
"""The maximum number of ranges for which each circle has an entry in the key."""
SHARED_LABEL = 0.1
"""The distance below which two positions share a label, as a fraction of the longest range."""
CONSISTENT_RESIDUAL = 1e-9
"""The largest residual of a consistent range or missing detection, as a fraction of R."""
RINGS: list[Any] = [(0, (6, 2)), (0, (3, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2))]
"""The line styles of the circles with an entry in the key."""
Track = list[tuple[Pose, float | None]]
"""The odometry pose and the anchor range in m, or None out of range, at each tick."""
Status = Literal["kept", "rejected", "possible"]
"""The status of a branch at the end of phase 1; "possible" if phase 1 has not ended."""
BRANCH_LINES: dict[Status, tuple[str, str]] = {
    "kept": ("selected", "-"), "rejected": ("ruled out", ":"), "possible": ("possible", "--"),
}  # fmt: skip
"""The word and the line style of each status."""


class DrawnBranch(NamedTuple):
    """A branch with its status, its name in the key, and the poses that it implies."""

    branch: Branch
    status: Status
    name: str
    places: list[Pose]


def draw(pair: PairRecord, role: Role, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the branches, with circles of the measured ranges and of the sensing range."""
    states = pair.states(role)
    ended = next((state for state in states if state.own_anchor.done_tick is not None), None)
    state = ended or next((state for state in reversed(states) if state.phase == 1), None)
    if state is None:
        return Absent("the recording has no tick of the robot")
    branches = _branches(states, state)
    if not branches:
        on_anchor = state.own_anchor.kind == "on-anchor"
        return Absent("the robot starts on its anchor" if on_anchor else "the robot has no second range")
    track, reach, first = state.seen(), pair.mission.sensing_range, branches[0]
    ranged = [(tick, rho) for tick, (_, rho) in enumerate(track) if rho is not None]
    virtual = None
    if state.own_anchor.kind == "three-ranges-virtual":
        virtual = first.branch.distance(state.odometry)
    sheet = Sheet(medium, True, [pair.title, _title(pair, role, state)])
    axes = sheet.panels["plane"]
    circle(axes, (0, 0), reach, lw=1.2, ls="-", color="k", gid="range", label=f"$R$ = {reach:g} m")
    trace(axes, [ORIGIN], "x", color="k", ms=6, mew=1.4, gid="anchor", label=f"anchor ${ANCHORS[role]}$")
    _circles(axes, ranged, virtual, len(track) - 1)
    for i, one in enumerate(branches):
        _draw(axes, role, one, track, pair.exact, named=i < 2 or pair.exact)
        against = contradicted(one.branch, track, reach)
        if one.status == "rejected" and pair.exact and against:
            label = f"ruled out by $k$ = {', '.join(map(str, against))}"
            look: dict[str, Any] = {"ms": 8, "mew": 1.2, "color": INK, "zorder": 5, "gid": "contradicted"}
            trace(axes, [one.places[k] for k in against], "x", label=label, **look)
    _name_points(sheet, first.places, ranged)
    largest = max(reach, virtual or 0.0)
    points = [(-largest, -largest), (largest, largest)]
    points += [(place.x, place.y) for one in branches for place in one.places]
    sheet.plane("plane", around(points, 0.05), TALLEST_PHASE_ONE)
    sheet.key(axes)
    return sheet.finished()


def _branches(states: Sequence[RobotState], end: RobotState) -> list[DrawnBranch]:
    """Return the branches considered in phase 1, the selected one first."""
    exact, done = end.config.mission.noise.exact, end.own_anchor.done_tick is not None
    if exact:
        branches, selected = list(end.own_anchor.possible), end.own_anchor.branch
    else:
        until = [state for state in states if state.tick <= end.tick]
        branches = list(max(until, key=lambda state: len(state.own_anchor.branches)).own_anchor.branches)
        selected = end.own_anchor.branches[0] if done else None
    if branches and selected is not None:
        branches.sort(key=lambda one: math.dist(one.anchor, selected.anchor))
        branches[0] = selected  # its estimate uses all measurements up to the end of phase 1
    drawn = []
    for i, branch in enumerate(branches):
        if exact:
            sign = "+" if branch.alpha >= 0.0 else "-"
            name = rf"${sign}\alpha$, $\alpha = {abs(branch.alpha):.4f}$ rad"
        elif i == 0:
            name = "most probable branch"
        else:
            name = "other branch" if len(branches) == 2 else f"{len(branches) - 1} other branches"
        status: Status = "possible" if selected is None else "rejected" if i else "kept"
        places = [compose(branch.start, pose) for pose, _ in end.seen()]
        drawn.append(DrawnBranch(branch, status, name, places))
    return drawn


def _title(pair: PairRecord, role: Role, state: RobotState) -> str:
    kind, done = state.own_anchor.kind, state.own_anchor.done_tick
    more = {"three-ranges-virtual": " and a virtual one", "circle": " and no detection on the circle"}
    result = f"{len(state.log.ranges)} ranges{more.get(kind or '', '')}, finished at $k$ = {done}"
    if done is None:
        result = f"not finished at $k$ = {state.tick}"
    return rf"Phase 1 of {pair.robot(role).id} in $\langle\,{role}({ANCHORS[role]})\rangle$: {result}"


def _circles(axes: Axes, ranged: list[tuple[int, float]], virtual: float | None, last: int) -> None:
    """Draw the ranges, and a virtual one in the `last` tick, as circles about the anchor."""
    for i, (tick, rho) in enumerate(ranged):
        look: dict[str, Any] = {"lw": 0.4, "ls": "-", "color": PALER}
        if i < (FEW if len(ranged) <= FEW else 2):
            label = rf"$\rho_{i}$ = {rho:.4f} m, $k$ = {tick}"
            look = {"lw": 0.9, "ls": RINGS[i], "color": PALE, "label": label}
        circle(axes, (0, 0), rho, gid=f"rho-{i}", zorder=1, **look)
    if len(ranged) > FEW:
        entry(axes, f"{len(ranged) - 2} more ranges", "-", lw=0.4, color=PALER)
    if virtual is not None:
        label = rf"$\rho_{len(ranged)}$ = {virtual:.4f} m, virtual, $k$ = {last}"
        look = {"lw": 0.9, "ls": RINGS[3], "color": PALE, "label": label}
        circle(axes, (0, 0), virtual, gid="rho-virtual", zorder=1, **look)


def _draw(axes: Axes, role: Role, one: DrawnBranch, track: Track, exact: bool, named: bool) -> None:
    """Draw the path implied by a branch, and the measurements along it."""
    selected, (word, style) = one.status == "kept", BRANCH_LINES[one.status]
    colour = COLOURS[role] if selected else INK
    label = f"{one.name}, {'discarded' if one.status == 'rejected' and not exact else word}"
    width, above = (1.5, 1.5) if selected else (1.3, 0.0)
    look: dict[str, Any] = {"gid": one.status, "label": label if named else None}
    trace(axes, one.places, style, lw=width, color=colour, zorder=2 + above, **look)
    for face, gid, label in ((colour, "ranged", "range measured"), ("white", "silent", "no detection")):
        measured = [(rho is not None) == (gid == "ranged") for _, rho in track]
        points = [place for place, shown in zip(one.places, measured, strict=True) if shown]
        if points:
            look = {"gid": f"{gid}-{one.status}", "label": label if selected else None}
            look |= {"ms": 4, "mfc": face, "mec": colour, "mew": 1.0, "zorder": 2.5 + above}
            trace(axes, points, ROLE_MARKERS[role]["marker"], **look)


def contradicted(branch: Branch, track: Track, reach: float) -> list[int]:
    """Return the ticks whose range, or missing detection within `reach` m, is inconsistent with `branch`."""
    found = []
    for tick, (pose, rho) in enumerate(track):
        away, residual = branch.distance(pose), CONSISTENT_RESIDUAL * reach
        if away <= reach - residual if rho is None else abs(away - rho) > residual:
            found.append(tick)
    return found


def _name_points(sheet: Sheet, places: list[Pose], ranged: list[tuple[int, float]]) -> None:
    """Label p_0, p_1 and p_2, the positions of the first three ranges."""
    near = SHARED_LABEL * max(rho for _, rho in ranged)
    named = [places[tick] for tick, _ in ranged[:3]]
    for i, place in enumerate(named):
        if any(travelled(place, other) < near for other in named[:i]):
            continue  # the robot has returned to a labelled position
        sheet.label(f"$p_{i}$", (place.x, place.y), gid=f"p-{i}")
