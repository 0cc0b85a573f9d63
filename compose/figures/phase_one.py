"""Phase 1 of a robot in its anchor's frame with both branches, like Fig. 3(b)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.estimation.exact import Branch
from agent.planning.state import RobotState
from compose.figures.pair import PairRecord
from compose.figures.sheet import ANCHORS, LABEL, Absent, Sheet, around, circle
from compose.figures.style import INK, PALE, PALER, ROLE_MARKERS, SCREEN, Medium
from compose.view.colours import COLOURS
from protocol.messages import BranchKind
from protocol.mission import Role
from protocol.motion import Pose, compose, travelled

TALLEST_PHASE_ONE = 4.2
"""The maximum height of the plane, in inches."""
FEW = 4
"""The maximum number of ranges for which each circle has an entry in the key."""
SHARED_LABEL = 0.1
"""The distance below which two positions share a label, as a fraction of the longest range."""
CONSISTENT_RESIDUAL = 1e-9
"""The largest residual of a consistent range or missing detection, as a fraction of R."""
Track = list[tuple[Pose, float | None]]
"""The odometry pose and the anchor range in m, or None out of range, at each tick."""


Status = Literal["kept", "rejected", "possible"]
"""The status of a branch at the end of phase 1; "possible" if phase 1 has not ended."""
WORDS: dict[Status, str] = {"kept": "selected", "rejected": "ruled out", "possible": "possible"}
CIRCLE_LINES: dict[Status, str] = {"kept": "-", "rejected": ":", "possible": "--"}


class DrawnBranch(NamedTuple):
    """A branch with its status and its name in the key."""

    branch: Branch
    status: Status
    name: str


def draw(pair: PairRecord, role: Role, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the branches, with circles of the measured ranges and of the sensing range."""
    state = _at_its_end(pair.states(role))
    if state is None:
        return Absent("the recording has no tick of the robot")
    branches = _branches(pair.states(role), state)
    if not branches:
        on_anchor = state.belief.branch_kind == "on-anchor"
        return Absent("the robot starts on its anchor" if on_anchor else "the robot has no second range")
    track = state.seen()
    reach = pair.mission.sensing_range
    points = [(x, y) for x in (-reach, reach) for y in (-reach, reach)]
    for one in branches:
        points += [(place.x, place.y) for place in _places(one.branch, track)]
    if state.belief.branch_kind == "three-ranges-virtual":
        virtual = branches[0].branch.distance(state.odometry)
        points += [(x, y) for x in (-virtual, virtual) for y in (-virtual, virtual)]
    sheet = Sheet(medium, True, [pair.title, _title(pair, role, state)])
    axes = sheet.panels["plane"]
    circle(axes, (0, 0), reach, lw=1.2, ls="-", color="k", gid="range", label=f"$R$ = {reach:g} m")
    axes.plot(0, 0, "x", color="k", ms=6, mew=1.4, ls="", gid="anchor", label=f"anchor ${ANCHORS[role]}$")
    _circles(axes, track, branches[0].branch, state.belief.branch_kind)
    for i, one in enumerate(branches):
        _draw(axes, role, one, track, pair.exact, named=i < 2 or pair.exact)
        if one.status == "rejected" and pair.exact:
            _contradictions(axes, one.branch, track, reach)
    _name_points(axes, track, branches[0].branch)
    sheet.plane("plane", around(points, 0.05), TALLEST_PHASE_ONE)
    sheet.key(axes)
    return sheet.finished()


def _at_its_end(states: Sequence[RobotState]) -> RobotState | None:
    """Return the state in the tick in which phase 1 ends, or the last state in phase 1."""
    for state in states:
        if state.belief.phase1_done_tick is not None:
            return state
    in_phase = [state for state in states if state.phase == 1]
    return in_phase[-1] if in_phase else None


def _branches(states: Sequence[RobotState], end: RobotState) -> list[DrawnBranch]:
    """Return the branches considered in phase 1, the selected one first."""
    if end.config.mission.noise.exact:
        branches = list(end.belief.possible)
        selected = end.belief.branch
    else:
        most = max([len(state.belief.branches) for state in states if state.tick <= end.tick], default=0)
        first = next((m for m in states if len(m.belief.branches) == most and m.tick <= end.tick), end)
        branches = list(first.belief.branches)
        selected = end.belief.branches[0] if end.belief.phase1_done_tick is not None else None
    if not branches:
        return []
    if selected is not None:
        branches.sort(key=lambda one: math.dist(one.anchor, selected.anchor))
        branches[0] = selected  # its estimate uses all measurements up to the end of phase 1
    statuses: list[Status] = ["possible" if selected is None else "rejected" for _ in branches]
    if selected is not None:
        statuses[0] = "kept"
    return [
        DrawnBranch(branch, status, _name(branch, branches, end))
        for branch, status in zip(branches, statuses, strict=True)
    ]


def _name(branch: Branch, branches: Sequence[Branch], end: RobotState) -> str:
    sign = "+" if branch.alpha >= 0.0 else "-"
    if end.config.mission.noise.exact:
        return rf"${sign}\alpha$, $\alpha = {abs(branch.alpha):.4f}$ rad"
    others = "other branch" if len(branches) == 2 else f"{len(branches) - 1} other branches"
    return "most probable branch" if branch is branches[0] else others


