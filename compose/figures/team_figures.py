"""The figures of a team: anchors, paths and claims in the plane, and errors with sigmas over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from compose.figures.over_time import BAND_SIGMAS, FLOOR, QUANTITIES, TALL
from compose.figures.sheet import NO_TRUTH, Absent, Sheet, around, circle, entry, heading, trace
from compose.figures.style import INK, PALE, SCREEN, Medium
from compose.figures.trajectory import TALLEST_PLANE
from compose.recording.run import Run
from compose.recording.run_setup import RunSetup
from compose.view.colours import COLOURS
from compose.view.outlines import outline
from protocol.messages import Estimate

HUES = (*list(COLOURS.values())[:2], "#2a7f3f", "#7d4fb0", "#a67c00", "#0f8b8d", "#b03a7a", "#5b6470")
"""The colours of robots, in their order; of more, again from the first on: names tell them apart."""
SIGMAS: Any = (0, (4, 1.5))
CIRCLE: Any = {"ms": 8, "mfc": "none", "mec": INK, "mew": 1.1}
"""The looks of the lines of sigmas, and of claims."""
ARROW = 0.12
"""The length of a heading arrow, as a fraction of the sensing range."""


def trajectory(run: Run, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the plane: anchors with their sensing ranges, true paths and claims."""
    setup = run.setup
    if run.world is None or setup is None:
        return Absent(NO_TRUTH)
    sheet = Sheet(medium, True, [run.title(run.robots)])
    axes, reach = sheet.panels["plane"], setup.mission.sensing_range
    points = _anchors(sheet, setup)
    entry(axes, "start", "s", ms=5, mfc="white", mec=INK, mew=1.1)
    for robot, hue in _hues(run).items():
        path, claim = run.truth(robot), run.claim(robot)
        points += [(pose.x, pose.y) for pose in path]
        trace(
            axes, path, "-", lw=1.3, color=hue, zorder=3, gid=f"path-{robot}", label=f"true path of {robot}"
        )
        trace(axes, path[:1], "s", ms=5, mfc="white", mec=hue, mew=1.1, zorder=4, gid=f"released-{robot}")
        heading(axes, path[0], ARROW * reach, hue)
        sheet.label(robot, (path[0].x, path[0].y), color=hue)
        if claim is not None:
            spot = path[claim.tick : claim.tick + 1]
            trace(axes, spot, "*", ms=9, mfc=hue, mec="white", mew=0.6, zorder=6, gid=f"claim-{robot}")
            held = _held(run, robot).get(claim.tick)
            if held is not None and held.covariance is not None:
                corners = outline(held.world[0], held.covariance)
                axes.add_patch(Polygon(corners, fc="none", ec=hue, lw=0.9, zorder=5, gid=f"outline-{robot}"))
    entry(axes, "claim, with 3 sigma", "*", ms=8, mfc=PALE, mec="white")
    sheet.plane("plane", around(points, 0.04), TALLEST_PLANE)
    sheet.key(axes)
    return sheet.finished()


def _anchors(sheet: Sheet, setup: RunSetup) -> list[tuple[float, float]]:
    """Draw the anchors where they are, hollow if the robots do not know that, and return their places."""
    axes, reach = sheet.panels["plane"], setup.mission.sensing_range
    looks = {True: "anchor", False: "anchor at an unknown position"}
    for known, label in looks.items():
        if any((one.position is not None) == known for one in setup.anchors):
            entry(axes, label, "^", ms=6, mfc="k" if known else "white", mec="k")
    points: list[tuple[float, float]] = []
    for i, one in enumerate(setup.anchors):
        if (at := one.place or one.position) is None:
            continue
        place, colour = (at.x, at.y), "k" if one.position is not None else "white"
        points.append(place)
        axes.plot(*place, "^", ms=6, mfc=colour, mec="k", zorder=4, gid=f"anchor-{one.id}")
        sheet.label(one.id, place)
        name = f"sensing range, {reach:g} m" if i == 0 else None
        circle(axes, place, reach, ls=(0, (4, 3)), lw=0.7, color=PALE, gid=f"range-{one.id}", label=name)
    return points


def errors(run: Run, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the errors of the most probable poses, and of their sigmas."""
    if run.world is None:
        return Absent(NO_TRUTH)
    if not any(_held(run, robot) for robot in run.robots):
        return Absent("no robot has an estimate of its pose")
    mission = run.scenario.mission
    sheet = Sheet(medium, True, [run.title(run.robots)], [[name] for name in (*QUANTITIES, "key")])
    for name, quantity in QUANTITIES.items():
        axes = sheet.tall(name, TALL)
        for robot, hue in _hues(run).items():
            _errors(axes, run, robot, name, {"color": hue})
        if name == "position" and not mission.noise.exact:
            look: dict[str, Any] = {"ls": "-.", "lw": 0.9, "color": PALE, "zorder": 1, "gid": "accuracy"}
            axes.axhline(mission.accuracy, label=f"required sigma: {mission.accuracy:g} m", **look)
        axes.set(yscale="log", ylabel=f"{name} error [{quantity.unit}]", xlim=(-0.5, run.length - 0.5))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"tick ({mission.period:g} s)")
    axes = sheet.panels["position"]
    entry(axes, "3 sigma", ls=SIGMAS, lw=0.9, color=PALE)
    entry(axes, "claim", "o", **CIRCLE)
    sheet.key(axes)
    return sheet.finished()


def _errors(axes: Axes, run: Run, robot: str, name: str, look: dict[str, Any]) -> None:
    """Draw the errors and the sigmas of one robot."""
    path, claim, error = run.truth(robot), run.claim(robot), QUANTITIES[name].error
    held = {tick: one for tick, one in _held(run, robot).items() if tick < len(path)}
    off = [(tick, max(error(one.world[0], path[tick]), FLOOR)) for tick, one in held.items()]
    sigmas = [
        (tick, BAND_SIGMAS * getattr(one.covariance, f"{name}_sigma"))
        for tick, one in held.items()
        if one.covariance is not None
    ]
    if off:
        marks: Any = {"lw": 1.3, "marker": ".", "ms": 4, "gid": f"{name}-{robot}", "label": robot}
        axes.plot(*zip(*off, strict=True), **marks, **look)
    if sigmas:
        marks = {"lw": 0.9, "ls": SIGMAS, "gid": f"{name}-sigma-{robot}"}
        axes.plot(*zip(*sigmas, strict=True), **marks, **look)
    if claim is not None:
        at = max(getattr(claim, f"{name}_error"), FLOOR)
        axes.plot(claim.tick, at, "o", gid=f"claim-{name}-{robot}", zorder=5, **CIRCLE)


def _held(run: Run, robot: str) -> Mapping[int, Estimate]:
    """Return the journaled estimates that have poses, by tick; none without a readable journal."""
    if robot not in run.agents:
        return {}
    return {one.tick: one for one in run.agents[robot].estimates if one.world}


def _hues(run: Run) -> dict[str, str]:
    return {robot: HUES[i % len(HUES)] for i, robot in enumerate(run.robots)}


DRAWN: dict[str, Callable[[Run, Medium], Figure | Absent]] = {"trajectory": trajectory, "errors": errors}
"""The figures of a team, by kind."""
