"""A run as its journals tell it: whole, torn, or growing."""

from __future__ import annotations

from pathlib import Path

import msgspec

from compose.recording.run import WORLD_JOURNAL, agent_journal, journals_in, robot_of
from compose.recording.summary_json import SUMMARY
from compose.view.cast import Stage, of_briefings, of_scenario
from compose.view.facts import Gathering
from compose.view.scene import Scene, scene
from protocol import files
from protocol.journal.environment import is_blank
from protocol.journal.journal_file import CorruptJournal, Tail
from protocol.messages import FinalReport, MissionEnd, OfRobot
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.tick import World, observations
from world.world_journal import JournalReading, opened


class Performance(msgspec.Struct, frozen=True):
    """A whole run, to be looked at."""

    stage: Stage
    scenes: tuple[Scene, ...]
    """one a tick, from the first that is known on"""
    end: MissionEnd | None
    """none where the record breaks off"""
    final_reports: dict[str, FinalReport]
    notes: tuple[str, ...]
    """what could not be read, a line each"""


def read(folder: Path) -> Performance:
    """The run whose record is in `folder`, as far as it goes.

    Raises FileNotFoundError if there is no journal that tells of a run, OSError if one cannot be read.
    """
    journals = Journals(folder)
    journals.read()
    journals.fill()
    stage, known = journals.stage, journals.known
    if stage is None:
        raise FileNotFoundError("; ".join(journals.notes) or f"{folder} holds no journal")
    return Performance(stage, scenes(stage, known), known.end, known.final_reports, tuple(journals.notes))


def scenes(stage: Stage, known: Gathering, first: int = 0, last: int | None = None) -> tuple[Scene, ...]:
    """Of the ticks from `first` through `last` of which anything is known."""
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
    """The journals in a folder, read as they grow."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.known = Gathering()
        self.stage: Stage | None = None
        """none until somebody has told"""
        self.notes: list[str] = []
        """journals that are damaged; what stands in one from there on is left out"""
        self._tails: dict[str, Tail] = {}
        self._world: JournalReading | None = None
        self._head: list[bytes] = []
        """of the world's journal, while its scenario has not come"""

    def read(self) -> None:
        """Fold in what has come since the last time. Raises OSError."""
        for path in journals_in(self.folder):
            tail = self._tails.setdefault(path.name, Tail(path))
            try:
                frames = tail.news()
                if path.name == WORLD_JOURNAL:
                    self._fold_world(frames, path)
                else:
                    self._fold_agent(frames, path)
            except (CorruptJournal, MalformedFrame) as error:
                text = str(error)
                self._note(text if text.startswith(str(path)) else f"{path}: {text}")
        told = self.known.configs
        if self._world is not None:
            for robot in [robot for robot, one in told.items() if not self._world.world.scenario.is_of(one)]:
                path = self.folder / agent_journal(robot)
                self._note(f"{path}: another run's: its briefing is not this world's")
        if self._world is None and len(told) > (len(self.stage.robots) if self.stage is not None else 0):
            self.stage = of_briefings(self.folder.name, told)

    def fill(self) -> None:
        """Nothing more will come: what is missing of what robots sensed follows from the world's journal."""
        if self._world is None:
            return
        for world in self._world.told().worlds:
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
        told = len(reading.ticks)
        for frame in frames:
            if reading.disorder is not None:
                break
            if not reading.take(frame):
                assert reading.disorder is not None
                self._note(f"{path}: {reading.disorder.what}; what comes after it is left out")
        for tick in reading.ticks[told:]:
            self._show(tick.world)
            facts = self.known.at(tick.world.truth.tick)
            for command in tick.commands.values():
                self.known.take(command, 0)
            facts.late.update({robot.id for robot in tick.world.scenario.robots} - tick.commands.keys())
        if reading.judgement is None:
            self._show(reading.world)
        self.known.end = reading.end or self.known.end
        self.known.final_reports.update(reading.final_reports)

    def _show(self, world: World) -> None:
        """The truth at a tick, and the air."""
        ids = [robot.id for robot in world.scenario.robots]
        facts = self.known.at(world.truth.tick)
        facts.truth.update(zip(ids, world.truth.poses, strict=True))
        self.known.has_truth = True
        if world.air:
            links = [link for one, other in world.pairs for link in ((one, other), (other, one))]
            for (sender, receiver), air in zip(links, world.air, strict=True):
                facts.under_way[ids[sender], ids[receiver]] = tuple([flying.tick for flying in air.flying])

    def _mode(self) -> str | None:
        try:
            told = msgspec.json.decode(files.read_bytes(self.folder / SUMMARY))
            return str(told["mode"])
        except (OSError, msgspec.MsgspecError, TypeError, KeyError):
            return None
