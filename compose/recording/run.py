"""The recording of a run: its folder, its journals and their content."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from compose.errors import UserError
from compose.recording.cast import Stage, of_configs, of_scenario
from compose.recording.claim import Claim, claim
from protocol.journal import journal_file
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import (
    Command,
    Contact,
    Estimate,
    FinalReport,
    Localised,
    MissionEnd,
    Observation,
    Outcome,
    RobotConfig,
)
from protocol.motion import Controls, Pose
from protocol.output import one_line
from protocol.wire import MalformedFrame
from world import world_journal
from world.scenario import Scenario
from world.tick import observations
from world.world_journal import History, Tick

if TYPE_CHECKING:
    from agent.process import agent_journal as of_agent
    from agent.process.agent_journal import Past
WORLD_JOURNAL = "world.journal"


def agent_journal(robot: str) -> str:
    """Return the file name of the journal of the agent of `robot`."""
    return f"agent-{robot}.journal"


def robot_of(name: str) -> str:
    """Return the robot of an agent's journal, from its file name."""
    return name.removeprefix("agent-").removesuffix(".journal")


def journals_in(folder: Path) -> list[Path]:
    """Return the paths of the journals in `folder`, the world's first, and of links to missing journals."""
    world = folder / WORLD_JOURNAL
    return [*([world] if os.path.lexists(world) else []), *sorted(folder.glob(agent_journal("*")))]


@contextmanager
def folder_for(out: Path | None) -> Iterator[Path]:
    """Yield the folder of a recording: `out`, created if necessary, or a temporary one. Raises UserError."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
            yield Path(folder)
        return
    make(out)
    yield out


def make(out: Path) -> None:
    """Create the folder `out` and check that it is writable. Raises UserError if it is not."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UserError(cannot_write(out, error)) from None


def cannot_write(out: Path, error: OSError) -> str:
    """Return the message for the user that `out` cannot be written."""
    return f"--out: {out} cannot be written: {error.strerror or error}"


class JournalFile(msgspec.Struct, frozen=True):
    """A journal on disk."""

    frames: list[bytes]
    """The complete frames."""
    torn: int = 0
    """The number of bytes of a torn write at the end."""
    messages: list[Any] = []
    """The messages in `frames`, up to the first that is damaged or out of order."""
    problem: OSError | CorruptJournal | None = None
    """The error because of which not all of it can be read; None for a frame out of order."""