def _title(pair: PairRecord, role: Role, state: RobotState) -> str:
    robot = pair.robot(role).id
    frame = rf"$\langle\,{role}({ANCHORS[role]})\rangle$"
    if state.belief.phase1_done_tick is None:
        result = f"not finished at $k$ = {state.tick}"
    else:
        result = f"{_measurements(state)}, finished at $k$ = {state.belief.phase1_done_tick}"
    return f"Phase 1 of {robot} in {frame}: {result}"


def _measurements(state: RobotState) -> str:
    ranges = f"{len(state.log.ranges)} ranges"
    match state.belief.branch_kind:
        case "three-ranges-virtual":
            return f"{ranges} and a virtual one"
        case "circle":
            return f"{ranges} and no detection on the circle"
        case _:
            return ranges


def _places(branch: Branch, track: Track) -> list[Pose]:
    return [compose(branch.start, pose) for pose, _ in track]


def _circles(axes: Axes, track: Track, branch: Branch, kind: BranchKind | None) -> None:
    """Draw the ranges, including a virtual one, as circles about the anchor."""
    ranged = [(tick, rho) for tick, (_, rho) in enumerate(track) if rho is not None]
    styles = [(0, (6, 2)), (0, (3, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2))]
    for i, (tick, rho) in enumerate(ranged):
        named = i < FEW if len(ranged) <= FEW else i < 2
        circle(
            axes, (0, 0), rho, lw=0.9 if named else 0.4, ls=styles[i] if named else "-",
            color=PALE if named else PALER, gid=f"rho-{i}", zorder=1,
            label=rf"$\rho_{i}$ = {rho:.4f} m, $k$ = {tick}" if named else None,
        )  # fmt: skip
    if len(ranged) > FEW:
        axes.plot([], [], "-", lw=0.4, color=PALER, label=f"{len(ranged) - 2} more ranges")
    if kind == "three-ranges-virtual":
        rho = branch.distance(track[-1][0])
        circle(
            axes, (0, 0), rho, lw=0.9, ls=styles[3], color=PALE, gid="rho-virtual", zorder=1,
            label=rf"$\rho_{len(ranged)}$ = {rho:.4f} m, virtual, $k$ = {len(track) - 1}",
        )  # fmt: skip


def _draw(axes: Axes, role: Role, one: DrawnBranch, track: Track, exact: bool, named: bool) -> None:
    """Draw the path implied by a branch."""
    places, selected = _places(one.branch, track), one.status == "kept"
    colour = COLOURS[role] if selected else INK
    status = "discarded" if one.status == "rejected" and not exact else WORDS[one.status]
    axes.plot(
        [p.x for p in places], [p.y for p in places], CIRCLE_LINES[one.status], lw=1.5 if selected else 1.3,
        color=colour, zorder=3 if selected else 2, gid=one.status,
        label=f"{one.name}, {status}" if named else None,
    )  # fmt: skip
    ranged = [p for p, (_, rho) in zip(places, track, strict=True) if rho is not None]
    undetected = [p for p, (_, rho) in zip(places, track, strict=True) if rho is None]
    for points, face, gid in ((ranged, colour, "ranged"), (undetected, "white", "silent")):
        if points:
            axes.plot(
                [p.x for p in points], [p.y for p in points], ROLE_MARKERS[role]["marker"], ms=4, mfc=face,
                mec=colour, mew=1.0, ls="", zorder=4 if selected else 2.5, gid=f"{gid}-{one.status}",
                label=("range measured" if gid == "ranged" else "no detection") if selected else None,
            )  # fmt: skip


def _contradictions(axes: Axes, branch: Branch, track: Track, reach: float) -> None:
    """Mark the measurements that rule out `branch`."""
    against, places = contradicted(branch, track, reach), _places(branch, track)
    if against:
        ticks = ", ".join(map(str, against))
        axes.plot(
            [places[k].x for k in against], [places[k].y for k in against], "x", ms=8, mew=1.2, color=INK,
            ls="", zorder=5, gid="contradicted", label=f"ruled out by $k$ = {ticks}",
        )  # fmt: skip


def contradicted(branch: Branch, track: Track, reach: float) -> list[int]:
    """Return the ticks whose range, or missing detection within `reach` m, is inconsistent with `branch`."""
    return [
        tick
        for tick, (pose, rho) in enumerate(track)
        if (
            branch.distance(pose) <= reach * (1.0 - CONSISTENT_RESIDUAL)
            if rho is None
            else abs(branch.distance(pose) - rho) > CONSISTENT_RESIDUAL * reach
        )
    ]


def _name_points(axes: Axes, track: Track, branch: Branch) -> None:
    """Label p_0, p_1 and p_2, the positions of the first three ranges."""
    places = _places(branch, track)
    rim = max(rho for _, rho in track if rho is not None)
    named = [tick for tick, (_, rho) in enumerate(track) if rho is not None][:3]
    for i, tick in enumerate(named):
        place = places[tick]
        if any(travelled(place, places[other]) < SHARED_LABEL * rim for other in named[:i]):
            continue  # the robot has returned to a labelled position
        away = math.hypot(place.x, place.y) or 1.0
        axes.annotate(
            f"$p_{i}$", (place.x, place.y), xytext=(11 * place.x / away, 11 * place.y / away),
            textcoords="offset points", ha="center", va="center", zorder=6, gid=f"p-{i}", bbox=LABEL,
        )  # fmt: skip
