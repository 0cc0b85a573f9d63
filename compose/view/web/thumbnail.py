"""The thumbnail of a recording: anchors, sensing ranges and true paths as a small picture."""

from __future__ import annotations

from collections.abc import Sequence

from compose.recording.run_setup import RunSetup
from compose.view import colours
from compose.view.outlines import box
from compose.view.run_data import RunData
from protocol.messages import Localised
from protocol.mission import Anchor
from protocol.motion import Pose

WIDTH, HEIGHT = 160, 100
"""The size in pixels."""
MOST_POINTS = 200
"""The largest number of points of a path: more would not be visible."""
MOST_ROBOTS = 40
"""The largest number of robots that are drawn."""


def thumbnail(setup: RunSetup, known: RunData) -> str:
    """Return the picture of a run as SVG. Where robots form no pairs, localised ones have the colour of a."""
    shown, ticks = box(setup), [known.ticks[tick] for tick in sorted(known.ticks)]
    scale = min(WIDTH / shown.width, HEIGHT / shown.height) * 0.96
    commands = [one for tick in ticks for one in tick.commands.items()]
    localised = {robot for robot, command in commands if isinstance(command.verdict, Localised)}

    def at(place: Anchor | Pose) -> tuple[float, float]:
        return WIDTH / 2 + (place.x - shown.x) * scale, HEIGHT / 2 - (place.y - shown.y) * scale

    parts: tuple[list[str], list[str]] = [], []
    for robot in setup.robots[:MOST_ROBOTS]:
        role = robot.role if setup.in_pairs else "a" if robot.id in localised else "b"
        colour = colours.COLOURS[role]
        if robot.given_anchor is not None:
            x, y = at(robot.given_anchor)
            radius = setup.mission.sensing_range * scale
            parts[0].append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{colour}" fill-opacity="0.07" '
                f'stroke="{colour}" stroke-width="0.5"/>'
                f'<path d="M{x:.1f} {y - 3:.1f}l2.6 4.5h-5.2z" fill="#1b1d22"/>'
            )
        points = [
            at(pose) for pose in thinned([one.truth[robot.id] for one in ticks if robot.id in one.truth])
        ]
        if points:
            path, (x, y) = " ".join([f"{x:.1f},{y:.1f}" for x, y in points]), points[-1]
            parts[1].append(
                f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.4" '
                f'stroke-linejoin="round"/><circle cx="{x:.1f}" cy="{y:.1f}" r="2.4" fill="{colour}"/>'
            )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fdfcf9"/>{"".join(parts[0] + parts[1])}</svg>'
    )


def thinned(values: Sequence[Pose]) -> list[Pose]:
    """Return at most MOST_POINTS + 1 of `values`, evenly spaced, the last included."""
    step = -(-len(values) // MOST_POINTS) or 1
    return [*values[::step], *values[-1:]]