class Run(msgspec.Struct, frozen=True, dict=True):
    """A run, as its journals record it: the world's if there is one, and those of the agents.

    Agents' journals are read as far as they can be. Methods that name a robot raise KeyError if there is no
    such robot.
    """

    world: History | None
    """The content of the world's journal; None in hardware mode, where there is no ground truth."""
    pasts: dict[str, Past] = {}
    """The content of each agent's journal, by robot, up to its first frame that is damaged or out of order.

    Robots without a RobotConfig are omitted.
    """
    journals: dict[str, JournalFile] = {}
    """The journals, by file name, the world's first; empty for a run without journals."""
    source: object = "the recording"
    """The folder of the journals, for errors."""

    # --- static data ---

    @property
    def history(self) -> History:
        """The content of the world's journal. Raises FileNotFoundError if there is none."""
        if self.world is None:
            raise FileNotFoundError(f"{self.source}: there is no {WORLD_JOURNAL}")
        return self.world

    @property
    def scenario(self) -> Scenario:
        """The scenario. Raises FileNotFoundError if there is no world's journal."""
        return self.history.scenario

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots of the scenario; in hardware mode, those that have a journal."""
        if self.world is not None:
            return tuple([robot.id for robot in self.world.scenario.robots])
        return tuple([robot_of(name) for name in self.journals])

    @property
    def pairs(self) -> tuple[tuple[str, ...], ...]:
        """The pairs, role a first. In hardware mode, a robot without a RobotConfig is alone."""
        if self.world is not None:
            ids = self.robots
            return tuple([(ids[a], ids[b]) for a, b in self.world.scenario.pairs()])
        configs = [past.config for past in self.pasts.values()]
        pairs = [(one.robot, one.peer) if one.role == "a" else (one.peer, one.robot) for one in configs]
        paired = {robot for pair in pairs for robot in pair}
        return (*dict.fromkeys(pairs), *[(robot,) for robot in self.robots if robot not in paired])

    @cached_property
    def stage(self) -> Stage | None:
        """The robots and the parameters of the mission; None if no journal contains them."""
        if self.world is not None:
            return of_scenario(self.world.scenario)
        configs = {robot: past.config for robot, past in self.pasts.items()}
        return of_configs(Path(str(self.source)).name, configs) if configs else None

    # --- ticks ---

    @property
    def ticks(self) -> tuple[Tick, ...]:
        """The complete ticks of the world's journal. Raises FileNotFoundError if there is none."""
        return self.history.ticks

    @property
    def length(self) -> int:
        """The number of complete ticks of the world's journal; in hardware mode, of the longest journal."""
        if self.world is not None:
            return len(self.world.ticks)
        return max([len(past.steps) for past in self.pasts.values()], default=0)

    @cached_property
    def observations(self) -> tuple[dict[str, Observation], ...]:
        """The Observations of each tick, by robot: those that the world computes from the journaled Commands.

        They include the tick after the last Commands. In hardware mode, they are the recorded ones.
        """
        if self.world is not None:
            return tuple([{one.robot: one for one in observations(world)} for world in self.world.worlds])
        return tuple(
            [
                {
                    robot: past.steps[tick].observation
                    for robot, past in self.pasts.items()
                    if tick < len(past.steps)
                }
                for tick in range(self.length)
            ]
        )

    @property
    def forced(self) -> bool:
        """True if the world may have continued without an answer: in real time, or after a timeout.

        In hardware mode, it always may.
        """
        failed = self.world is None or (self.world.end is not None and self.world.end.outcome == "failed")
        return failed or any(past.config.tick_s is not None for past in self.pasts.values())

    def contact(self, robot: str, tick: int) -> Contact | None:
        """Return the contact in the Observation of `robot` at `tick`; None if it is unknown."""
        if not 0 <= tick < len(self.observations) or robot not in self.observations[tick]:
            return None
        return next(iter(self.observations[tick][robot].contacts), None)

    def command(self, robot: str, tick: int) -> Command | None:
        """Return the Command of `robot` at `tick`; None if it was late or is unknown."""
        if self.world is not None:
            return self.world.ticks[tick].commands.get(robot) if tick < len(self.world.ticks) else None
        steps = self.pasts[robot].steps if robot in self.pasts else ()
        return steps[tick].command if tick < len(steps) else None

    def driven(self, robot: str, tick: int) -> Controls | None:
        """Return the controls that `robot` executed from `tick` to the next tick; in hardware mode, measured.

        None in the last tick.
        """
        if self.world is None:
            steps = self.pasts[robot].steps
            return steps[tick + 1].observation.executed if tick + 1 < len(steps) else None
        if tick + 1 >= len(self.world.ticks):
            return None
        executed = self.world.ticks[tick + 1].world.executed
        assert executed is not None
        return executed[self._place[robot]]

    def truth(self, robot: str) -> tuple[Pose, ...]:
        """Return the true pose of `robot` at each tick; empty in hardware mode."""
        return tuple([poses[self._place[robot]] for poses in self._poses])

    @cached_property
    def _poses(self) -> list[tuple[Pose, ...]]:
        """The true poses at each tick, in the order of the scenario."""
        return [tick.truth.poses for tick in self.world.ticks] if self.world is not None else []

    @cached_property
    def _place(self) -> dict[str, int]:
        return {robot: place for place, robot in enumerate(self.robots)}

    # --- what the robots found ---

    def past(self, robot: str) -> Past | None:
        """Return the content of the journal of `robot`; None if it has no RobotConfig.

        Raises FileNotFoundError if there is no journal and OSError if it cannot be read. Raises
        CorruptJournal if it is damaged before its end, has a frame out of order, or belongs to another robot
        or run.
        """
        name = agent_journal(robot)
        if name not in self.journals:
            raise FileNotFoundError(f"{self.source}: there is no {name}")
        self.readable(name)
        past = self.pasts.get(robot)
        if past is not None and past.disorder is not None:
            raise CorruptJournal(f"{self.source}/{name}: {past.disorder.what}")
        if past is not None and self.world is not None and not self.world.scenario.is_of(past.config):
            what = "belongs to another run: its configuration does not match the world's"
            raise CorruptJournal(f"{self.source}/{name}: {what}")
        return past

    def readable(self, *names: str) -> None:
        """Raise the problem of the first of the journals `names` that has one: OSError or CorruptJournal."""
        for name in names:
            if name in self.journals and (problem := self.journals[name].problem) is not None:
                raise problem

    def estimates(self, robot: str) -> tuple[Estimate, ...]:
        """Return the Estimates in the journal of `robot`. Raises OSError and CorruptJournal like `past`."""
        past = self.past(robot)
        return past.estimates if past is not None else ()

    def claim(self, robot: str) -> Claim | None:
        """Return the first claim of `robot`, with its errors; None if it made none, and in hardware mode."""
        for tick in self.ticks if self.world is not None else ():
            command = tick.commands.get(robot)
            if command is not None and isinstance(command.verdict, Localised):
                return claim(tick.truth.tick, command.verdict, tick.truth.poses[self._place[robot]])
        return None

    # --- the end ---

    @property
    def end(self) -> MissionEnd | None:
        """The end of the mission; None if the recording breaks off."""
        if self.world is not None:
            return self.world.end
        return next((past.end for past in self.pasts.values() if past.end is not None), None)

    @property
    def final_reports(self) -> dict[str, FinalReport]:
        """The FinalReports in the world's journal, or in hardware mode in those of the agents, by robot."""
        if self.world is not None:
            return self.world.final_reports
        return {
            robot: past.final_report for robot, past in self.pasts.items() if past.final_report is not None
        }

    def title(self, pair: Sequence[str]) -> str:
        """Return the name of the run and its outcome, in one line.

        In hardware mode, these are of the robots in `pair`, which must have a RobotConfig.
        """
        if self.world is not None:
            one, last, end = self.world.scenario, len(self.world.ticks) - 1, self.world.end
            how = ended(end.outcome, last, end.reason) if end is not None else broken_off(last)
            return f"{one.name}, seed {one.seed}, {one.planner_name}: {how}"
        pasts = {robot: self.pasts[robot] for robot in pair}
        planner_name = next(iter(pasts.values())).config.planner_name
        return f"{' and '.join(pasts)} in hardware mode, {planner_name}: {_outcome(pasts)}"


