"""Audit rules for the journals: complete, in order, consistent with each other and with the scenario."""

from __future__ import annotations

from agent.process.agent_journal import Past, Step
from compose.audit.findings import Checks, Violation, between, difference
from compose.recording.recording_files import agent_journal
from compose.recording.run import Run
from protocol.messages import MissionEnd
from protocol.wire import encode
from world.world_journal import History


def order(run: Run) -> Checks:
    """Check that each journal is complete and in order, and that journals agree on messages they share.

    A journal that ends early, or has a frame out of order, is one violation. Its earlier content is checked.
    """
    forced = run.forced
    if run.world is not None:
        yield _world_journal(run.world)
    for robot in run.robots:
        yield _agent_journal(run, robot, forced=forced)
        past = run.pasts.get(robot)
        if past is None:
            continue
        for step in past.steps:
            yield _whole(robot, past, step, excused=forced)
            if run.world is not None:
                yield _same_command(run, robot, past, step)
        if run.world is not None and past.end is not None and run.end is not None:
            yield _same_end(past.end, robot, run.end)
            yield _same_final_report(run, robot, past)


def _world_journal(world: History) -> Violation | None:
    if world.disorder is not None:
        return Violation("order", world.disorder.tick, None, world.disorder.what)
    if world.end is None:
        last = world.ticks[-1].truth.tick if world.ticks else None
        what = "its journal breaks off here, expected a MissionEnd"
        return Violation("order", last, None, what, breaks_off=True)
    return None


def _agent_journal(run: Run, robot: str, *, forced: bool) -> Violation | None:
    """Return a violation if the robot's journal is missing, has a frame out of order, or ends early."""
    past = run.pasts.get(robot)
    if agent_journal(robot) not in run.journals:
        return Violation("order", None, robot, "its journal is missing", breaks_off=True)
    if past is not None and past.disorder is not None:
        return Violation("order", past.disorder.tick, robot, past.disorder.what)
    if past is None or past.final_report is None:
        last = past.steps[-1].observation.tick if past is not None and past.steps else None
        what = "its journal breaks off here, expected MissionEnd and FinalReport"
        return Violation("order", last, robot, what, breaks_off=True)
    if run.end is not None and len(past.steps) != run.end.tick + 1 and not forced:
        what = f"its journal has {len(past.steps)} ticks, expected {run.end.tick + 1}"
        return Violation("order", run.end.tick, robot, what)
    return None


def _whole(robot: str, past: Past, step: Step, *, excused: bool) -> Violation | None:
    """Return a violation if the robot did not answer the Observation of `step`.

    The last Observation needs no answer if the journal ends there, or if `excused`: it may be late.
    """
    tick, last = step.observation.tick, step is past.steps[-1]
    if last and (past.end is None or (excused and step.command is None)):
        return None
    if step.command is None:
        return Violation("order", tick, robot, "no Command follows its Observation")
    if step.estimate is None:
        return Violation("order", tick, robot, "no Estimate follows its Command")
    if step.missed and past.config.tick_s is None:
        return Violation(
            "order", tick, robot, "it continued without a report, expected it to wait in lockstep"
        )
    return None


def _same_command(run: Run, robot: str, past: Past, step: Step) -> Violation | None:
    """Return a violation if the world's journal does not contain the robot's Command."""
    tick = step.observation.tick
    if tick >= run.length:
        return None
    received, sent = run.command(robot, tick), step.command
    if received is None and past.config.tick_s is None:
        return Violation("order", tick, robot, "the world continued without its Command, expected it to wait")
    if received is None or (sent is None and past.end is None):
        return None
    if sent is None:
        return Violation("order", tick, robot, "the world has a Command from it, expected none: it sent none")
    if encode(received) == step.command_frame or encode(received) == encode(sent):
        return None
    what = f"the world's Command from it: {difference(received, sent)}"
    return Violation("order", tick, robot, what, between(received, sent))


def _same_end(received: MissionEnd, robot: str, sent: MissionEnd) -> Violation | None:
    """Return a violation if the robot `received` another MissionEnd than the one in the world's journal."""
    if encode(received) == encode(sent):
        return None
    what = f"the MissionEnd that it received: {difference(received, sent)}"
    return Violation("order", received.tick, robot, what, between(received, sent))


def _same_final_report(run: Run, robot: str, past: Past) -> Violation | None:
    """Return a violation if the world's journal does not contain the robot's FinalReport."""
    assert past.end is not None
    sent, received = past.final_report, run.final_reports.get(robot)
    if sent is None:
        return None
    if received is None:
        return Violation(
            "order", past.end.tick, robot, "the world has no FinalReport from it", breaks_off=True
        )
    if encode(received) == encode(sent):
        return None
    what = f"the world's FinalReport from it: {difference(received, sent)}"
    return Violation("order", past.end.tick, robot, what, between(received, sent))


def config(run: Run) -> Checks:
    """Check that each RobotConfig follows from the scenario, with the same tick duration for all robots."""
    tick_s = next((past.config.tick_s for past in run.pasts.values()), None)
    for robot, past in run.pasts.items():
        expected = run.scenario.config(robot, tick_s)
        if encode(past.config) == encode(expected):
            yield None
        else:
            what = difference(past.config, expected)
            yield Violation("config", None, robot, what, between(past.config, expected))
