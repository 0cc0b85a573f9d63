"""`run.rrd`: the scenes of a run as a recording for Rerun, with the blueprint that arranges its views.

Entities: `stage/anchor/ID`, `stage/range/ID`, `stage/orbit/ID` and a group's `stage/meetings`, which stand;
`robots/ID/pose`, `path`, `hypotheses`, `ellipse` and `range`; `contact/A-B`; `plots/ID/NUMBER`; `log`. The
timelines are `tick` and `time`, the simulated time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from msgspec import UNSET

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view import colours
from compose.view.numbers import HYPOTHESES, PLOTS, PLOTTED, RANGES, Numbers
from compose.view.outlines import box, circle
from compose.view.scene import Player, Scene
from protocol.mission import Role
from protocol.motion import Pose, compose

TICK, TIME = "tick", "time"
"""The timelines."""
BODY_OF_SCENE = 0.045
"""The drawn length of a robot, as a fraction of the extent of the scene."""
RANGES_SHOWN = 1.8
"""The top of the plot of ranges, as a multiple of R; the legend takes the upper part."""
FPS = 8.0
"""The ticks played each second."""
HEIGHT = 1.1
"""The height of the eye above the scene, as a multiple of its extent."""
LINE_RADII = {"thin": -0.8, "path": -1.8, "contact": -3.0}
"""The radii of lines. Negative radii are in pixels of the window."""
GREEN, GREY = (0, 128, 90), (128, 128, 128)
RERUN_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
NONE = rr.Clear(recursive=False)
"""The component that ends the display of an entity."""


def rerun_recording(setup: RunSetup, scenes: Sequence[Scene]) -> bytes:
    """Return the recording of the `scenes` of a run as the content of a file."""
    stream = rr.RecordingStream("tandem")
    stream.send_recording_name(setup.name)
    memory = stream.memory_recording()
    stream.send_blueprint(blueprint(setup))
    drawing = _Drawing(setup, stream)
    drawing.stand()
    for scene in scenes:
        drawing.draw(scene)
    content: bytes = memory.drain_as_bytes()
    stream.disconnect()
    return content


def blueprint(setup: RunSetup) -> rrb.Blueprint:
    """Return the arrangement of the views: the scene from above beside the plots and the log."""
    middle = box(setup)
    paths = [f"robots/{robot}/path" for robot in setup.ids]
    whole = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                timeline,
                start=rrb.TimeRangeBoundary.infinite(),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (TICK, TIME)
        ]
    )
    scene = rrb.Spatial3DView(
        origin="/",
        contents=["stage/**", "robots/**", "contact/**"],
        name="Scene",
        overrides={path: [whole] for path in paths},
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(middle.x, middle.y, HEIGHT * middle.extent),
            look_target=(middle.x, middle.y, 0.0),
            eye_up=(0.0, 1.0, 0.0),
        ),
    )
    plots = [
        rrb.TimeSeriesView(
            origin="/",
            contents=[f"plots/{robot}/{number}" for robot in setup.ids[:PLOTTED] for number in numbers],
            name=title,
            plot_legend=rrb.Corner2D.RightTop if title == HYPOTHESES else rrb.Corner2D.LeftTop,
            axis_x=rrb.TimeAxis(link="LinkToGlobal"),
            axis_y=rrb.ScalarAxis(range=(0.0, RANGES_SHOWN * setup.mission.sensing_range))
            if title == RANGES
            else None,
        )
        for title, numbers in PLOTS.items()
    ]
    beside = rrb.Vertical(*plots, _log(), row_shares=[1, 1, 1, 1.5])
    return rrb.Blueprint(
        rrb.Horizontal(scene, beside, column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TICK, fps=FPS),
        auto_layout=False,
        auto_views=False,
    )


def _log() -> rrb.TextLogView:
    """Return the log, with the tick, the level and the text of each event."""
    kinds = rrb.encodings.TextLogColumnKind
    shown = {kinds.EntityPath: False, kinds.LogLevel: True, kinds.Body: True}
    return rrb.TextLogView(
        origin="log",
        name="Log",
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.components.TimelineColumn(TICK)],
            text_log_columns=[
                rrb.components.TextLogColumn(kind, visible=visible) for kind, visible in shown.items()
            ],
        ),
    )


class _Drawing:
    """The entities of a run. Scenes must be drawn in the order of their ticks."""

    def __init__(self, setup: RunSetup, stream: rr.RecordingStream) -> None:
        self._setup = setup
        self._stream = stream
        self._unit = BODY_OF_SCENE * box(setup).extent
        self._last: dict[str, Pose] = {}
        self._shown: set[str] = set()
        """The entities of `_while` that are displayed."""

    def stand(self) -> None:
        """Draw what does not change: anchors, sensing ranges and orbits, and the style of the plots."""
        for robot in self._setup.anchored:
            colour = GREY if self._setup.visits else _colour(robot.role)
            at = (robot.anchor.x, robot.anchor.y)
            self._fixed(
                f"stage/anchor/{robot.id}",
                rr.Points3D(
                    [(*at, 0.0)], radii=self._unit / 5, colors=[colour], labels=[f"{robot.id}'s anchor"]
                ),
            )
            reach, orbit = circle(at, self._setup.mission.sensing_range), circle(at, robot.orbit.radius)
            self._fixed(f"stage/range/{robot.id}", _lines([reach], colour, "thin"))
            self._fixed(f"stage/orbit/{robot.id}", _lines([orbit], GREY, "thin"))
        ends = [((a.anchor.x, a.anchor.y), (b.anchor.x, b.anchor.y)) for a, b in self._setup.links()]
        if self._setup.visits:
            self._fixed("stage/meetings", _lines(ends, GREY, "thin"))
        for robot in self._setup.robots[:PLOTTED]:
            for numbers in PLOTS.values():
                for place, number in enumerate(numbers):
                    self._fixed(f"plots/{robot.id}/{number}", self._curve(robot, number, place))

    def _curve(self, robot: RobotSetup, number: str, place: int) -> rr.SeriesLines | rr.SeriesPoints:
        """Return the style of a number, which is the `place`-th of its plot. Ranges are single points."""
        name = [f"{robot.id}: {number.removesuffix('_m').replace('_', ' ')}"]
        colour = [_colour(robot.role)] if len(self._setup.robots) == 2 else None
        if number.endswith("_range_m"):
            shape = (rr.components.MarkerShape.Circle, rr.components.MarkerShape.Diamond)[place]
            return rr.SeriesPoints(names=name, colors=colour, markers=[shape], marker_sizes=[4.0])
        step: dict[str, Any] = {"interpolation_mode": "StepAfter"} if number == "hypotheses" else {}
        return rr.SeriesLines(names=name, colors=colour, widths=[2.0 if place == 0 else 1.0], **step)

    def draw(self, scene: Scene) -> None:
        """Draw one tick."""
        self._stream.set_time(TICK, sequence=scene.tick)
        self._stream.set_time(TIME, duration=scene.tick * self._setup.mission.period)
        for player in scene.players:
            robot = self._setup.robot_setup(player.robot)
            self._draw_robot(robot, player)
            self._draw_hypotheses(robot, player)
        for robot in self._setup.robots[:PLOTTED]:
            numbers = Numbers.in_scene(scene, robot)
            for number in numbers.__struct_fields__:
                value = getattr(numbers, number)
                if any(number in plotted for plotted in PLOTS.values()):
                    known = [float(value)] if value is not UNSET else []
                    if known or number not in PLOTS[RANGES]:  # no number is a gap in a line, but a point at 0
                        self._log(f"plots/{robot.id}/{number}", rr.Scalars(known))
        self._draw_contacts(scene)
        for event in scene.events:
            self._log("log", rr.TextLog(event.whole, level=RERUN_LEVELS[event.level]))

    def _draw_robot(self, robot: RobotSetup, player: Player) -> None:
        pose = player.pose
        if pose is None:
            return
        colour = _colour(player.hue(robot))
        body = rr.Arrows3D(
            origins=[(pose.x, pose.y, 0.0)],
            vectors=[self._ahead(pose)],
            radii=self._unit / 12,
            colors=[colour],
            labels=[robot.id],
        )
        self._log(f"robots/{robot.id}/pose", body)
        before = self._last.get(robot.id)
        if before is not None and (before.x, before.y) != (pose.x, pose.y):
            step = [[(before.x, before.y), (pose.x, pose.y)]]
            self._log(f"robots/{robot.id}/path", _lines(step, colour, "path"))
        self._last[robot.id] = pose
        ranged = None
        if player.anchor_range is not None:
            ends = [(pose.x, pose.y), (robot.anchor.x, robot.anchor.y)]
            ranged = _lines([ends], colour, "thin", f"{player.anchor_range:.2f} m")
        self._while(f"robots/{robot.id}/range", ranged)

    def _draw_hypotheses(self, robot: RobotSetup, player: Player) -> None:
        held = player.held
        if held is None:
            return
        poses = held.world
        if held.local and not poses:
            frame = robot.frame or Pose(robot.anchor.x, robot.anchor.y, 0.0)
            poses = tuple([compose(frame, pose) for pose in held.local])
        arrows = rr.Arrows3D(
            origins=[(pose.x, pose.y, 0.0) for pose in poses],
            vectors=[self._ahead(pose) for pose in poses],
            radii=self._unit / 50,
            colors=[_colour(player.hue(robot))],
            labels=[f"{share:.2g}" for share in held.shares],
            show_labels=len(poses) > 1,
        )
        self._while(f"robots/{robot.id}/hypotheses", arrows if poses else None)
        outline = None
        if held.outline:
            outline = _lines([held.outline], _colour(player.hue(robot)), "thin")
        self._while(f"robots/{robot.id}/ellipse", outline)

    def _draw_contacts(self, scene: Scene) -> None:
        for link in scene.links(self._setup):
            length = f"{link.range:.2f} m" if link.range is not None else "no range"
            line = _lines([link.ends], GREEN, "contact", length) if link.ends else None
            self._while(f"contact/{link.a}-{link.b}", line)

    def _ahead(self, pose: Pose) -> tuple[float, float, float]:
        """Return the arrow of a pose, one drawn length long."""
        tip = compose(Pose(0.0, 0.0, pose.heading), Pose(self._unit, 0.0, 0.0))
        return tip.x, tip.y, 0.0

    def _while(self, path: str, content: rr.AsComponents | None) -> None:
        """Display an entity in this tick and until it is None."""
        if content is not None:
            self._shown.add(path)
            self._log(path, content)
        elif path in self._shown:
            self._shown.remove(path)
            self._log(path, NONE)

    def _log(self, path: str, content: rr.AsComponents) -> None:
        self._stream.log(path, content)

    def _fixed(self, path: str, content: rr.AsComponents) -> None:
        self._stream.log(path, content, static=True)


def _colour(role: Role) -> tuple[int, int, int]:
    """Return the colour of a role as red, green and blue, each from 0 to 255."""
    red, green, blue = bytes.fromhex(colours.COLOURS[role][1:])
    return red, green, blue


def _lines(
    strips: Iterable[Sequence[tuple[float, float]]], colour: Any, width: str, label: str | None = None
) -> rr.LineStrips3D:
    """Return lines on the ground plane."""
    return rr.LineStrips3D(
        [[(x, y, 0.0) for x, y in strip] for strip in strips],
        colors=[colour],
        radii=[LINE_RADII[width]],
        labels=[label] if label is not None else None,
    )
