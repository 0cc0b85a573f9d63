"""Phase 1 of a robot in the frame of its anchor, as Fig. 3(b) shows it, with both branches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.estimation.exact import Branch
from agent.planning.range_seeking import travelled
from agent.planning.state import RobotState
from compose.figures.pair import PairRecord
from compose.figures.sheet import ANCHORS, Absent, Sheet, around, circle, equal, fitted
from compose.figures.style import COLOURS, INK, MARKS, PALE, PALER
from protocol.messages import BranchKind
from protocol.mission import Role
from protocol.motion import Pose, compose

WIDTH, BESIDE, TALLEST = 4.3, 2.5, 4.6
FEW = 4
"""ranges of which each ring is named"""
SAME = 0.03
"""of the longest range: places nearer than this share a name"""
EXPLAINED = 1e-9
"""of R: ranges and silence that differ by less are drawn as explained"""
Seen = list[tuple[Pose, float | None]]


Fate = Literal["kept", "rejected", "possible"]
"""what phase 1 made of a branch; possible, where it is not over"""
WORDS: dict[Fate, str] = {"kept": "kept", "rejected": "ruled out", "possible": "possible"}
LINES: dict[Fate, str] = {"kept": "-", "rejected": ":", "possible": "--"}


class DrawnBranch(NamedTuple):
    """A branch, as it is drawn."""

    branch: Branch
    fate: Fate
    name: str


def draw(pair: PairRecord, role: Role) -> Figure | Absent:
    """The branches, the rings of the ranges, and the sensing range."""
    state = _at_its_end(pair.states(role))
    if state is None:
        return Absent("there is no tick of it on record")
    told = _told(pair.states(role), state)
    if not told:
        why = (
            "it began on its anchor" if state.belief.branch_kind == "on-anchor" else "it has no second range"
        )
        return Absent(why)
    seen = state.seen()
    reach = pair.mission.sensing_range
    points = [(x, y) for x in (-reach, reach) for y in (-reach, reach)]
    for one in told:
        points += [(place.x, place.y) for place in _places(one.branch, seen)]
    if state.belief.branch_kind == "three-ranges-virtual":
        virtual = told[0].branch.distance(state.odometry)
        points += [(x, y) for x in (-virtual, virtual) for y in (-virtual, virtual)]
    window = around(points, 0.05)
    width, height = fitted(window, WIDTH, TALLEST)
    sheet = Sheet(0.6 + width + BESIDE, 0.5 + height, [pair.title, _title(pair, role, state)])
    axes = sheet.panel(0.55, 0.42, width, height)
    circle(axes, (0, 0), reach, lw=1.2, ls="-", color="k", gid="range", label=f"$R$ = {reach:g} m")
    axes.plot(0, 0, "x", color="k", ms=7, mew=1.6, ls="", gid="anchor", label=f"anchor ${ANCHORS[role]}$")
    _rings(axes, seen, told[0].branch, state.belief.branch_kind)
    for i, one in enumerate(told):
        _draw(axes, role, one, seen, pair.exact, named=i < 2 or pair.exact)
        if one.fate == "rejected" and pair.exact:
            _contradictions(axes, one.branch, seen, reach)
    _name_points(axes, seen, told[0].branch)
    equal(axes, window)
    axes.set_xlabel("$x$ [m]")
    axes.set_ylabel("$y$ [m]")
    sheet.key(axes, 0.55 + width + 0.12, 0.42 + height)
    return sheet.figure


def _at_its_end(states: Sequence[RobotState]) -> RobotState | None:
    """The mind in the tick in which phase 1 is over; or the last there is of it."""
    for state in states:
        if state.belief.phase1_done_tick is not None:
            return state
    alone = [state for state in states if state.phase == 1]
    return alone[-1] if alone else None


def _told(states: Sequence[RobotState], end: RobotState) -> list[DrawnBranch]:
    """The branches that were held, the one that was kept first."""
    if end.config.mission.noise.exact:
        held = list(end.belief.possible)
        kept = end.belief.branch
    else:
        most = max([len(state.belief.branches) for state in states if state.tick <= end.tick], default=0)
        first = next((m for m in states if len(m.belief.branches) == most and m.tick <= end.tick), end)
        held = list(first.belief.branches)
        kept = end.belief.branches[0] if end.belief.phase1_done_tick is not None else None
    if not held:
        return []
    if kept is not None:
        held.sort(key=lambda one: math.dist(one.anchor, kept.anchor))
        held[0] = kept  # polished by what came since
    fates: list[Fate] = ["possible" if kept is None else "rejected" for _ in held]
    if kept is not None:
        fates[0] = "kept"
    return [
        DrawnBranch(branch, fate, _name(branch, held, end)) for branch, fate in zip(held, fates, strict=True)
    ]  # fmt: skip


def _name(branch: Branch, held: Sequence[Branch], end: RobotState) -> str:
    sign = "+" if branch.alpha >= 0.0 else "-"
    if end.config.mission.noise.exact:
        return rf"${sign}\alpha$, $\alpha = {abs(branch.alpha):.4f}$ rad"
    others = "another" if len(held) == 2 else f"{len(held) - 1} others"
    return "the likeliest" if branch is held[0] else others


def _title(pair: PairRecord, role: Role, state: RobotState) -> str:
    robot = pair.robot(role).id
    frame = rf"$\langle {role}({ANCHORS[role]})\rangle$"
    if state.belief.phase1_done_tick is None:
        how = f"not over at $k$ = {state.tick}"
    else:
        how = f"{_how(state)}, over at $k$ = {state.belief.phase1_done_tick}"
    return f"Phase 1 of {robot} in {frame}: {how}"


def _how(state: RobotState) -> str:
    ranges = f"{len(state.log.ranges)} ranges"
    match state.belief.branch_kind:
        case "three-ranges-virtual":
            return f"{ranges} and a virtual one"
        case "circle":
            return f"{ranges}, and silence on the circle"
        case _:
            return ranges


def _places(branch: Branch, seen: Seen) -> list[Pose]:
    return [compose(branch.start, pose) for pose, _ in seen]


def _rings(axes: Axes, seen: Seen, branch: Branch, kind: BranchKind | None) -> None:
    """The ranges, as circles about the anchor; the virtual one too."""
    ranged = [(tick, rho) for tick, (_, rho) in enumerate(seen) if rho is not None]
    styles = [(0, (6, 2)), (0, (3, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2))]
    for i, (tick, rho) in enumerate(ranged):
        named = i < FEW if len(ranged) <= FEW else i < 2
        circle(
            axes, (0, 0), rho, lw=0.9 if named else 0.4, ls=styles[i] if named else "-",
            color=PALE if named else PALER, gid=f"rho-{i}", zorder=1,
            label=rf"$\rho_{i}$ = {rho:.4f} m, $k$ = {tick}" if named else None,
        )  # fmt: skip
    if len(ranged) > FEW:
        axes.plot([], [], "-", lw=0.4, color=PALER, label=f"{len(ranged) - 2} ranges more")
    if kind == "three-ranges-virtual":
        rho = branch.distance(seen[-1][0])
        circle(
            axes, (0, 0), rho, lw=0.9, ls=styles[3], color=PALE, gid="rho-virtual", zorder=1,
            label=rf"$\rho_{len(ranged)}$ = {rho:.4f} m, virtual, $k$ = {len(seen) - 1}",
        )  # fmt: skip


def _draw(axes: Axes, role: Role, one: DrawnBranch, seen: Seen, exact: bool, named: bool) -> None:
    """The path that it says was driven."""
    places, kept = _places(one.branch, seen), one.fate == "kept"
    colour = COLOURS[role] if kept else INK
    fate = "given up" if one.fate == "rejected" and not exact else WORDS[one.fate]
    axes.plot(
        [p.x for p in places], [p.y for p in places], LINES[one.fate], lw=1.5 if kept else 1.3, color=colour,
        zorder=3 if kept else 2, gid=one.fate, label=f"{one.name}, {fate}" if named else None,
    )  # fmt: skip
    ranged = [p for p, (_, rho) in zip(places, seen, strict=True) if rho is not None]
    silent = [p for p, (_, rho) in zip(places, seen, strict=True) if rho is None]
    for points, face, gid in ((ranged, colour, "ranged"), (silent, "white", "silent")):
        if points:
            axes.plot(
                [p.x for p in points], [p.y for p in points], MARKS[role]["marker"], ms=5, mfc=face,
                mec=colour, mew=1.0, ls="", zorder=4 if kept else 2.5, gid=f"{gid}-{one.fate}",
                label=("ranged" if gid == "ranged" else "silent: out of range") if kept else None,
            )  # fmt: skip


def _contradictions(axes: Axes, branch: Branch, seen: Seen, reach: float) -> None:
    against, places = contradicted(branch, seen, reach), _places(branch, seen)
    if against:
        ticks = ", ".join(map(str, against))
        axes.plot(
            [places[k].x for k in against], [places[k].y for k in against], "x", ms=9, mew=1.3, color=INK,
            ls="", zorder=5, gid="contradicted", label=f"what rules it out: $k$ = {ticks}",
        )  # fmt: skip


def contradicted(branch: Branch, seen: Seen, reach: float) -> list[int]:
    """The ticks whose range, or silence, `branch` does not explain."""
    return [
        tick
        for tick, (pose, rho) in enumerate(seen)
        if (
            branch.distance(pose) <= reach * (1.0 - EXPLAINED)
            if rho is None
            else abs(branch.distance(pose) - rho) > EXPLAINED * reach
        )
    ]


def _name_points(axes: Axes, seen: Seen, branch: Branch) -> None:
    """p_0 and the places of the next ranges."""
    places = _places(branch, seen)
    rim = max(rho for _, rho in seen if rho is not None)
    named = [tick for tick, (_, rho) in enumerate(seen) if rho is not None][:3]
    for i, tick in enumerate(named):
        place = places[tick]
        if any(travelled(place, places[other]) < SAME * rim for other in named[:i]):
            continue  # back where it was
        away = math.hypot(place.x, place.y) or 1.0
        axes.annotate(
            f"$p_{i}$", (place.x, place.y), xytext=(11 * place.x / away, 11 * place.y / away),
            textcoords="offset points", fontsize=9, ha="center", va="center", zorder=6, gid=f"p-{i}",
            bbox={"facecolor": "white", "alpha": 0.75, "pad": 0.4, "lw": 0},
        )  # fmt: skip
