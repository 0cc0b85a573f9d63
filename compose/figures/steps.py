"""The encounter step by step, like Figs. 3(d) and 4(c), with one panel per mutual range."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compose.figures.pair import PairRecord
from compose.figures.sheet import NO_ENCOUNTER, NO_PLACES, Absent, Window, circle, series, some, square
from compose.figures.style import INK, PALE, ROLE_MARKERS, SCREEN, Medium
from compose.figures.trajectory import draw_trail, heading
from compose.view.colours import COLOURS, line_style
from protocol.mission import ROLES, Role

BEFORE = 2
"""The number of ticks shown before the encounter."""
WINDOW_ARROW = 0.12
"""The length of a heading arrow, as a fraction of the window's width."""


def draw(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the mutual ranges measured from new positions."""
    if not pair.placed:
        return Absent(NO_PLACES)
    ticks = steps(pair)
    if not ticks:
        return Absent(NO_ENCOUNTER if pair.encounter_tick is None else "the encounter has no mutual range")
    shown = some(ticks)
    window = _window(pair, ticks[0], shown[-1])
    captions = [_caption(pair, tick, i + 1) for i, tick in enumerate(shown)]
    sheet, panels = series(medium, [pair.title, _title(ticks, shown)], captions, window)
    for i, tick in enumerate(shown):
        _panel(panels[i], pair, ticks[0], shown[i - 1] if i else tick, tick)
    _key(panels[-1], pair)
    sheet.key(panels[-1])
    return sheet.finished()


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


def _caption(pair: PairRecord, tick: int, number: int) -> str:
    """Return the caption of a panel: the range, and the state of each robot's command."""
    rho = pair.mutual[tick][1]
    states = []
    for role in ROLES:
        command = pair.command(role, tick)
        states.append(f"{pair.robot(role).id}: {command.task if command is not None else 'no command'}")
    return "\n".join([rf"({number}) $k$ = {tick}, $\rho$ = {rho:.4f} m", *states])


def _panel(axes: Axes, pair: PairRecord, first: int, before: int, tick: int) -> None:
    begin = max(0, first - BEFORE)
    for role in ROLES:
        one, colour = pair.robot(role), COLOURS[role]
        if one.on_orbit:
            circle(axes, (one.anchor.x, one.anchor.y), one.orbit.radius, lw=0.6, color=colour, alpha=0.5)
        draw_trail(axes, one, role, range(begin, before + 1), alpha=0.4)
        draw_trail(axes, one, role, range(before, tick + 1), lw=1.8)
        for ranged in (True, False):
            ticks = [k for k in range(begin, tick) if (pair.mutual[k][1] is not None) == ranged]
            _places(axes, pair, role, ticks, ranged=ranged)
        now = one.path[tick]
        axes.plot(
            now.x,
            now.y,
            ROLE_MARKERS[role]["marker"],
            ms=6.5,
            mfc=colour,
            mec="white",
            mew=0.7,
            ls="",
            zorder=5,
        )
    ends = [pair.robot(role).path[tick] for role in ROLES]
    axes.plot([p.x for p in ends], [p.y for p in ends], ":", color=INK, lw=1.3, zorder=3, gid=f"rho-{tick}")
    left, right, _, _ = _window(pair, first, tick)
    for role, pose in zip(ROLES, ends, strict=True):
        heading(axes, pose, WINDOW_ARROW * (right - left), COLOURS[role], zorder=6)


def _places(axes: Axes, pair: PairRecord, role: Role, ticks: list[int], *, ranged: bool) -> None:
    """Mark earlier positions, filled if a mutual range was measured there."""
    poses, colour = [pair.robot(role).path[k] for k in ticks], COLOURS[role]
    axes.plot(
        [p.x for p in poses], [p.y for p in poses], ROLE_MARKERS[role]["marker"], ms=3.6,
        mfc=colour if ranged else "white", mec=colour, mew=0.9, ls="", zorder=4,
    )  # fmt: skip


def _key(axes: Axes, pair: PairRecord) -> None:
    for role in ROLES:
        axes.plot(
            [],
            [],
            ROLE_MARKERS[role]["marker"],
            ls="-",
            lw=1.6,
            ms=5,
            color=COLOURS[role],
            label=pair.robot(role).id,
        )
    axes.plot([], [], "o", ls="", ms=3.6, mfc="white", mec=INK, label="no range")
    axes.plot([], [], ":", color=INK, lw=1.3, label="mutual range")
    axes.plot([], [], ls="", marker=r"$\rightarrow$", ms=10, color=PALE, label="heading")
    axes.plot([], [], lw=0.6, color=PALE, label="orbits")
    for phase in (2, 3):
        axes.plot([], [], ls=line_style(phase), lw=1.2, color=PALE, label=f"path in phase {phase}")
