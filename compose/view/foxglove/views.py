"""Scenes of a run in Foxglove's schemas, which any compatible viewer displays without configuration.

The reference frames are `world`, the true pose `ID` of robot ID, and its anchor's frame `ID/anchor`. Each
message is complete in itself, so a viewer can seek in a recording.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from foxglove import messages as fox

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view import colours
from compose.view.events import Event
from compose.view.foxglove import shapes
from compose.view.numbers import Numbers
from compose.view.outlines import circle
from compose.view.scene import HeldPoses, Player, Scene
from protocol.mission import Role
from protocol.motion import Pose

WORLD_FRAME = "world"
TRAIL_POSES = 200
"""The number of latest poses in a trail."""
BODY_OF_RANGE = 0.12
"""The drawn length of a robot, as a fraction of the sensing range R."""
LEAST_OPACITY = 0.06
"""The minimum opacity of a hypothesis."""
RGB_COLOURS: dict[Role, tuple[float, float, float]] = {"a": colours.rgb("a"), "b": colours.rgb("b")}
GREY = (0.5, 0.5, 0.5)
GREEN = (0.0, 0.5, 0.35)
FOXGLOVE_LEVELS = {"info": fox.LogLevel.Info, "warning": fox.LogLevel.Warning, "error": fox.LogLevel.Error}
DELIVERED = {"heard": "received", "damaged": "damaged", "lost": "lost"}
"""The words for the deliveries of reports, by `Passage.what`."""


class Shown(NamedTuple):
    """A message for viewers and its topic."""

    topic: str
    message: Any
    """A message of Foxglove's schemas, or Numbers."""


def topics(robots: Iterable[str]) -> dict[str, Any]:
    """Return the message type of each topic, in a run of `robots`."""
    found = {
        "/tf": fox.FrameTransforms,
        "/stage": fox.SceneUpdate,
        "/contact": fox.SceneUpdate,
        "/log": fox.Log,
    }
    for robot in robots:
        found[f"/{robot}/pose"] = fox.PoseInFrame
        found[f"/{robot}/trail"] = fox.PosesInFrame
        found[f"/{robot}/body"] = fox.SceneUpdate
        found[f"/{robot}/hypotheses"] = fox.PosesInFrame
        found[f"/{robot}/belief"] = fox.SceneUpdate
        found[f"/{robot}/numbers"] = Numbers
    return found


def nanoseconds(setup: RunSetup, tick: int) -> int:
    """Return the simulated time of `tick` in ns."""
    return round(tick * setup.mission.period * 1e9)


class Trail:
    """The latest TRAIL_POSES true poses of a robot, and their positions. Each is converted once."""

    def __init__(self) -> None:
        self.poses: deque[fox.Pose] = deque(maxlen=TRAIL_POSES)
        self.points: deque[fox.Point3] = deque(maxlen=TRAIL_POSES)

    def add(self, pose: Pose) -> None:
        """Append a pose."""
        self.poses.append(shapes.pose(pose))
        self.points.append(shapes.point(pose.x, pose.y))