def _outcome(pasts: Mapping[str, Past]) -> str:
    """Return the outcome that each robot recorded, in one line; if all agree, once."""
    ends = {
        robot: ended(past.end.outcome, past.end.tick, past.end.reason)
        if past.end is not None
        else broken_off(len(past.steps) - 1)
        for robot, past in pasts.items()
    }
    if len(set(ends.values())) == 1:
        return next(iter(ends.values()))
    return "; ".join([f"{robot}: {end}" for robot, end in ends.items()])


def broken_off(ticks: int) -> str:
    """Return the outcome of a run without an end, in one line."""
    return f"the recording breaks off after {max(0, ticks)} ticks"


def ended(outcome: Outcome, ticks: int, reason: str | None) -> str:
    """Return the outcome of a run that ended, in one line."""
    return f"{outcome} after {ticks} ticks{f' ({one_line(reason)})' if reason else ''}"


def read(folder: Path, *, audited: bool = False) -> Run:
    """Return the run recorded in `folder`.

    Raises OSError if there is no recording or the world's journal cannot be read, and CorruptJournal if that
    is damaged before its end or, unless the run is to be `audited`, has a frame out of order. Raises
    CorruptJournal also if there is no such journal and two peers' journals are of different runs.
    """
    paths = journals_in(folder) or [folder / WORLD_JOURNAL]
    run = of_journals({path.name: _opened(path) for path in paths}, folder)
    if not audited and run.world is not None and run.world.disorder is not None:
        raise CorruptJournal(f"{folder / WORLD_JOURNAL}: {run.world.disorder.what}")
    return run


def _opened(path: Path) -> JournalFile:
    try:
        return JournalFile(*journal_file.torn(path))
    except (OSError, CorruptJournal) as error:
        if path.name == WORLD_JOURNAL or isinstance(error, journal_file.OtherVersion):
            raise
        return JournalFile([], problem=error)


