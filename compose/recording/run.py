"""The one model of a run, read from its journals. The ground truth is optional."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from compose.recording.claim_errors import Claim, claim, truth_held
from compose.recording.kills_file import Killed, kills_in
from compose.recording.reasons import ended
from compose.recording.recording_files import (
    WORLD_JOURNAL,
    JournalFile,
    agent_journal,
    journals_in,
    opened,
    robot_of,
)
from compose.recording.run_setup import RunSetup, of_configs, of_scenario
from protocol.journal.journal_file import CorruptJournal, take_all
from protocol.messages import (
    Command,
    Contact,
    Estimate,
    FinalReport,
    Localised,
    MissionEnd,
    Observation,
    RobotConfig,
    Verdict,
)
from protocol.motion import Controls, Pose
from world import world_journal
from world.scenario import Scenario
from world.tick import observations, verdicts_after
from world.world_journal import Tick, WorldHistory

if TYPE_CHECKING:
    from agent.process.agent_journal import AgentHistory


class Run(msgspec.Struct, frozen=True, dict=True):
    """A run, as its journals record it: the world's if there is one, and those of the agents.

    Agents' journals are read as far as they can be. Methods that name a robot raise KeyError if there is no
    such robot.
    """

    world: WorldHistory | None
    """The content of the world's journal; None in hardware mode, where there is no ground truth."""
    agents: dict[str, AgentHistory] = {}
    """The content of each agent's journal, by robot, up to its first frame that is damaged or out of order.

    Robots without a RobotConfig are omitted.
    """
    journals: dict[str, JournalFile] = {}
    """The journals, by file name, the world's first; empty for a run without journals."""
    source: object = "the recording"
    """The folder of the journals, for errors."""
    kills: tuple[Killed, ...] = ()
    """The processes that were killed in the run."""
    notes: tuple[str, ...] = ()
    """One line for each file other than a journal that cannot be read, and is ignored."""
    claim_estimates: dict[str, Estimate] = {}
    """The Estimate of each robot in the tick of its standing claim, if the run took place in this process."""

    # --- static data ---

    @property
    def history(self) -> WorldHistory:
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
        """The pairs, role a first; none in a team. In hardware mode, a robot without a pair is alone."""
        if self.world is not None:
            ids = self.robots
            return tuple([(ids[a], ids[b]) for a, b in self.world.scenario.pairs()])
        configs = [agent.config for agent in self.agents.values() if agent.config.team is None]
        pairs = [(one.robot, one.peer) if one.role == "a" else (one.peer, one.robot) for one in configs]
        paired = {robot for pair in pairs for robot in pair}
        return (*dict.fromkeys(pairs), *[(robot,) for robot in self.robots if robot not in paired])

    @cached_property
    def setup(self) -> RunSetup | None:
        """The robots and the parameters of the mission; None if no journal contains them."""
        if self.world is not None:
            return of_scenario(self.world.scenario)
        configs = {robot: agent.config for robot, agent in self.agents.items()}
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
        return max([len(agent.steps) for agent in self.agents.values()], default=0)

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
                    robot: agent.steps[tick].observation
                    for robot, agent in self.agents.items()
                    if tick < len(agent.steps)
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
        return failed or any(agent.config.tick_s is not None for agent in self.agents.values())

    def contact(self, robot: str, tick: int, peer: str | None = None) -> Contact | None:
        """Return the contact with `peer` in the Observation of `robot` at `tick`; None if it is unknown.

        Without `peer`, that with the nearest robot.
        """
        if not 0 <= tick < len(self.observations) or robot not in self.observations[tick]:
            return None
        contacts = self.observations[tick][robot].contacts
        return nearest_contact(contacts if peer is None else [one for one in contacts if one.peer == peer])

    def command(self, robot: str, tick: int) -> Command | None:
        """Return the Command of `robot` at `tick`; None if it was late or is unknown."""
        if self.world is not None:
            return self.world.ticks[tick].commands.get(robot) if tick < len(self.world.ticks) else None
        steps = self.agents[robot].steps if robot in self.agents else ()
        return steps[tick].command if tick < len(steps) else None

    def driven(self, robot: str, tick: int) -> Controls | None:
        """Return the controls that `robot` executed from `tick` to the next tick; in hardware mode, measured.

        None in the last tick.
        """
        if self.world is None:
            steps = self.agents[robot].steps
            return steps[tick + 1].observation.executed if tick + 1 < len(steps) else None
        if tick + 1 >= len(self.world.ticks):
            return None
        executed = self.world.ticks[tick + 1].world.executed
        assert executed is not None
        return executed[self._place[robot]]

    def truth(self, robot: str) -> tuple[Pose, ...]:
        """Return the true pose of `robot` at each tick; empty in hardware mode."""
        ticks = self.world.ticks if self.world is not None else ()
        return tuple([tick.truth.poses[self._place[robot]] for tick in ticks])

    @cached_property
    def _place(self) -> dict[str, int]:
        return {robot: place for place, robot in enumerate(self.robots)}

    # --- the agents and their claims ---

    def agent(self, robot: str) -> AgentHistory | None:
        """Return the content of the journal of `robot`; None if it has no RobotConfig.

        Raises FileNotFoundError if there is no journal and OSError if it cannot be read. Raises
        CorruptJournal if it is damaged before its end, has a frame out of order, or belongs to another robot
        or run.
        """
        name = agent_journal(robot)
        if name not in self.journals:
            raise FileNotFoundError(f"{self.source}: there is no {name}")
        self.readable(name)
        agent = self.agents.get(robot)
        if agent is not None and agent.unexpected is not None:
            raise CorruptJournal(f"{self.source}/{name}: {agent.unexpected.what}")
        if agent is not None and self.world is not None and not self.world.scenario.is_of(agent.config):
            what = "belongs to another run: its configuration does not match the world's"
            raise CorruptJournal(f"{self.source}/{name}: {what}")
        return agent

    def readable(self, *names: str) -> None:
        """Raise the problem of the first of the journals `names` that has one: OSError or CorruptJournal."""
        for name in names:
            if name in self.journals and (problem := self.journals[name].problem) is not None:
                raise problem

    def estimates(self, robot: str) -> tuple[Estimate, ...]:
        """Return the Estimates in the journal of `robot`. Raises OSError and CorruptJournal like `agent`."""
        agent = self.agent(robot)
        return agent.estimates if agent is not None else ()

    def claim(self, robot: str) -> Claim | None:
        """Return the standing claim of `robot`, with its errors; None without one, and in hardware mode."""
        made = self.standing_claim(robot) if self.world is not None else None
        if made is None:
            return None
        tick, verdict = made
        return claim(tick, verdict, self.ticks[tick].truth.poses[self._place[robot]])

    def standing_claim(self, robot: str) -> tuple[int, Localised] | None:
        """Return the claim that `robot` has made and not withdrawn, and its tick; None if there is none.

        The first claim of a robot of a pair is final; others withdraw claims.
        """
        made = None
        for tick in self.ticks:
            command = tick.commands.get(robot)
            if command is None:
                continue
            if not isinstance(command.verdict, Localised):
                made = None
            elif made is None:
                made = tick.truth.tick, command.verdict
                if self.scenario.in_pairs:
                    break
        return made

    def verdicts(self) -> dict[str, Verdict]:
        """Return the verdicts at the end of the run, by robot, of those that have one."""
        return verdicts_after(self.ticks[-1].world, self.ticks[-1].commands) if self.ticks else {}

    def truth_held(self, robot: str) -> bool | None:
        """Return whether `robot` held the true hypothesis at its standing claim (see `claim.truth_held`).

        None without a claim, with exact sensors, and if neither this process nor a journal has its Estimate.
        """
        one = self.claim(robot)
        if one is None or one.covariance is None:
            return None
        estimate = self.claim_estimate(robot, one.tick)
        if estimate is None:
            return None
        return truth_held(estimate, self.truth(robot)[one.tick], self.scenario.mission.accuracy)

    def claim_estimate(self, robot: str, tick: int) -> Estimate | None:
        """Return the Estimate of `robot` in the `tick` of its standing claim; None if it is not recorded."""
        if robot in self.claim_estimates or robot not in self.agents:
            return self.claim_estimates.get(robot)
        return next((one for one in self.agents[robot].estimates if one.tick == tick), None)

    # --- the end ---

    @property
    def end(self) -> MissionEnd | None:
        """The end of the mission; None if the recording breaks off."""
        if self.world is not None:
            return self.world.end
        return next((agent.end for agent in self.agents.values() if agent.end is not None), None)

    @property
    def final_reports(self) -> dict[str, FinalReport]:
        """The FinalReports in the world's journal, or in hardware mode in those of the agents, by robot."""
        if self.world is not None:
            return self.world.final_reports
        return {
            robot: agent.final_report
            for robot, agent in self.agents.items()
            if agent.final_report is not None
        }

    def title(self, pair: Sequence[str]) -> str:
        """Return the name of the run and its outcome, in one line.

        In hardware mode, these are of the robots in `pair`, which must have a RobotConfig.
        """
        if self.world is not None:
            one, last, end = self.world.scenario, len(self.world.ticks) - 1, self.world.end
            return f"{one.name}, seed {one.seed}, {one.planner_name}: {ended(end, last)}"
        agents = {robot: self.agents[robot] for robot in pair}
        planner_name = next(iter(agents.values())).config.planner_name
        return f"{' and '.join(agents)} in hardware mode, {planner_name}: {_outcome(agents)}"


