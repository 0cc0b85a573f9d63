"""The encounter in panels, one per mutual range, like Figs. 3(d) and 4(c), or one per decision under noise.

The decisions of phase 3, in place of Fig. 3(c), are shown with their hypotheses and the chosen manoeuvres.
"""

from __future__ import annotations

import math

from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from agent.planning.state import RobotState
from agent.planning.strides import stride
from agent.planning.tasks import Surveying
from compose.figures.one_robot import outline_of
from compose.figures.pair import PairRecord
from compose.figures.sheet import (
    NO_ENCOUNTER,
    NO_PLACES,
    Absent,
    circle,
    entry,
    heading,
    series,
    some,
    square,
    trace,
)
from compose.figures.style import INK, PALE, PALER, ROLE_MARKERS, SCREEN, Medium
from compose.figures.trajectory import draw_trail
from compose.view.colours import COLOURS, line_style
from protocol.mission import ROLES, Role
from protocol.motion import Pose, step

BEFORE = 2
"""The number of ticks shown before the encounter."""
WINDOW_ARROW = 0.12
"""The length of a heading arrow, as a fraction of the window's width."""
SEGMENTS_PER_TICK = 12
"""The number of line segments per tick of a drawn manoeuvre."""
SHOWN_PROBABILITY = 1e-3
"""The minimum probability of a hypothesis that the panels' window must contain."""
FARTHEST_SHOWN = 4.0
"""The maximum distance of such a hypothesis from the second anchor, in units of D + R.

The first fit of a meeting after a long way may be farther off, with a sigma as large.
"""
Decision = dict[Role, RobotState]
"""The states of the robots that scored hypotheses of both poses and chose a manoeuvre in one tick."""


# --- mutual ranges ----------------------------------------------------------------------------------