def of_frames(journals: Mapping[str, Iterable[bytes]], source: object = "the recording") -> Run:
    """Return the run with the frames of `journals`, by file name; `source` appears in errors.

    Raises CorruptJournal like `read`, but not for a frame out of order.
    """
    return of_journals({name: JournalFile(list(frames)) for name, frames in journals.items()}, source)


def of_journals(journals: Mapping[str, JournalFile], source: object) -> Run:
    """Return the run in `journals`, whose frames have not been decoded yet. Raises like `of_frames`."""
    decoded: dict[str, JournalFile] = {}
    world: History | None = None
    pasts: dict[str, Past] = {}
    for name, one in journals.items():
        if name == WORLD_JOURNAL:
            decoded[name], world = _world(one, f"{source}/{name}")
        else:
            decoded[name], past = _agent(one, robot_of(name), f"{source}/{name}")
            if past is not None:
                pasts[robot_of(name)] = past
    if world is None:
        _agree({robot: past.config for robot, past in pasts.items()}, source)
        return Run(None, pasts, decoded, source)
    ids = [robot.id for robot in world.scenario.robots]
    return Run(world, {robot: pasts[robot] for robot in ids if robot in pasts}, decoded, source)


def _world(journal: JournalFile, source: str) -> tuple[JournalFile, History]:
    reading = world_journal.WorldJournalReading()
    problem = _take(reading, journal.frames, source)
    content = reading.content()
    if problem is not None:
        raise problem
    if content is None:
        raise CorruptJournal(f"{source}: it contains no scenario")
    return replace(journal, messages=reading.messages), content


def _agent(journal: JournalFile, robot: str, source: str) -> tuple[JournalFile, Past | None]:
    from agent.process import agent_journal as of_agent  # noqa: PLC0415  # a launcher has no such journal

    reading = of_agent.AgentJournalReading()
    problem = journal.problem or _take(reading, journal.frames, source)
    past = reading.content()
    if past is not None and past.config.robot != robot:
        problem, past = CorruptJournal(f"{source} is the journal of {past.config.robot}"), None
    return replace(journal, messages=reading.messages, problem=problem), past


def _take(
    reading: of_agent.AgentJournalReading | world_journal.WorldJournalReading,
    frames: Iterable[bytes],
    source: str,
) -> CorruptJournal | None:
    """Give `frames` to `reading`, up to the first out of order; return the error of one that is damaged."""
    try:
        for frame in frames:
            if not reading.take(frame):
                break
    except MalformedFrame as error:
        return CorruptJournal(f"{source}: {error}")
    return None


def _agree(configs: Mapping[str, RobotConfig], source: object) -> None:
    """Raise CorruptJournal if the configurations of two peers are not of the same pair and mission."""
    for robot, one in configs.items():
        other = configs.get(one.peer)
        if other is not None and _shared(one, robot) != _shared(other, robot):
            path = f"{source}/{agent_journal(one.peer)}"
            raise CorruptJournal(
                f"{path}: belongs to another run: its configuration does not match {robot}'s"
            )


def _shared(config: RobotConfig, robot: str) -> tuple[object, ...]:
    """Return the part of a configuration that both robots of a pair share, in the view of `robot`."""
    own = config.robot == robot
    return (
        config.robot if own else config.peer,
        (config.role == "a") == own,
        config.anchor if own else config.peer_anchor,
        config.peer_anchor if own else config.anchor,
        config.mission,
        config.planner_name,
        config.rendezvous,
        config.tick_s,
    )


@contextmanager
def user_errors(folder: Path) -> Iterator[None]:
    """Raise UserError, with one line, for every error that prevents reading the recording in `folder`."""
    try:
        yield
    except OSError as error:
        journals = journals_in(folder)
        if isinstance(error, FileNotFoundError) and folder / WORLD_JOURNAL not in journals:
            raise UserError(f"{folder} contains no recording: there is no {WORLD_JOURNAL}") from None
        where = (error.filename if journals else None) or folder
        raise UserError(f"{where} cannot be read: {error.strerror or error}") from None
    except CorruptJournal as error:
        raise UserError(str(error)) from None