class Views:
    """The messages of a run. Scenes must be passed in the order of their ticks."""

    def __init__(self, setup: RunSetup) -> None:
        self.setup = setup
        self._unit = BODY_OF_RANGE * setup.mission.sensing_range
        self._trails = {robot: Trail() for robot in setup.ids}

    def standing(self) -> Shown:
        """Return the static content: anchors, sensing ranges and orbits."""
        entities = [self._anchor(robot_setup) for robot_setup in self.setup.anchored]
        if self.setup.visits:
            entities.append(self._tree())
        return Shown("/stage", fox.SceneUpdate(entities=entities))

    def of(self, scene: Scene) -> Iterator[Shown]:
        """Yield the messages of one tick."""
        at = shapes.timestamp(nanoseconds(self.setup, scene.tick))
        for player in scene.players:
            if player.pose is not None:
                self._trails[player.robot].add(player.pose)
        for event in scene.events:
            yield Shown("/log", _line(event, at))
        yield Shown("/tf", fox.FrameTransforms(transforms=list(self._transforms(scene, at))))
        for player in scene.players:
            robot_setup = self.setup.robot_setup(player.robot)
            yield Shown(f"/{player.robot}/numbers", Numbers.in_scene(scene, robot_setup))
            yield from self._robot(player, at)
        yield Shown("/contact", fox.SceneUpdate(entities=list(self._contacts(scene, at))))

    # --- robots ---

    def _transforms(self, scene: Scene, at: fox.Timestamp) -> Iterator[fox.FrameTransform]:
        for player in scene.players:
            robot_setup = self.setup.robot_setup(player.robot)
            frames = {}
            if robot_setup.given_anchor is not None:
                frames[f"{player.robot}/anchor"] = robot_setup.frame or Pose(
                    robot_setup.anchor.x, robot_setup.anchor.y, 0.0
                )
            if player.pose is not None:
                frames[player.robot] = player.pose
            for child, pose in frames.items():
                yield fox.FrameTransform(
                    timestamp=at,
                    parent_frame_id=WORLD_FRAME,
                    child_frame_id=child,
                    translation=fox.Vector3(x=pose.x, y=pose.y, z=0.0),
                    rotation=shapes.turned(pose.heading),
                )

    def _robot(self, player: Player, at: fox.Timestamp) -> Iterator[Shown]:
        robot, robot_setup = player.robot, self.setup.robot_setup(player.robot)
        if player.pose is not None:
            pose = fox.PoseInFrame(timestamp=at, frame_id=WORLD_FRAME, pose=shapes.pose(player.pose))
            yield Shown(f"/{robot}/pose", pose)
            trail = list(self._trails[robot].poses)
            yield Shown(f"/{robot}/trail", fox.PosesInFrame(timestamp=at, frame_id=WORLD_FRAME, poses=trail))
            yield Shown(f"/{robot}/body", fox.SceneUpdate(entities=[self._body(robot_setup, player, at)]))
        if player.held is not None:
            frame = WORLD_FRAME if player.held.world else f"{robot}/anchor"
            poses = [shapes.pose(one) for one in player.held.poses]
            yield Shown(f"/{robot}/hypotheses", fox.PosesInFrame(timestamp=at, frame_id=frame, poses=poses))
            belief = self._belief(robot, frame, player.held, at, RGB_COLOURS[player.hue(robot_setup)])
            yield Shown(f"/{robot}/belief", fox.SceneUpdate(entities=[belief]))

    def _body(self, robot_setup: RobotSetup, player: Player, at: fox.Timestamp) -> fox.SceneEntity:
        """Return the drawing of a robot with its activity, its trail, and its anchor range if it has one."""
        assert player.pose is not None
        hue = RGB_COLOURS[player.hue(robot_setup)]
        colour = shapes.colour(hue)
        lines = []
        texts = [shapes.words(f"{robot_setup.id}: {player.activity}", player.pose, self._unit, colour)]
        trail = self._trails[robot_setup.id].points
        if len(trail) > 1:
            lines.append(shapes.line(trail, colour, 2.0))
        if player.anchor_range is not None:
            ends = [(player.pose.x, player.pose.y), (robot_setup.anchor.x, robot_setup.anchor.y)]
            lines.append(shapes.strip(ends, shapes.colour(hue, 0.5), 1.5))
            middle = shapes.middle(ends)
            texts.append(shapes.words(f"{player.anchor_range:.3f} m", middle, self._unit, colour))
        return fox.SceneEntity(
            timestamp=at,
            frame_id=WORLD_FRAME,
            id=robot_setup.id,
            arrows=[shapes.arrow(player.pose, self._unit, colour)],
            lines=lines,
            texts=texts,
        )

    # --- anchors and contacts ---

    def _anchor(self, robot_setup: RobotSetup) -> fox.SceneEntity:
        colour = GREY if self.setup.visits else RGB_COLOURS[robot_setup.role]
        centre = (robot_setup.anchor.x, robot_setup.anchor.y)
        here = Pose(*centre, 0.0)
        size = fox.Vector3(x=self._unit, y=self._unit, z=self._unit)
        return fox.SceneEntity(
            timestamp=shapes.timestamp(0),
            frame_id=WORLD_FRAME,
            id=f"{robot_setup.id}/anchor",
            cubes=[fox.CubePrimitive(pose=shapes.pose(here), size=size, color=shapes.colour(colour))],
            lines=[
                shapes.strip(
                    circle(centre, self.setup.mission.sensing_range), shapes.colour(colour, 0.6), 1.5
                ),
                shapes.strip(circle(centre, robot_setup.orbit.radius), shapes.colour(GREY, 0.5), 1.0),
            ],
            texts=[shapes.words(f"{robot_setup.id}'s anchor", here, self._unit, shapes.colour(colour))],
        )

    def _tree(self) -> fox.SceneEntity:
        """Return a line between the anchors of each planned meeting of a group."""
        grey = shapes.colour(GREY, 0.6)
        ends = [((a.anchor.x, a.anchor.y), (b.anchor.x, b.anchor.y)) for a, b in self.setup.links()]
        return fox.SceneEntity(
            timestamp=shapes.timestamp(0),
            frame_id=WORLD_FRAME,
            id="meetings",
            lines=[shapes.strip(two, grey, 1.0) for two in ends],
        )

    def _contacts(self, scene: Scene, at: fox.Timestamp) -> Iterator[fox.SceneEntity]:
        """Yield one entity per pair. In contact it shows the link, the range and deliveries of reports."""
        for link in scene.links(self.setup):
            lines, texts = [], []
            if link.ends:
                lines = [shapes.strip(link.ends, shapes.colour(GREEN), 3.0)]
                words = [f"{link.range:.3f} m"] if link.range is not None else ["no range"]
                words += [
                    f"{passage.sender}'s report of tick {passage.tick}: {DELIVERED[passage.what]}"
                    for passage in scene.passages
                    if {passage.sender, passage.receiver} == {link.a, link.b} and passage.what != "sent"
                ]
                middle = shapes.middle(link.ends)
                texts = [shapes.words("\n".join(words), middle, self._unit, shapes.colour(GREEN))]
            yield fox.SceneEntity(
                timestamp=at, frame_id=WORLD_FRAME, id=f"{link.a}-{link.b}", lines=lines, texts=texts
            )

    # --- hypotheses ---

    def _belief(
        self, robot: str, frame: str, held: HeldPoses, at: fox.Timestamp, colour: tuple[float, float, float]
    ) -> fox.SceneEntity:
        """Return an arrow for each hypothesis, paler if less probable, and where the first one may be."""
        arrows, texts = [], []
        for pose, share in zip(held.poses, held.shares, strict=False):
            shade = shapes.colour(colour, max(LEAST_OPACITY, share))
            arrows.append(shapes.arrow(pose, self._unit, shade))
            if len(held.poses) > 1:
                texts.append(shapes.words(f"{share:.3g}", pose, self._unit, shade))
        lines = [shapes.strip(held.outline, shapes.colour(colour), 1.5)] if held.outline else []
        return fox.SceneEntity(
            timestamp=at, frame_id=frame, id=robot, arrows=arrows, lines=lines, texts=texts
        )


def _line(event: Event, at: fox.Timestamp) -> fox.Log:
    level = FOXGLOVE_LEVELS[event.level]
    return fox.Log(
        timestamp=at, level=level, message=event.whole, name=event.robot or "world", file=event.kind
    )
