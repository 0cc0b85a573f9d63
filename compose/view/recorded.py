"""Scenes of a run read from its journals, which may be complete, torn or still growing."""

from __future__ import annotations

from pathlib import Path

import msgspec

from compose.recording.run import WORLD_JOURNAL, agent_journal, journals_in, robot_of
from compose.recording.summary_json import SUMMARY
from compose.view.cast import Stage, of_configs, of_scenario
from compose.view.facts import Gathering
from compose.view.scene import Scene, scene
from protocol import files
from protocol.journal.environment import is_blank
from protocol.journal.journal_file import CorruptJournal, OtherVersion, Tail
from protocol.messages import FinalReport, MissionEnd, OfRobot
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.tick import World, observations
from world.world_journal import JournalReading, opened


class Performance(msgspec.Struct, frozen=True):
    """A recorded run with all its scenes."""

    stage: Stage
    scenes: tuple[Scene, ...]
    """One scene per tick, beginning with the first known tick."""
    end: MissionEnd | None
    """The end of the mission; None if the recording breaks off."""
    final_reports: dict[str, FinalReport]
    notes: tuple[str, ...]
    """One line for each part of the recording that cannot be read."""


def read(folder: Path) -> Performance:
    """Return the run recorded in `folder`, up to the end of its journals.

    Raises FileNotFoundError if no journal holds a configuration, OSError if one cannot be read.
    """
    journals = Journals(folder)
    journals.read()
    journals.fill()
    stage, known = journals.stage, journals.known
    if stage is None:
        raise FileNotFoundError("; ".join(journals.notes) or f"{folder} holds no journal")
    return Performance(stage, scenes(stage, known), known.end, known.final_reports, tuple(journals.notes))


def scenes(stage: Stage, known: Gathering, first: int = 0, last: int | None = None) -> tuple[Scene, ...]:
    """Return the scenes of the known ticks from `first` to `last`, inclusive."""
    last = known.last if last is None else min(last, known.last)
    before = known.ticks.get(first - 1)
    shown = []
    for tick in range(first, last + 1):
        now = known.ticks.get(tick)
        if now is not None:
            shown.append(scene(stage, before, now, known.end))
        before = now
    return tuple(shown)


class Journals:
    """The journals in a folder, read incrementally while they grow."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.known = Gathering()
        self.stage: Stage | None = None
        """The static data of the run; None until a scenario or a configuration has been read."""
        self.notes: list[str] = []
        """One line per damaged journal. Its frames after the damage are ignored."""
        self._tails: dict[str, Tail] = {}
        self._world: JournalReading | None = None
        self._head: list[bytes] = []
        """The frames of the world's journal that precede its scenario."""

    def read(self) -> None:
        """Read the frames appended since the last call. Raises OSError."""
        for path in journals_in(self.folder):
            tail = self._tails.setdefault(path.name, Tail(path))
            try:
                frames = tail.news()
                if path.name == WORLD_JOURNAL:
                    self._fold_world(frames, path)
                else:
                    self._fold_agent(frames, path)
            except OtherVersion as error:
                self._note(f"{self.folder}: {error.versions}; {error.remedy}")  # the same in all journals
            except (CorruptJournal, MalformedFrame) as error:
                text = str(error)
                self._note(text if text.startswith(str(path)) else f"{path}: {text}")
        configs = self.known.configs
        if self._world is not None:
            scenario = self._world.world.scenario
            for robot in [robot for robot, one in configs.items() if not scenario.is_of(one)]:
                path = self.folder / agent_journal(robot)
                self._note(f"{path}: belongs to another run: its configuration does not match the world's")
        if self._world is None and len(configs) > (len(self.stage.robots) if self.stage is not None else 0):
            self.stage = of_configs(self.folder.name, configs)

    def fill(self) -> None:
        """Compute missing observations from the world's journal. Call once the journals are complete."""
        if self._world is None:
            return
        for world in self._world.content().worlds:
            facts = self.known.at(world.truth.tick)
            if len(facts.observations) < len(world.scenario.robots):
                for observation in observations(world):
                    facts.observations.setdefault(observation.robot, observation)

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def _fold_agent(self, frames: list[bytes], path: Path) -> None:
        robot = robot_of(path)
        for frame in frames:
            self.known.take(decode(frame, OfRobot, MAX_FRAME_BYTES), len(frame), robot)

    def _fold_world(self, frames: list[bytes], path: Path) -> None:
        if self._world is None:
            frames = self._head + frames
            if is_blank(frames):
                self._head = frames
                return
            scenario, _, rest = opened(frames, path)
            self._world = JournalReading(scenario)
            self.stage = of_scenario(scenario, self._mode())
            self._show(self._world.world)
            frames = list(rest)
        reading = self._world
        first_new = len(reading.ticks)
        for frame in frames:
            if reading.disorder is not None:
                break
            if not reading.take(frame):
                assert reading.disorder is not None
                self._note(f"{path}: {reading.disorder.what}; all later frames are ignored")
        for tick in reading.ticks[first_new:]:
            self._show(tick.world)
            facts = self.known.at(tick.world.truth.tick)
            for command in tick.commands.values():
                self.known.take(command, 0)
            facts.late.update({robot.id for robot in tick.world.scenario.robots} - tick.commands.keys())
        if reading.mission_outcome is None:
            self._show(reading.world)
        self.known.end = reading.end or self.known.end
        self.known.final_reports.update(reading.final_reports)

    def _show(self, world: World) -> None:
        """Add the ground truth and the reports in flight of the world's current tick."""
        ids = [robot.id for robot in world.scenario.robots]
        facts = self.known.at(world.truth.tick)
        facts.truth.update(zip(ids, world.truth.poses, strict=True))
        self.known.has_truth = True
        if world.links:
            links = [link for one, other in world.pairs for link in ((one, other), (other, one))]
            for (sender, receiver), air in zip(links, world.links, strict=True):
                facts.under_way[ids[sender], ids[receiver]] = tuple([flying.tick for flying in air.flying])

    def _mode(self) -> str | None:
        try:
            summary = msgspec.json.decode(files.read_bytes(self.folder / SUMMARY))
            return str(summary["mode"])
        except (OSError, msgspec.MsgspecError, TypeError, KeyError):
            return None
