"""The drawing of a run for the viewers of exports: arrows, lines and texts on the ground plane, by entity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view import colours
from compose.view.outlines import Point, circle
from compose.view.scene import Player, Scene
from protocol.motion import Pose, compose

Rgb = tuple[float, float, float]
"""Red, green and blue, each from 0 to 1."""
GREY: Rgb = (0.5, 0.5, 0.5)
DARK: Rgb = (0.1, 0.1, 0.13)
GREEN: Rgb = (0.0, 0.5, 0.35)
THIN, WIDE = 1.5, 3.0
"""The widths of lines, in pixels."""
LEAST_OPACITY = 0.06
"""The minimum opacity of a hypothesis."""
DELIVERED = {"heard": "received", "damaged": "damaged", "lost": "lost"}
"""The words for the deliveries of reports, by `Passage.what`."""


class Arrow(NamedTuple):
    """An arrow at a pose, with a text; one opaque arrow in a scene is as long as the next."""

    pose: Pose
    label: str = ""
    opacity: float = 1.0


class Lines(NamedTuple):
    """Lines through points, with a text at their middle; none without strips."""

    path: str
    """The path in a tree of entities, such as `robots/a/range`."""
    strips: Sequence[Sequence[Point]]
    rgb: Rgb
    width: float = THIN
    label: str = ""
    opacity: float = 1.0


class Entity(NamedTuple):
    """Some arrows and lines that are drawn together. What it lacks in a tick is not displayed any more."""

    topic: str
    """The topic on which viewers with topics receive it, such as `/a/body`."""
    id: str
    path: str
    """The path of its arrows, or of its place, in a tree of entities."""
    rgb: Rgb
    arrows: Sequence[Arrow] = ()
    lines: Sequence[Lines] = ()
    place: Point | None = None
    """The place of an anchor; None for all other entities."""


def standing(setup: RunSetup) -> Iterator[Entity]:
    """Yield what does not change: anchors, sensing ranges and orbits, and the planned meetings of a group.

    Anchors of a team are where they are in truth, if that is known.
    """
    for robot in setup.anchored:
        rgb, at = GREY if setup.visits else colours.rgb(robot.role), (robot.anchor.x, robot.anchor.y)
        reach, orbit = circle(at, setup.mission.sensing_range), circle(at, robot.orbit.radius)
        lines = [
            Lines(f"stage/range/{robot.id}", [reach], rgb, opacity=0.6),
            Lines(f"stage/orbit/{robot.id}", [orbit], GREY, 1.0, opacity=0.5),
        ]
        yield Entity("/stage", f"{robot.id}/anchor", f"stage/anchor/{robot.id}", rgb, lines=lines, place=at)
    for anchor in setup.anchors:
        if (spot := anchor.place or anchor.position) is not None:
            at = (spot.x, spot.y)
            lines = [Lines(f"stage/range/{anchor.id}", [circle(at, setup.mission.sensing_range)], GREY, 1.0)]
            known = GREY if anchor.position is None else DARK
            yield Entity("/stage", anchor.id, f"stage/anchor/{anchor.id}", known, lines=lines, place=at)
    if setup.visits:
        ends = [((a.anchor.x, a.anchor.y), (b.anchor.x, b.anchor.y)) for a, b in setup.links()]
        tree = Lines("stage/meetings", ends, GREY, 1.0, opacity=0.6)
        yield Entity("/stage", "meetings", "stage/meetings", GREY, lines=[tree])


def drawing(setup: RunSetup, scene: Scene) -> Iterator[Entity]:
    """Yield what is drawn of one tick: robots, their hypotheses, and contacts."""
    for player in scene.players:
        yield from _robot(setup.robot_setup(player.robot), setup, player)
    for link in scene.links(setup):
        words = [f"{link.range:.3f} m"] if link.range is not None else ["no range"]
        words += [
            f"{passage.sender}'s report of tick {passage.tick}: {DELIVERED[passage.what]}"
            for passage in scene.passages
            if {passage.sender, passage.receiver} == {link.a, link.b} and passage.what != "sent"
        ]
        name, strips = f"{link.a}-{link.b}", [link.ends] if link.ends else []
        lines = [Lines(f"contact/{name}", strips, GREEN, WIDE, "\n".join(words))]
        yield Entity("/contact", name, f"contact/{name}", GREEN, lines=lines)


def anchor_frame(robot: RobotSetup) -> Pose:
    """Return the pose in <W> of the frame of a robot's anchor, with any heading while it is not known."""
    return robot.frame or Pose(robot.anchor.x, robot.anchor.y, 0.0)


def _robot(robot: RobotSetup, setup: RunSetup, player: Player) -> Iterator[Entity]:
    """Yield a robot with its task, ranges to anchors, and hypotheses, paler if less probable."""
    rgb, path, held, pose = colours.rgb(player.hue(robot)), f"robots/{robot.id}", player.held, player.pose
    if pose is not None:
        at = (pose.x, pose.y)
        ends = []
        if player.anchor_range is not None:
            ends = [(at, (robot.anchor.x, robot.anchor.y))]
        lines = [Lines(f"{path}/range", ends, rgb, THIN, f"{player.anchor_range or 0.0:.3f} m", 0.5)]
        ranges = {one.anchor: one.range for one in player.anchors}
        for anchor in setup.anchors:
            rho, spot = ranges.get(anchor.id), anchor.place or anchor.position
            strips = [(at, (spot.x, spot.y))] if rho is not None and spot is not None else []
            lines.append(Lines(f"{path}/range/{anchor.id}", strips, rgb, THIN, f"{rho or 0.0:.3f} m", 0.5))
        body = [Arrow(pose, f"{robot.id}: {player.activity}")]
        yield Entity(f"/{robot.id}/body", robot.id, f"{path}/pose", rgb, body, lines)
    if held is not None:
        local = held.local if robot.frame is not None or robot.given_anchor is not None else ()
        poses = held.world or tuple([compose(anchor_frame(robot), pose) for pose in local])
        labels = [f"{share:.3g}" if len(poses) > 1 else "" for share in held.shares]
        shades = [max(LEAST_OPACITY, share) for share in held.shares]
        arrows = list(map(Arrow, poses, labels, shades))
        lines = [Lines(f"{path}/ellipse", [held.outline] if held.outline else [], rgb)]
        yield Entity(f"/{robot.id}/belief", robot.id, f"{path}/hypotheses", rgb, arrows, lines)
