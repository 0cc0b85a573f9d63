"""The thumbnail of a recording: anchors, sensing ranges and true paths as a small picture."""

from __future__ import annotations

from collections.abc import Sequence

from compose.recording.run_setup import RunSetup
from compose.view import colours
from compose.view.outlines import box
from compose.view.run_data import RunData
from protocol.messages import Localised
from protocol.mission import Role
from protocol.motion import Pose

WIDTH, HEIGHT = 160, 100
"""The size in pixels."""
MOST_POINTS = 200
"""The largest number of points of a path: more would not be visible."""
MOST_ROBOTS = 40
"""The largest number of robots that are drawn."""


def thumbnail(setup: RunSetup, known: RunData) -> str:
    """Return the picture of a run as SVG."""
    shown = box(setup)
    scale = min(WIDTH / shown.width, HEIGHT / shown.height) * 0.96

    def at(x: float, y: float) -> tuple[float, float]:
        return WIDTH / 2 + (x - shown.x) * scale, HEIGHT / 2 - (y - shown.y) * scale

    hues = _hues(setup, known)
    parts = []
    for robot in setup.anchored[:MOST_ROBOTS]:
        colour = colours.COLOURS[hues[robot.id]]
        x, y = at(robot.anchor.x, robot.anchor.y)
        radius = setup.mission.sensing_range * scale
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{colour}" fill-opacity="0.07" '
            f'stroke="{colour}" stroke-width="0.5"/>'
            f'<path d="M{x:.1f} {y - 3:.1f}l2.6 4.5h-5.2z" fill="#1b1d22"/>'
        )
    for robot in setup.robots[:MOST_ROBOTS]:
        ticks = [known.ticks[tick] for tick in sorted(known.ticks)]
        poses = [tick.truth[robot.id] for tick in ticks if robot.id in tick.truth]
        points = [at(pose.x, pose.y) for pose in thinned(poses)]
        if points:
            path = " ".join([f"{x:.1f},{y:.1f}" for x, y in points])
            x, y = points[-1]
            colour = colours.COLOURS[hues[robot.id]]
            parts.append(
                f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.4" '
                f'stroke-linejoin="round"/><circle cx="{x:.1f}" cy="{y:.1f}" r="2.4" fill="{colour}"/>'
            )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fdfcf9"/>{"".join(parts)}</svg>'
    )


def _hues(setup: RunSetup, known: RunData) -> dict[str, Role]:
    """Return the role whose colour each robot has: in a group, a if it is localised at last, and b if not."""
    if not setup.visits:
        return {robot.id: robot.role for robot in setup.robots}
    hues: dict[str, Role] = dict.fromkeys(setup.ids, "b")
    for data in known.ticks.values():
        for robot, command in data.commands.items():
            if isinstance(command.verdict, Localised):
                hues[robot] = "a"
    return hues


def thinned(values: Sequence[Pose]) -> list[Pose]:
    """Return at most MOST_POINTS + 1 of `values`, evenly spaced, the last included."""
    step = -(-len(values) // MOST_POINTS) or 1
    return [*values[::step], *values[-1:]]
