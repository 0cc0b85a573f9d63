"""The encounter step by step, like Figs. 3(d) and 4(c), with one panel per mutual range."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compose.figures.pair import ROLES, PairRecord
from compose.figures.series import Series, some, square
from compose.figures.sheet import NO_ENCOUNTER, NO_PLACES, Absent, Window, circle
from compose.figures.style import COLOURS, DASHES, INK, MARKS, PALE
from compose.figures.trajectory import heading
from protocol.mission import Role
from protocol.motion import Pose

WIDTH, NARROWEST = 2.35, 5.4
"""The maximum width of a panel and the minimum width of the figure, in inches."""
BEFORE = 2
"""The number of ticks shown before the encounter."""
ARROW = 0.12
"""The length of a heading arrow, as a fraction of the window's width."""


def draw(pair: PairRecord) -> Figure | Absent:
    """Return the figure of the mutual ranges measured from new positions."""
    if not pair.placed:
        return Absent(NO_PLACES)
    ticks = steps(pair)
    if not ticks:
        return Absent(NO_ENCOUNTER if pair.encounter_tick is None else "the encounter has no mutual range")
    shown = some(ticks)
    window = _window(pair, ticks[0], shown[-1])
    series = Series(len(shown), window, WIDTH, NARROWEST, [pair.title, _title(ticks, shown)])
    for i, tick in enumerate(shown):
        axes = series.panel(i, _panel_title(pair, tick, i + 1))
        _panel(axes, pair, ticks[0], shown[i - 1] if i else tick, tick)
    _key(axes, pair)
    series.key(axes)
    return series.figure


def steps(pair: PairRecord) -> list[int]:
    """Return the ticks of phase 3 with a mutual range whose positions differ from the previous one's."""
    if pair.encounter_tick is None:
        return []
    ticks: list[int] = []
    for tick in range(pair.encounter_tick, min(pair.last + 1, pair.placed)):
        if pair.mutual[tick][1] is None:
            continue
        if ticks and all(pair.robot(role).path[ticks[-1]] == pair.robot(role).path[tick] for role in ROLES):
            continue
        ticks.append(tick)
    return ticks


def _window(pair: PairRecord, first: int, last: int) -> Window:
    ends = [pose for role in ROLES for pose in pair.robot(role).path[max(0, first - BEFORE) : last + 1]]
    return square([(p.x, p.y) for p in ends], 0.12, 0.2 * pair.mission.sensing_range)


def _title(ticks: list[int], shown: list[int]) -> str:
    if len(ticks) == 1:
        return f"Encounter: mutual range at $k$ = {ticks[0]}"
    many = f"{len(shown)} of {len(ticks)} mutual ranges" if len(shown) < len(ticks) else "mutual ranges"
    return f"Encounter: {many}, $k$ = {ticks[0]} to {ticks[-1]}"


def _panel_title(pair: PairRecord, tick: int, number: int) -> str:
    """Return the title of a panel: the range, and the state of each robot's command."""
    rho = pair.mutual[tick][1]
    states = []
    for role in ROLES:
        command = pair.command(role, tick)
        states.append(f"{pair.robot(role).id}: {command.state if command is not None else 'no command'}")
    return f"({number}) $k$ = {tick}, " + rf"$\rho$ = {rho:.4f} m" + "\n" + ", ".join(states)


def _panel(axes: Axes, pair: PairRecord, first: int, before: int, tick: int) -> None:
    for role in ROLES:
        one = pair.robot(role)
        place = (one.anchor.x, one.anchor.y)
        circle(
            axes,
            place,
            one.orbit.radius,
            lw=0.9,
            ls=DASHES[role],
            color=COLOURS[role],
            zorder=1,
        )
        poses = pair.robot(role).path
        _trail(axes, poses[max(0, first - BEFORE) : before + 1], 1.0, PALE)
        _trail(axes, poses[before : tick + 1], 2.0, COLOURS[role])
        for k in range(max(0, first - BEFORE), tick + 1):
            _place(axes, role, poses[k], ranged=pair.mutual[k][1] is not None, now=k == tick)
    ends = [pair.robot(role).path[tick] for role in ROLES]
    axes.plot([p.x for p in ends], [p.y for p in ends], ":", color=INK, lw=1.4, zorder=3, gid=f"rho-{tick}")
    left, right, _, _ = _window(pair, first, tick)
    for role, pose in zip(ROLES, ends, strict=True):
        heading(axes, pose, ARROW * (right - left), COLOURS[role], zorder=6)


def _trail(axes: Axes, poses: Sequence[Pose], width: float, colour: str) -> None:
    moved = [pose for before, pose in pairwise(poses) if pose != before]
    if moved:
        places = [poses[0], *moved]
        axes.plot([p.x for p in places], [p.y for p in places], "-", lw=width, color=colour, zorder=2)


def _place(axes: Axes, role: Role, pose: Pose, ranged: bool, now: bool) -> None:
    """Mark a position: filled if a mutual range was measured there, large if it is the current one."""
    colour = COLOURS[role]
    axes.plot(
        pose.x, pose.y, MARKS[role]["marker"], ms=7.5 if now else 4, mfc=colour if ranged else "white",
        mec="white" if now and ranged else colour, mew=0.7 if now else 1.0, ls="", zorder=5 if now else 4,
    )  # fmt: skip


def _key(axes: Axes, pair: PairRecord) -> None:
    for role in ROLES:
        axes.plot(
            [],
            [],
            MARKS[role]["marker"],
            ls="-",
            lw=1.6,
            ms=6,
            color=COLOURS[role],
            label=pair.robot(role).id,
        )
    axes.plot([], [], "o", ls="", ms=4, mfc="white", mec=INK, label="no range")
    axes.plot([], [], ":", color=INK, lw=1.4, label="mutual range")
    axes.plot([], [], ls="", marker=r"$\rightarrow$", ms=12, color=PALE, label="heading")
    axes.plot([], [], ls=DASHES["a"], color=PALE, lw=0.9, label="orbits")