def draw(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the mutual ranges measured from new positions."""
    if not pair.placed:
        return Absent(NO_PLACES)
    ticks = steps(pair)
    if not ticks:
        return Absent(NO_ENCOUNTER if pair.encounter_tick is None else "the encounter has no mutual range")
    shown, begin = some(ticks), max(0, ticks[0] - BEFORE)
    many = f"{len(shown)} of {len(ticks)} mutual ranges" if len(shown) < len(ticks) else "mutual ranges"
    title = f"Encounter: {many}, $k$ = {ticks[0]} to {ticks[-1]}"
    if len(ticks) == 1:
        title = f"Encounter: mutual range at $k$ = {ticks[0]}"
    ends = [(p.x, p.y) for role in ROLES for p in pair.robot(role).path[begin : shown[-1] + 1]]
    window = square(ends, 0.12, 0.2 * pair.mission.sensing_range)
    captions = [_caption(pair, tick, i + 1) for i, tick in enumerate(shown)]
    sheet, panels = series(medium, [pair.title, title], captions, window)
    for axes, before, tick in zip(panels, [shown[0], *shown], shown, strict=False):
        _step(axes, pair, range(begin, before + 1), tick, WINDOW_ARROW * (window[1] - window[0]))
    axes = panels[-1]
    for role in ROLES:
        marker = ROLE_MARKERS[role]["marker"]
        entry(axes, pair.robot(role).id, marker, ls="-", lw=1.6, ms=5, color=COLOURS[role])
    entry(axes, "no range", "o", ms=3.6, mfc="white", mec=INK)
    entry(axes, "mutual range", ":", color=INK, lw=1.3)
    entry(axes, "heading", ls="", marker=r"$\rightarrow$", ms=10, color=PALE)
    entry(axes, "orbits", lw=0.6, color=PALE)
    for phase in (2, 3):
        entry(axes, f"path in phase {phase}", ls=line_style(phase), lw=1.2, color=PALE)
    sheet.key(axes)
    return sheet.finished()


def steps(pair: PairRecord) -> list[int]:
    """Return the ticks of phase 3 with a mutual range whose positions differ from the previous one's."""
    ticks: list[int] = []
    places: object = None
    first = pair.placed if pair.encounter_tick is None else pair.encounter_tick
    for tick in range(first, min(len(pair.mutual), pair.placed)):
        here = [pair.robot(role).path[tick] for role in ROLES]
        if pair.mutual[tick][1] is not None and here != places:
            ticks.append(tick)
            places = here
    return ticks


def _caption(pair: PairRecord, tick: int, number: int) -> str:
    """Return the caption of a panel: the range, and the state of each robot's command."""
    commands = {pair.robot(role).id: pair.command(role, tick) for role in ROLES}
    states = [f"{one}: {command.task if command else 'no command'}" for one, command in commands.items()]
    return "\n".join([rf"({number}) $k$ = {tick}, $\rho$ = {pair.mutual[tick][1]:.4f} m", *states])


def _step(axes: Axes, pair: PairRecord, before: range, tick: int, arrow: float) -> None:
    """Draw the paths up to `tick`, pale in the ticks `before`, and filled where a range was measured."""
    ends = [pair.robot(role).path[tick] for role in ROLES]
    for role, now in zip(ROLES, ends, strict=True):
        one, colour, marker = pair.robot(role), COLOURS[role], ROLE_MARKERS[role]["marker"]
        if one.on_orbit:
            circle(axes, (one.anchor.x, one.anchor.y), one.orbit.radius, lw=0.6, color=colour, alpha=0.5)
        draw_trail(axes, one, role, before, alpha=0.4)
        draw_trail(axes, one, role, range(before[-1], tick + 1), lw=1.8)
        for k in range(before[0], tick):
            face = "white" if pair.mutual[k][1] is None else colour
            trace(axes, [one.path[k]], marker, ms=3.6, mfc=face, mec=colour, mew=0.9, zorder=4)
        trace(axes, [now], marker, ms=6.5, mfc=colour, mec="white", mew=0.7, zorder=5)
        heading(axes, now, arrow, colour, zorder=6)
    trace(axes, ends, ":", color=INK, lw=1.3, zorder=3, gid=f"rho-{tick}")


# --- decisions under noise --------------------------------------------------------------------------


def decisions(pair: PairRecord) -> dict[int, Decision]:
    """Return the decisions of phase 3, by tick."""
    found: dict[int, Decision] = {}
    for role in ROLES:
        before: object = ()
        for state in pair.states(role):
            hypotheses = state.posterior.pair
            surveys = isinstance(state.task, Surveying) and state.phase == 3
            if hypotheses and hypotheses is not before and (surveys or state.verdict is not None):
                found.setdefault(state.tick, {})[role] = state
            before = hypotheses
    return dict(sorted(found.items()))


def draw_decisions(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the hypotheses and the chosen manoeuvres."""
    found = list(decisions(pair).items())
    if not found:
        why = pair.unknown or "no robot scored hypotheses of the pair"
        return Absent(NO_ENCOUNTER if pair.encounter_tick is None else why)
    shown = some(found)
    many = f"{len(shown)} of" if len(shown) < len(found) else "all"
    title = f"Hypotheses of the pair and chosen manoeuvres: {many} {len(found)} decisions"
    captions = [_decided(tick, made, i + 1) for i, (tick, made) in enumerate(shown)]
    anchors = [(pair.robot(role).anchor.x, pair.robot(role).anchor.y) for role in ROLES]
    points = [(p.x, p.y) for tick, made in shown for p in _seen(pair, tick, made)]
    farthest = FARTHEST_SHOWN * (math.dist(*anchors) + pair.mission.sensing_range)
    points = [point for point in points if math.dist(point, anchors[1]) <= farthest]
    window = square(points, 0.16, 0.5 * pair.mission.sensing_range)
    sheet, panels = series(medium, [pair.title, title], captions, window)
    for axes, (tick, made) in zip(panels, shown, strict=True):
        for anchor in anchors:
            axes.plot(*anchor, "x", color="k", ms=5, mew=1.2, zorder=2)
            circle(axes, anchor, pair.mission.sensing_range, ls=(0, (4, 3)), lw=0.8, color=PALE, zorder=1)
        _decision(axes, pair, tick, made)
    axes = panels[-1]
    for role in ROLES:
        marker = ROLE_MARKERS[role]["marker"]
        entry(axes, f"{pair.robot(role).id}, most probable", marker, ms=7, color=COLOURS[role])
    entry(axes, "its 3 sigma", "-", lw=0.8, color=PALE)
    entry(axes, "less probable", "o", ms=4, mfc="white", mec=PALE)
    entry(axes, "chosen manoeuvre", "x-", ms=6, mew=1.5, lw=1.6, color=PALE)
    entry(axes, "true" if pair.true else "from the claim", "+", ms=9, mew=1.2, color=INK)
    entry(axes, "anchor", "x", ms=6, mew=1.4, color="k")
    sheet.key(axes)
    return sheet.finished()


def _decided(tick: int, made: Decision, number: int) -> str:
    state = next(iter(made.values()))
    count, probability = len(state.posterior.pair), state.posterior.pair[0].probability
    hypotheses = f"{count} hypotheses" if count > 1 else "1 hypothesis"
    claim = ", claim" if any(state.verdict is not None for state in made.values()) else ""
    first = f"{hypotheses}, first {math.floor(1e4 * probability) / 100:g} %{claim}"
    return f"({number}) $k$ = {tick}, {len(state.mutual)} mutual ranges\n{first}"


def _seen(pair: PairRecord, tick: int, made: Decision) -> list[Pose]:
    """Return the poses that the window contains: true ones, probable ones, and ends of manoeuvres."""
    poses = list(_places(pair, tick).values())
    for state in made.values():
        held = zip(state.posterior.poses, state.posterior.pair, strict=True)
        poses += [pose for pose, one in held if one.probability >= SHOWN_PROBABILITY] + _ends(state, pair)
    return poses


def _decision(axes: Axes, pair: PairRecord, tick: int, made: Decision) -> None:
    """Draw the hypotheses, the larger the more probable, joined if both robots have the same ones."""
    held = [[one.fit.poses.tolist() for one in state.posterior.pair] for state in made.values()]
    if len(held) == 2 and held[0] == held[1]:
        for two in zip(*[state.posterior.poses for state in made.values()], strict=True):
            trace(axes, two, "-", lw=0.7, color=PALER, zorder=3)
    for role, state in made.items():
        colour = COLOURS[role]
        for estimate, _ in pair.robot(role).likeliest:
            if estimate.tick == tick and (points := outline_of(estimate)):
                axes.add_patch(
                    Polygon(
                        list(points), facecolor=to_rgba(colour, 0.12), edgecolor=colour, lw=0.8, zorder=2.5,
                        gid=f"sigma-{tick}-{role}",
                    )
                )  # fmt: skip
        for i, (pose, one) in enumerate(zip(state.posterior.poses, state.posterior.pair, strict=True)):
            trace(
                axes, [pose], ROLE_MARKERS[role]["marker"], ms=2.5 + 4.5 * math.sqrt(one.probability),
                mfc="white" if i else colour, mec=colour, mew=0.9, zorder=4 if i else 5,
                gid=f"hypothesis-{tick}-{role}-{i + 1}",
            )  # fmt: skip
        if ends := _ends(state, pair):
            trace(axes, ends, "-", lw=1.6, color=colour, zorder=3)
            trace(axes, ends[-1:], "x", ms=6, mew=1.5, color=colour, zorder=5, gid=f"chosen-{tick}-{role}")
    for role, truth in _places(pair, tick).items():
        trace(axes, [truth], "+", ms=9, mew=1.2, color=INK, zorder=6, gid=f"truth-{tick}-{role}")


def _places(pair: PairRecord, tick: int) -> dict[Role, Pose]:
    """Return the true pose of each robot; in hardware mode, the pose implied by its claim, if it has one."""
    paths = {role: pair.robot(role).path for role in ROLES}
    return {role: path[tick] for role, path in paths.items() if tick < len(path)}


def _ends(state: RobotState, pair: PairRecord) -> list[Pose]:
    """Return poses along the chosen manoeuvre from the most probable pose; empty if none was chosen."""
    if not isinstance(state.task, Surveying) or not state.posterior.poses:
        return []
    command, ticks = state.task.command, stride(pair.mission)
    start, pieces = state.posterior.poses[0], SEGMENTS_PER_TICK * ticks
    times = [ticks * pair.mission.period * i / pieces for i in range(pieces + 1)]
    return [step(start, command.v, command.omega, time) for time in times]