def nearest_contact(contacts: Sequence[Contact]) -> Contact | None:
    """Return the contact with the shortest range; None if there is none. Drop-outs come last."""
    return min(contacts, key=lambda one: math.inf if one.range is None else one.range, default=None)


def _outcome(agents: Mapping[str, AgentHistory]) -> str:
    """Return the outcome that each robot recorded, in one line; if all agree, once."""
    ends = {
        robot: ended(agent.end, agent.end.tick if agent.end is not None else len(agent.steps) - 1)
        for robot, agent in agents.items()
    }
    if len(set(ends.values())) == 1:
        return next(iter(ends.values()))
    return "; ".join([f"{robot}: {end}" for robot, end in ends.items()])


def read(folder: Path, *, audited: bool = False) -> Run:
    """Return the run recorded in `folder`.

    A damaged list of killed processes is ignored, and is one of the notes.

    Raises OSError if there is no recording, or if the world's journal cannot be read. Raises CorruptJournal
    if the world's journal is damaged before its end; if it has a frame out of order, unless the run is to be
    `audited`; or if there is no world's journal and two peers' journals are of different runs.
    """
    paths = journals_in(folder) or [folder / WORLD_JOURNAL]
    run = of_journals({path.name: opened(path) for path in paths}, folder)
    if not audited and run.world is not None and run.world.unexpected is not None:
        raise CorruptJournal(f"{folder / WORLD_JOURNAL}: {run.world.unexpected.what}")
    kills, note = kills_in(folder)
    return replace(run, kills=kills, notes=(note,) if note is not None else ())


