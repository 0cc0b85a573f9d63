"""Scenes of a run in Foxglove's schemas, which any compatible viewer displays without configuration.

The reference frames are `world`, the true pose `ID` of robot ID, and its anchor's frame `ID/anchor`. Each
message is complete in itself, so a viewer can seek in a recording.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from foxglove import messages as fox

from compose.recording.run_setup import RunSetup
from compose.view.drawing import Arrow, Entity, Rgb, anchor_frame, drawing, standing
from compose.view.events import Event
from compose.view.numbers import Numbers
from compose.view.outlines import Point
from compose.view.scene import Player, Scene
from protocol.motion import ORIGIN, Pose

WORLD_FRAME = "world"
TRAIL_POSES, TRAIL_WIDTH = 200, 2.0
"""The number of latest poses in a trail, and its width in pixels."""
BODY_OF_RANGE = 0.12
"""The drawn length of a robot, as a fraction of the sensing range R."""
FOXGLOVE_LEVELS = {"info": fox.LogLevel.Info, "warning": fox.LogLevel.Warning, "error": fox.LogLevel.Error}


class Shown(NamedTuple):
    """A message for viewers and its topic."""

    topic: str
    message: Any
    """A message of Foxglove's schemas, or Numbers."""


def nanoseconds(setup: RunSetup, tick: int) -> int:
    """Return the simulated time of `tick` in ns."""
    return round(tick * setup.mission.period * 1e9)


