"""A complete mission in one process, without a network, with the same planner, radio and world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from agent.planning.planner import Planner
from agent.process.agent_journal import FramedReport
from agent.process.robot import Robot
from compose.launch.planner_loader import planner_of
from compose.recording.recording_files import WORLD_JOURNAL, JournalFile, agent_journal
from compose.recording.run import Run, of_frames
from protocol.journal import environment
from protocol.journal.journal_file import Journal, MemoryJournal, Sink
from protocol.messages import Command, Estimate, FinalReport, Localised, MissionEnd, RobotConfig
from protocol.wire import EncodedMessages, encode
from world.faults import LATEST
from world.scenario import Scenario
from world.simulation import Simulation
from world.world_journal import Tick, WorldHistory

MAPPED_BYTES = 8 << 20
"""The size of a block. Once it has been freed, the C library keeps the memory of smaller ones, all arrays."""


def run_mission(scenario: Scenario, out: Path | None = None) -> Run:
    """Run `scenario`, and write its journals to `out`. They are identical to those of a run as processes.

    Raises CannotRecord if `out` contains a recording, or cannot be written.
    """
    if out is None:
        return played(scenario, {})
    with ExitStack() as stack:
        return played(
            scenario, {name: stack.enter_context(Journal(out / name)) for name in journals(scenario)}
        )


def journals(scenario: Scenario) -> list[str]:
    """Return the file names of the journals of a run of `scenario`."""
    return [*[agent_journal(robot.id) for robot in scenario.robots], WORLD_JOURNAL]


def recorded(scenario: Scenario, source: object) -> Run:
    """Run `scenario`, and return the run with the journals of its recording in memory.

    It equals the run that `of_frames` reads from these journals. Messages in memory are not decoded, and the
    world is not computed a second time. `source` appears in errors.
    """
    sinks = {name: MemoryJournal() for name in journals(scenario)}
    messages = EncodedMessages()
    run = played(scenario, sinks, encode=messages.encode)
    frames = sinks.pop(WORLD_JOURNAL).frames
    read = of_frames({name: sinks[name].frames for name in sorted(sinks)}, source, messages)
    world = JournalFile(frames, messages=[messages[frame] for frame in frames])
    return msgspec.structs.replace(
        run,
        agents={robot: read.agents[robot] for robot in run.robots},
        journals={WORLD_JOURNAL: world, **read.journals},
        source=source,
    )


def played(
    scenario: Scenario,
    sinks: Mapping[str, Sink],
    planner_of: Callable[[RobotConfig], Planner[Any, Any]] = planner_of,
    encode: Callable[[msgspec.Struct], bytes] = encode,
) -> Run:
    """Run `scenario`, and write its journals to `sinks`, by file name; without sinks, write none.

    `planner_of` returns the planner of a robot, and `encode` the frame of a message.
    """
    _keep_freed_memory()
    ids = [robot.id for robot in scenario.robots]
    simulation = Simulation(scenario, sinks.get(WORLD_JOURNAL), encode)
    configs = {robot: scenario.config(robot) for robot in ids}
    robots = {
        robot: Robot(config, planner_of(config), sinks.get(agent_journal(robot)), encode)
        for robot, config in configs.items()
    }
    ticks: list[Tick] = []
    end: MissionEnd | None = None
    claims: dict[str, Estimate] = {}
    sent: dict[tuple[str, int], dict[str, FramedReport]] = {}
    while end is None:
        observations = simulation.observations()
        for observation in observations:
            reports = robots[observation.robot].observation(observation)
            if reports:
                sent[observation.robot, observation.tick] = reports
        commands: dict[str, Command] = {}
        for observation in observations:
            agent, received = robots[observation.robot], []
            for contact in observation.contacts:
                received += [sent[contact.peer, tick][observation.robot] for tick in contact.heard or ()]
            commands[observation.robot] = agent.decide(received)
            if sinks:
                agent.estimate()
            _keep_claim(claims, agent, commands[observation.robot])
        if sent:
            for robot in ids:  # it can no longer be received
                sent.pop((robot, simulation.tick - LATEST), None)
        ticks.append(Tick(simulation.world, commands))
        end = simulation.command(commands)
    final_reports: dict[str, FinalReport] = {robot: robots[robot].final_report(end) for robot in ids}
    simulation.journal_final_reports(final_reports.values())
    history = WorldHistory(environment.of_world(), scenario, tuple(ticks), None, end, end, final_reports)
    return Run(history, claim_estimates=claims)


def _keep_claim(claims: dict[str, Estimate], agent: Robot, command: Command) -> None:
    """Keep in `claims` the estimate of a robot with noisy sensors in the tick of its claim.

    In a group, it may withdraw the claim.
    """
    verdict, robot = command.verdict, command.robot
    if verdict is None:
        claims.pop(robot, None)
    elif isinstance(verdict, Localised) and verdict.covariance is not None and robot not in claims:
        claims[robot] = agent.planner.estimate(agent.state)


@cache
def _keep_freed_memory() -> None:
    """Let the C library keep the memory of freed arrays for the next mission, in this process.

    By default glibc returns it to the kernel above 128 KiB, and the arrays of each last manoeuvre are mapped
    again: 60 page faults, about a tenth of a mission. Once a mapped block has been freed, that limit is twice
    its size (mallopt(3), M_MMAP_THRESHOLD). The block itself is never touched, so it takes no memory.
    """
    bytes(MAPPED_BYTES)
