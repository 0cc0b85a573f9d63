"""`run.rrd`: the scenes of a run as a recording for Rerun, with the blueprint that arranges its views.

Entities: `stage/anchor/ID`, `stage/range/ID`, `stage/orbit/ID` and a group's `stage/meetings`, which stand;
`robots/ID/pose`, `path`, `hypotheses`, `ellipse` and `range`; `contact/A-B`; `plots/ID/NUMBER`; `log`. The
timelines are `tick` and `time`, the simulated time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from msgspec import UNSET

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view import colours
from compose.view.drawing import WIDE, Entity, Lines, drawing, standing
from compose.view.numbers import HYPOTHESES, PLOTS, PLOTTED, RANGES, Numbers
from compose.view.outlines import box
from compose.view.scene import Player, Scene
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
RADIUS_OF_WIDTH = 0.6
"""The radius of a line, as a multiple of its width."""
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
    begin, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    whole = rrb.VisibleTimeRanges([rrb.VisibleTimeRange(one, start=begin, end=now) for one in (TICK, TIME)])
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
    log = rrb.TextLogView(origin="log", name="Log")
    beside = rrb.Vertical(*plots, log, row_shares=[1, 1, 1, 1.5])
    return rrb.Blueprint(
        rrb.Horizontal(scene, beside, column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TICK, fps=FPS),
        auto_layout=False,
        auto_views=False,
    )


class _Drawing:
    """The entities of a run. Scenes must be drawn in the order of their ticks."""

    def __init__(self, setup: RunSetup, stream: rr.RecordingStream) -> None:
        self._setup = setup
        self._stream = stream
        self._unit = BODY_OF_SCENE * box(setup).extent
        self._last: dict[str, Pose] = {}
        self._shown: set[str] = set()
        """The entities that are displayed."""

    def stand(self) -> None:
        """Draw what does not change: anchors, sensing ranges and orbits, and the style of the plots."""
        for one in standing(self._setup):
            if one.place is not None:
                at, label = [(*one.place, 0.0)], [f"{one.id.removesuffix('/anchor')}'s anchor"]
                points = rr.Points3D(at, radii=self._unit / 5, colors=[one.rgb], labels=label)
                self._stream.log(one.path, points, static=True)
            for lines in one.lines:
                self._stream.log(lines.path, _lines(lines), static=True)
        for robot in self._setup.robots[:PLOTTED]:
            for numbers in PLOTS.values():
                for place, number in enumerate(numbers):
                    path, curve = f"plots/{robot.id}/{number}", self._curve(robot, number, place)
                    self._stream.log(path, curve, static=True)

    def _curve(self, robot: RobotSetup, number: str, place: int) -> rr.SeriesLines | rr.SeriesPoints:
        """Return the style of a number, which is the `place`-th of its plot. Ranges are single points."""
        name = [f"{robot.id}: {number.removesuffix('_m').replace('_', ' ')}"]
        colour = [colours.rgb(robot.role)] if len(self._setup.robots) == 2 else None
        if number.endswith("_range_m"):
            shape = (rr.components.MarkerShape.Circle, rr.components.MarkerShape.Diamond)[place]
            return rr.SeriesPoints(names=name, colors=colour, markers=[shape], marker_sizes=[4.0])
        step: dict[str, Any] = {"interpolation_mode": "StepAfter"} if number == "hypotheses" else {}
        return rr.SeriesLines(names=name, colors=colour, widths=[2.0 if place == 0 else 1.0], **step)

    def draw(self, scene: Scene) -> None:
        """Draw one tick."""
        self._stream.set_time(TICK, sequence=scene.tick)
        self._stream.set_time(TIME, duration=scene.tick * self._setup.mission.period)
        for one in drawing(self._setup, scene):
            if one.topic != "/contact":
                self._while(one.path, self._arrows(one) if one.arrows else None)
            for lines in one.lines:
                self._while(lines.path, _lines(lines) if lines.strips else None)
        for player in scene.players:
            self._extend_path(self._setup.robot_setup(player.robot), player)
        for robot in self._setup.robots[:PLOTTED]:
            numbers = Numbers.in_scene(scene, robot, self._setup)
            for number in [number for plotted in PLOTS.values() for number in plotted]:
                value = getattr(numbers, number)
                known = [float(value)] if value is not UNSET else []
                if known or number not in PLOTS[RANGES]:  # no number is a gap in a line, but a point at 0
                    self._stream.log(f"plots/{robot.id}/{number}", rr.Scalars(known))
        for event in scene.events:
            self._stream.log("log", rr.TextLog(event.whole, level=RERUN_LEVELS[event.level]))

    def _extend_path(self, robot: RobotSetup, player: Player) -> None:
        """Draw the step of a robot since its last pose. The view shows all steps up to the present time."""
        pose, before = player.pose, self._last.get(robot.id)
        if pose is not None:
            ends = [((before.x, before.y), (pose.x, pose.y))] if before is not None else []
            if ends and ends[0][0] != ends[0][1]:
                path = Lines(f"robots/{robot.id}/path", ends, colours.rgb(player.hue(robot)), WIDE)
                self._stream.log(path.path, _lines(path))
            self._last[robot.id] = pose

    def _arrows(self, one: Entity) -> rr.Arrows3D:
        """Return the arrows of an entity, one drawn length long; those of hypotheses are thinner."""
        body = one.topic.endswith("/body")
        tips = [
            compose(Pose(0.0, 0.0, arrow.pose.heading), Pose(self._unit, 0.0, 0.0)) for arrow in one.arrows
        ]
        return rr.Arrows3D(
            origins=[(arrow.pose.x, arrow.pose.y, 0.0) for arrow in one.arrows],
            vectors=[(tip.x, tip.y, 0.0) for tip in tips],
            radii=self._unit / (12 if body else 50),
            colors=[one.rgb],
            labels=[arrow.label for arrow in one.arrows],
            show_labels=body or len(one.arrows) > 1,
        )

    def _while(self, path: str, content: rr.AsComponents | None) -> None:
        """Display an entity in this tick and until it is None."""
        if content is not None:
            self._shown.add(path)
            self._stream.log(path, content)
        elif path in self._shown:
            self._shown.remove(path)
            self._stream.log(path, NONE)


def _lines(lines: Lines) -> rr.LineStrips3D:
    """Return lines on the ground plane. Negative radii are in pixels of the window."""
    return rr.LineStrips3D(
        [[(x, y, 0.0) for x, y in strip] for strip in lines.strips],
        colors=[lines.rgb],
        radii=[-RADIUS_OF_WIDTH * lines.width],
        labels=[lines.label] if lines.label else None,
    )