def of_frames(
    journals: Mapping[str, Iterable[bytes]],
    source: object = "the recording",
    messages: dict[bytes, Any] | None = None,
) -> Run:
    """Return the run with the frames of `journals`, by file name; `source` appears in errors.

    `messages` are those that this process has encoded itself, by frame: their frames are not decoded. Raises
    CorruptJournal like `read`, but not for a frame out of order.
    """
    return of_journals(
        {name: JournalFile(list(frames)) for name, frames in journals.items()}, source, messages
    )


def of_journals(
    journals: Mapping[str, JournalFile], source: object, messages: dict[bytes, Any] | None = None
) -> Run:
    """Return the run in `journals`, which need not be decoded; see `of_frames`. Raises like it.

    Messages that are decoded here and shared by two journals are added to `messages`.
    """
    decoded: dict[str, JournalFile] = {}
    world: WorldHistory | None = None
    agents: dict[str, AgentHistory] = {}
    shared = messages or {}  # Reports and Commands are added: each is in two journals, and decoded once
    for name, one in journals.items():
        if name == WORLD_JOURNAL:
            decoded[name], world = _world(one, f"{source}/{name}", shared)
        else:
            decoded[name], agent = _agent(one, robot_of(name), f"{source}/{name}", shared)
            if agent is not None:
                agents[robot_of(name)] = agent
    if world is None:
        _agree({robot: agent.config for robot, agent in agents.items()}, source)
        return Run(None, agents, decoded, source)
    ids = [robot.id for robot in world.scenario.robots]
    return Run(world, {robot: agents[robot] for robot in ids if robot in agents}, decoded, source)


def _world(journal: JournalFile, source: str, shared: dict[bytes, Any]) -> tuple[JournalFile, WorldHistory]:
    reading = world_journal.WorldJournalReading(shared)
    problem = take_all(reading, journal.frames, source)
    content = reading.content()
    if problem is not None:
        raise problem
    if content is None:
        raise CorruptJournal(f"{source}: it contains no scenario")
    return replace(journal, messages=reading.messages), content


def _agent(
    journal: JournalFile, robot: str, source: str, shared: dict[bytes, Any]
) -> tuple[JournalFile, AgentHistory | None]:
    from agent.process import agent_journal as of_agent  # noqa: PLC0415  # a launcher has no such journal

    reading = of_agent.AgentJournalReading(shared)
    problem = journal.problem or take_all(reading, journal.frames, source)
    agent = reading.content()
    if agent is not None and agent.config.robot != robot:
        problem, agent = CorruptJournal(f"{source} is the journal of {agent.config.robot}"), None
    return replace(journal, messages=reading.messages, problem=problem), agent


def _agree(configs: Mapping[str, RobotConfig], source: object) -> None:
    """Raise CorruptJournal if configurations are not of the same pair, group or team, and mission."""
    for robot, one in configs.items():
        other = next((configs[peer] for peer in one.others if peer in configs), None)
        if other is not None and _shared(one) != _shared(other):
            path = f"{source}/{agent_journal(other.robot)}"
            raise CorruptJournal(
                f"{path}: belongs to another run: its configuration does not match {robot}'s"
            )


def _shared(config: RobotConfig) -> tuple[object, ...]:
    """Return the part of a configuration that both robots of a pair share, or all of a group or a team."""
    shared = config.group, config.members, config.team, config.mission, config.planner_name, config.tick_s
    if config.members or config.team is not None:  # in its first meeting, a peer may have another one
        return shared
    anchors = [config.anchor, config.peer_anchor]
    return (*shared, anchors if config.role == "a" else anchors[::-1], config.rendezvous)