class Views:
    """The messages of a run. Scenes must be passed in the order of their ticks."""

    def __init__(self, setup: RunSetup) -> None:
        self.setup = setup
        self._unit = BODY_OF_RANGE * setup.mission.sensing_range
        self._trails: dict[str, deque[tuple[fox.Pose, fox.Point3]]] = {
            robot: deque(maxlen=TRAIL_POSES) for robot in setup.ids
        }
        """The latest true poses of each robot, and their positions. Each is converted once."""

    def standing(self) -> Shown:
        """Return the static content: anchors, sensing ranges and orbits."""
        at = fox.Timestamp(0, 0)
        return Shown(
            "/stage", fox.SceneUpdate(entities=[self._entity(one, at) for one in standing(self.setup)])
        )

    def of(self, scene: Scene) -> Iterator[Shown]:
        """Yield the messages of one tick."""
        at = fox.Timestamp(*divmod(nanoseconds(self.setup, scene.tick), 1_000_000_000))
        for event in scene.events:
            yield Shown("/log", _line(event, at))
        yield Shown("/tf", fox.FrameTransforms(transforms=list(self._transforms(scene, at))))
        for player in scene.players:
            robot_setup = self.setup.robot_setup(player.robot)
            yield Shown(f"/{player.robot}/numbers", Numbers.in_scene(scene, robot_setup, self.setup))
            yield from self._poses(player, at)
        entities: dict[str, list[fox.SceneEntity]] = {"/contact": []}
        for one in drawing(self.setup, scene):
            entities.setdefault(one.topic, []).append(self._entity(one, at))
        for topic, found in entities.items():
            yield Shown(topic, fox.SceneUpdate(entities=found))

    def _transforms(self, scene: Scene, at: fox.Timestamp) -> Iterator[fox.FrameTransform]:
        for player in scene.players:
            robot, frames = self.setup.robot_setup(player.robot), {}
            if robot.given_anchor is not None:
                frames[f"{robot.id}/anchor"] = anchor_frame(robot)
            if player.pose is not None:
                frames[robot.id] = player.pose
            for child, pose in frames.items():
                yield fox.FrameTransform(
                    timestamp=at,
                    parent_frame_id=WORLD_FRAME,
                    child_frame_id=child,
                    translation=fox.Vector3(x=pose.x, y=pose.y, z=0.0),
                    rotation=_turned(pose.heading),
                )

    def _poses(self, player: Player, at: fox.Timestamp) -> Iterator[Shown]:
        """Yield the true pose of a robot, its trail, and its hypotheses."""
        robot, trail = player.robot, self._trails[player.robot]
        if player.pose is not None:
            trail.append((_pose(player.pose), _point((player.pose.x, player.pose.y))))
            pose, poses = trail[-1][0], [one for one, _ in trail]
            yield Shown(f"/{robot}/pose", fox.PoseInFrame(timestamp=at, frame_id=WORLD_FRAME, pose=pose))
            yield Shown(f"/{robot}/trail", fox.PosesInFrame(timestamp=at, frame_id=WORLD_FRAME, poses=poses))
        if player.held is not None:
            frame, poses = f"{robot}/anchor", [_pose(one) for one in player.held.poses]
            frame = WORLD_FRAME if player.held.world else frame
            yield Shown(f"/{robot}/hypotheses", fox.PosesInFrame(timestamp=at, frame_id=frame, poses=poses))

    def _entity(self, one: Entity, at: fox.Timestamp) -> fox.SceneEntity:
        """Return an entity of a drawing; the body of a robot has its trail."""
        texts = [
            self._words(arrow.label, arrow.pose, _colour(one.rgb, arrow.opacity))
            for arrow in one.arrows
            if arrow.label
        ]
        lines, cubes = [], []
        if one.topic == f"/{one.id}/body":
            points = [point for _, point in self._trails[one.id]]
            lines += [_strip(points, _colour(one.rgb), TRAIL_WIDTH)] if len(points) > 1 else []
        for part in one.lines:
            colour = _colour(part.rgb, part.opacity)
            for strip in part.strips:
                lines.append(_strip([_point(point) for point in strip], colour, part.width))
                if part.label:
                    (x, y), (to_x, to_y) = strip[0], strip[-1]
                    middle = Pose((x + to_x) / 2, (y + to_y) / 2, 0.0)
                    texts.append(self._words(part.label, middle, _colour(part.rgb)))
        if one.place is not None:
            here, side = Pose(*one.place, 0.0), self._unit
            size = fox.Vector3(x=side, y=side, z=side)
            cubes = [fox.CubePrimitive(pose=_pose(here), size=size, color=_colour(one.rgb))]
            texts.append(self._words(f"{one.id.removesuffix('/anchor')}'s anchor", here, _colour(one.rgb)))
        return fox.SceneEntity(
            timestamp=at,
            frame_id=WORLD_FRAME,
            id=one.id,
            arrows=[self._arrow(arrow, one.rgb) for arrow in one.arrows],
            cubes=cubes,
            lines=lines,
            texts=texts,
        )

    def _arrow(self, arrow: Arrow, rgb: Rgb) -> fox.ArrowPrimitive:
        return fox.ArrowPrimitive(
            pose=_pose(arrow.pose),
            shaft_length=0.6 * self._unit,
            shaft_diameter=0.3 * self._unit,
            head_length=0.4 * self._unit,
            head_diameter=0.6 * self._unit,
            color=_colour(rgb, arrow.opacity),
        )

    def _words(self, text: str, at: Pose, colour: fox.Color) -> fox.TextPrimitive:
        """Return a text above a position, always facing the viewer."""
        position = fox.Vector3(x=at.x, y=at.y + self._unit, z=self._unit)
        place = fox.Pose(position=position, orientation=_turned(0.0))
        return fox.TextPrimitive(
            pose=place, billboard=True, font_size=14.0, scale_invariant=True, color=colour, text=text
        )


def _turned(heading: float) -> fox.Quaternion:
    """Return the rotation about the vertical axis by `heading` rad."""
    return fox.Quaternion(x=0.0, y=0.0, z=math.sin(heading / 2.0), w=math.cos(heading / 2.0))


def _pose(at: Pose) -> fox.Pose:
    """Return a pose on the ground plane."""
    return fox.Pose(position=fox.Vector3(x=at.x, y=at.y, z=0.0), orientation=_turned(at.heading))


def _colour(rgb: Rgb, alpha: float = 1.0) -> fox.Color:
    return fox.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def _point(place: Point) -> fox.Point3:
    return fox.Point3(x=place[0], y=place[1], z=0.0)


def _strip(points: Sequence[fox.Point3], colour: fox.Color, width: float) -> fox.LinePrimitive:
    """Return a line through points, `width` pixels wide."""
    return fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        pose=_pose(ORIGIN),
        thickness=width,
        scale_invariant=True,
        points=list(points),
        color=colour,
    )


def _line(event: Event, at: fox.Timestamp) -> fox.Log:
    level = FOXGLOVE_LEVELS[event.level]
    return fox.Log(
        timestamp=at, level=level, message=event.whole, name=event.robot or "world", file=event.kind
    )
