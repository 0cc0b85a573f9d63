"""Audit rules for the journals: complete, in order, consistent with each other and with the scenario."""

from __future__ import annotations

from agent.process.agent_journal import AgentHistory, Step
from compose.audit.findings import Checks, Violation, unlike
from compose.recording.recording_files import agent_journal
from compose.recording.run import Run
from protocol.wire import encode
from world.world_journal import WorldHistory


def order(run: Run) -> Checks:
    """Check that each journal is complete and in order, and journals agree on messages they share.

    A journal that ends early, or has a frame out of order, is one violation. Its earlier content is checked.
    """
    forced = run.forced
    if run.world is not None:
        yield _world_journal(run.world)
    for robot in run.robots:
        yield _agent_journal(run, robot, forced=forced)
        agent = run.agents.get(robot)
        if agent is None:
            continue
        for step in agent.steps:
            yield _whole(robot, agent, step, excused=forced)
            if run.world is not None:
                yield _same_command(run, robot, agent, step)
        if run.world is not None and agent.end is not None and run.end is not None:
            same, where = encode(agent.end) == encode(run.end), "the MissionEnd that it received: "
            yield None if same else unlike("order", agent.end.tick, robot, agent.end, run.end, where)
            yield _same_final_report(run, robot, agent)


def _world_journal(world: WorldHistory) -> Violation | None:
    if world.unexpected is not None:
        return Violation("order", world.unexpected.tick, None, world.unexpected.what)
    if world.end is None:
        last = world.ticks[-1].truth.tick if world.ticks else None
        what = "its journal breaks off here, expected a MissionEnd"
        return Violation("order", last, None, what, breaks_off=True)
    return None


def _agent_journal(run: Run, robot: str, *, forced: bool) -> Violation | None:
    """Return a violation if the robot's journal is missing, has a frame out of order, or ends early."""
    agent = run.agents.get(robot)
    if agent_journal(robot) not in run.journals:
        return Violation("order", None, robot, "its journal is missing", breaks_off=True)
    if agent is not None and agent.unexpected is not None:
        return Violation("order", agent.unexpected.tick, robot, agent.unexpected.what)
    if agent is None or agent.final_report is None:
        last = agent.steps[-1].observation.tick if agent is not None and agent.steps else None
        what = "its journal breaks off here, expected MissionEnd and FinalReport"
        return Violation("order", last, robot, what, breaks_off=True)
    if run.end is not None and len(agent.steps) != run.end.tick + 1 and not forced:
        what = f"its journal has {len(agent.steps)} ticks, expected {run.end.tick + 1}"
        return Violation("order", run.end.tick, robot, what)
    return None


def _whole(robot: str, agent: AgentHistory, step: Step, *, excused: bool) -> Violation | None:
    """Return a violation if the robot did not answer the Observation of `step`.

    The last Observation needs no answer if the journal ends there, or if `excused`: it may be late.
    """
    tick, last = step.observation.tick, step is agent.steps[-1]
    if last and (agent.end is None or (excused and step.command is None)):
        return None
    if step.command is None:
        return Violation("order", tick, robot, "no Command follows its Observation")
    if step.estimate is None:
        return Violation("order", tick, robot, "no Estimate follows its Command")
    if step.missed and agent.config.tick_s is None:
        return Violation(
            "order", tick, robot, "it continued without a report, expected it to wait in lockstep"
        )
    return None


def _same_command(run: Run, robot: str, agent: AgentHistory, step: Step) -> Violation | None:
    """Return a violation if the world's journal does not contain the robot's Command."""
    tick = step.observation.tick
    if tick >= run.length:
        return None
    received, sent = run.command(robot, tick), step.command
    if received is None and agent.config.tick_s is None:
        return Violation("order", tick, robot, "the world continued without its Command, expected it to wait")
    if received is None or (sent is None and agent.end is None):
        return None
    if sent is None:
        return Violation("order", tick, robot, "the world has a Command from it, expected none: it sent none")
    if received is sent or encode(received) == step.command_frame or encode(received) == encode(sent):
        return None
    return unlike("order", tick, robot, received, sent, "the world's Command from it: ")


def _same_final_report(run: Run, robot: str, agent: AgentHistory) -> Violation | None:
    """Return a violation if the world's journal does not contain the robot's FinalReport."""
    assert agent.end is not None
    sent, received = agent.final_report, run.final_reports.get(robot)
    if sent is None:
        return None
    if received is None:
        return Violation(
            "order", agent.end.tick, robot, "the world has no FinalReport from it", breaks_off=True
        )
    if encode(received) == encode(sent):
        return None
    return unlike("order", agent.end.tick, robot, received, sent, "the world's FinalReport from it: ")


def config(run: Run) -> Checks:
    """Check that each RobotConfig follows from the scenario, with the same tick duration for all robots."""
    tick_s = next((agent.config.tick_s for agent in run.agents.values()), None)
    for robot, agent in run.agents.items():
        expected = run.scenario.config(robot, tick_s)
        same = encode(agent.config) == encode(expected)
        yield None if same else unlike("config", None, robot, agent.config, expected)
