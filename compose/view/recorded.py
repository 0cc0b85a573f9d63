"""Scenes of a run: of a recording, and of journals that may still be growing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from compose.errors import UserError
from compose.recording.kills_file import kills_in
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal, journals_in, robot_of
from compose.recording.run import Run
from compose.recording.run_setup import RunSetup, of_configs, of_scenario
from compose.recording.summary_json import SUMMARY_JSON
from compose.view.reported import reported_paths
from compose.view.run_data import RunData
from compose.view.scene import Scene, scene
from protocol import documents
from protocol.journal.journal_file import CorruptJournal, OtherVersion, Tail
from protocol.messages import OfRobot
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.scenario import Scenario
from world.world_journal import WorldJournalReading


def run_data(run: Run) -> RunData:
    """Return the data of a recording. The world's journal takes precedence over those of the agents."""
    known = RunData()
    if run.world is not None:
        for tick in run.world.ticks:
            known.add_tick(tick)
        if run.world.ahead is not None:
            known.add_world(run.world.ahead)
    for name, journal in run.journals.items():
        if name != WORLD_JOURNAL:
            for message, frame in zip(journal.messages, journal.frames, strict=False):
                known.add(message, len(frame), robot_of(name))
    if run.world is not None:
        known.add_observations(run.world.worlds)
    if run.end is not None:
        known.conclude(run.end)
    known.add_final_reports(run.final_reports)
    known.add_kills(run.kills)
    return known


def scenes_of(run: Run) -> tuple[Scene, ...]:
    """Return the scenes of a recording; none if no journal has a configuration."""
    return scenes(run.setup, run_data(run)) if run.setup is not None else ()


def scenes(setup: RunSetup, known: RunData, first: int = 0, last: int | None = None) -> tuple[Scene, ...]:
    """Return the scenes of the known ticks from `first` to `last`, inclusive."""
    last = known.last if last is None else min(last, known.last)
    paths = reported_paths(setup, known, last)
    shown = []
    for tick in known.between(first, last):
        before, now = known.ticks.get(tick - 1), known.ticks[tick]
        reported = {robot: path[tick] for robot, path in paths.items() if tick < len(path)}
        shown.append(scene(known.setup_at(setup, tick), before, now, known.end, reported))
    return tuple(shown)


def checked(run: Run) -> tuple[Sequence[str], RunSetup]:
    """Return all robots of `run`, also those without a journal, and its static data.

    Raises OSError or CorruptJournal if a journal cannot be read to its end, UserError if there is no
    configuration.
    """
    run.readable(*run.journals)
    for robot in run.robots:
        if agent_journal(robot) in run.journals:
            run.agent(robot)
    setup = run.setup
    if setup is None:
        raise UserError(
            f"{run.source}: there is no {WORLD_JOURNAL}, and no robot's journal has a configuration"
        )
    peers = [] if run.world is not None else [robot_setup.peer for robot_setup in setup.robots]
    return list(dict.fromkeys([*run.robots, *sorted(peers)])), setup


class Journals:
    """The journals in a folder, read incrementally while they grow."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.known = RunData()
        self.setup: RunSetup | None = None
        """The static data of the run; None until a scenario or a configuration has been read."""
        self.notes: list[str] = []
        """One line per damaged journal. Its frames after the damage are ignored."""
        self._tails: dict[str, Tail] = {}
        self._world = WorldJournalReading()

    @property
    def scenario(self) -> Scenario | None:
        """The scenario in the world's journal; None until it has been read, or if there is none."""
        return self._world.world.scenario if self._world.world is not None else None

    def read(self) -> None:
        """Read the frames appended since the last call, as many as `Tail` reads at once. Raises OSError."""
        for path in journals_in(self.folder):
            tail = self._tails.setdefault(path.name, Tail(path))
            try:
                frames = tail.news()
                if path.name == WORLD_JOURNAL:
                    self._fold_world(frames, path)
                else:
                    for frame in frames:
                        message = decode(frame, OfRobot, MAX_FRAME_BYTES)
                        self.known.add(message, len(frame), robot_of(path.name))
            except OtherVersion as error:
                self._note(f"{self.folder}: {error.versions}; {error.remedy}")  # the same in all journals
            except CorruptJournal as error:
                self._note(str(error))
            except MalformedFrame as error:
                self._note(f"{path}: {error}")
        configs = self.known.configs
        world = self._world.world
        if world is not None:
            scenario = world.scenario
            for robot in [robot for robot, one in configs.items() if not scenario.is_of(one)]:
                path = self.folder / agent_journal(robot)
                self._note(f"{path}: belongs to another run: its configuration does not match the world's")
        if world is None and len(configs) > (len(self.setup.robots) if self.setup is not None else 0):
            self.setup = of_configs(self.folder.name, configs)

    @property
    def more(self) -> bool:
        """True if the last call of `read` has left frames to be read by the next one."""
        return any(tail.more for tail in self._tails.values())

    def fill(self) -> None:
        """Add what follows from complete journals: missing observations, and the killed processes."""
        content = self._world.content()
        if content is not None:
            self.known.add_observations(content.worlds)
        kills, note = kills_in(self.folder)
        self.known.add_kills(kills)
        if note is not None:
            self._note(note)

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def _fold_world(self, frames: list[bytes], path: Path) -> None:
        reading = self._world
        first_new = len(reading.ticks)
        for frame in frames:
            if reading.unexpected is not None:
                break
            if not reading.take(frame):
                assert reading.unexpected is not None
                self._note(f"{path}: {reading.unexpected.what}; all later frames are ignored")
        if reading.world is None:
            return
        if self.setup is None or self.setup.seed is None:
            self.setup = of_scenario(reading.world.scenario, self._mode())
        for tick in reading.ticks[first_new:]:
            self.known.add_tick(tick)
        if reading.recomputed_end is None:
            self.known.add_world(reading.world)
        if reading.end is not None:
            self.known.conclude(reading.end)
        self.known.add_final_reports(reading.final_reports)

    def _mode(self) -> str | None:
        try:
            summary = documents.json_file(self.folder / SUMMARY_JSON)
            return str(summary["mode"])
        except (OSError, msgspec.MsgspecError, TypeError, KeyError):
            return None
