"""The display of a run while it runs: a map of its robots and a line for each, or counts of many robots."""

from __future__ import annotations

import sys
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from compose.recording.recording_files import WORLD_JOURNAL
from compose.recording.run_setup import of_scenario
from compose.terminal import tables
from compose.terminal.braille import Drawing, Point
from compose.view.outlines import box, circle
from compose.view.recorded import Journals, scenes
from compose.view.scene import Player, Scene
from compose.view.words import TRAVELLING
from protocol.journal.journal_file import Tail
from protocol.messages import Command, DeadlineMissed, FinalReport, MissionEnd
from protocol.mission import Role
from protocol.motion import compose
from protocol.output import one_line
from protocol.wire import MAX_FRAME_BYTES, decode
from world.scenario import Scenario

MAPPED = 8
"""The largest number of robots that are drawn; of more, numbers are shown."""
REFRESHED = 10
"""The number of displays each second."""
LEAST_ROWS, MOST_ROWS = 6, 30
"""The height of a map in lines. On a terminal with less room there is none."""
PATH_POSITIONS = 400
"""The number of latest positions in a robot's path."""
ROLE_COLOURS: dict[Role, str] = {"a": "blue", "b": "red"}
LEGEND = "anchor +  hypothesis o  path and range lines; the circle is the anchor's range"
UNDECIDED = "no verdict yet"


@contextmanager
def live(scenario: Scenario, folder: Path) -> Iterator[None]:
    """Show the progress of the run recorded in `folder`, REFRESHED times a second."""
    console = tables.display_console(sys.stdout)
    small = len(scenario.robots) <= MAPPED
    shown = RobotMap(scenario, folder, console) if small else RobotCounts(scenario, folder)
    with Live(
        get_renderable=shown.display,
        console=console,
        auto_refresh=True,
        transient=True,
        refresh_per_second=REFRESHED,
    ):
        yield


class RobotCounts:
    """The numbers of robots by phase, state and verdict."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self._scenario = scenario
        self._journal = Tail(folder / WORLD_JOURNAL)
        self._commands: dict[str, Command] = {}

    def display(self) -> RenderableType:
        """Return the numbers, with the new frames of the world's journal."""
        known = Scenario | Command | DeadlineMissed | MissionEnd | FinalReport
        with suppress(OSError, ValueError):
            for frame in self._journal.news():
                message = decode(frame, known, MAX_FRAME_BYTES)
                if isinstance(message, Command):
                    self._commands[message.robot] = message
        commands = list(self._commands.values())
        waiting = len(self._scenario.robots) - len(commands)
        verdicts = Counter(_verdict(command) for command in commands)
        phases = Counter(f"phase {command.phase}" for command in commands)
        states = Counter(one_line(command.task) for command in commands)
        latest = max((command.tick for command in commands), default=0)
        rows = tables.table(["", "robots"], [], [])
        for heading, counts in (("outcome", verdicts), ("phase", phases), ("state", states)):
            numbers = ", ".join([f"{count} {name}" for name, count in counts.most_common()])
            rows.add_row(heading, numbers)
        if waiting:
            rows.add_row("", f"waiting for {waiting}")
        return Group(_title(self._scenario, latest), rows)


class RobotMap:
    """A map of the robots, anchors, hypotheses, ranges and contacts, and a line for each robot."""

    def __init__(self, scenario: Scenario, folder: Path, console: Console) -> None:
        self._scenario = scenario
        self._setup = of_scenario(scenario)
        self._console = console
        self._journals = Journals(folder)
        self._scene: Scene | None = None
        self._paths: dict[str, deque[Point]] = {one: deque(maxlen=PATH_POSITIONS) for one in self._setup.ids}

    def display(self) -> RenderableType:
        """Return the map at the latest complete tick, with the new frames of the journals."""
        with suppress(OSError, ValueError):
            self._journals.read()
        known = self._journals.known
        first = self._scene.tick + 1 if self._scene is not None else 0
        for tick in known.between(first, known.last - 1):
            for robot, pose in known.ticks[tick].truth.items():
                if robot in self._paths:
                    self._paths[robot].append((pose.x, pose.y))
        new = scenes(self._setup, known, max(first, known.last - 1), known.last - 1)
        self._scene = new[-1] if new else self._scene
        scene = self._scene
        title = _title(self._scenario, scene.tick if scene is not None else 0)
        if scene is not None and self._setup.visits:
            count = sum([player.is_localised for player in scene.players])
            title.append(f", {count} of {len(scene.players)} robots localised")
        if scene is None:
            return Group(title, Text(f"waiting for {', '.join(self._setup.ids)}"))
        lines = [Text(_line(player), no_wrap=True, overflow="ellipsis") for player in scene.players]
        rows = min(MOST_ROWS, self._console.size.height - len(lines) - 3)
        if rows < LEAST_ROWS or not self._console.encoding.lower().startswith("utf"):
            return Group(title, *lines)
        legend = f"{LEGEND}; localised robots are blue" if self._setup.visits else LEGEND
        return Group(title, self._map(scene, rows), *lines, Text(legend, style="dim", no_wrap=True))

    def _map(self, scene: Scene, rows: int) -> Text:
        drawing = Drawing(self._console.size.width - 1, rows, box(self._setup))
        for robot in self._setup.anchored:
            at = robot.anchor.x, robot.anchor.y
            drawing.dots(circle(at, self._setup.mission.sensing_range), "dim")
        for robot in self._setup.robots:
            drawing.line(self._paths[robot.id], self._hue(scene.player(robot.id)))
        for player in scene.players:
            self._lines(drawing, scene, player)
        for robot in self._setup.anchored:
            hue = self._hue(scene.player(robot.id))
            drawing.letter((robot.anchor.x, robot.anchor.y), "+", f"bold {hue}")
        for player in scene.players:
            hue = self._hue(player)
            for pose in self._hypotheses(player):
                drawing.letter(pose, "o", hue)
            if player.pose is not None:
                drawing.letter((player.pose.x, player.pose.y), player.robot[-1], f"bold reverse {hue}")
        return drawing.text()

    def _lines(self, drawing: Drawing, scene: Scene, player: Player) -> None:
        """Draw the range to the robot's anchor, dotted, and the contact with its peer."""
        if player.pose is None:
            return
        here = player.pose.x, player.pose.y
        robot = self._setup.robot_setup(player.robot)
        if player.anchor_range is not None:
            drawing.line([here, (robot.anchor.x, robot.anchor.y)], self._hue(player), gap=3)
        for contact in player.contacts:
            peer = scene.player(contact.peer).pose
            if peer is not None:
                drawing.line([here, (peer.x, peer.y)], "green")

    def _hue(self, player: Player) -> str:
        """Return the colour of a robot."""
        return ROLE_COLOURS[player.hue(self._setup.robot_setup(player.robot))]

    def _hypotheses(self, player: Player) -> list[Point]:
        """Return the positions of a robot's hypotheses in the world frame."""
        frame = self._setup.robot_setup(player.robot).frame
        held = player.held
        if held is None or frame is None:
            return []
        poses = held.world or [compose(frame, pose) for pose in held.local]
        return [(pose.x, pose.y) for pose in poses]


def _title(scenario: Scenario, tick: int) -> Text:
    return Text(f"{one_line(scenario.name)}, tick {tick} of {scenario.max_ticks} at most", style="bold")


def _verdict(command: Command) -> str:
    return str(command.verdict.__struct_config__.tag) if command.verdict is not None else UNDECIDED


def _destination(player: Player) -> str:
    """Return the robot to which a robot of a group travels, as the end of a line."""
    travels = player.command is not None and player.command.state == TRAVELLING
    return f" to {player.peer}" if travels and player.peer is not None else ""


def _line(player: Player) -> str:
    """Return the line of a robot: phase and state, speeds, the number of hypotheses, and ranges."""
    command, held = player.command, player.held
    if command is None:
        return f"{player.robot}  {one_line(player.activity)}"
    parts = [
        f"phase {command.phase}: {one_line(command.state)}{_destination(player)}",
        f"{command.v:.2f} m/s {command.omega:+.2f} rad/s",
    ]
    if held is not None:
        count = len(held.world or held.local)
        parts.append(f"{count} hypothes{'i' if count == 1 else 'e'}s")
    if player.anchor_range is not None:
        parts.append(f"anchor {player.anchor_range:.2f} m")
    for contact in player.contacts:
        length = f"{contact.range:.2f} m" if contact.range is not None else "no range"
        parts.append(f"{contact.peer} {length}")
    return f"{player.robot}  {'  '.join(parts)}"
