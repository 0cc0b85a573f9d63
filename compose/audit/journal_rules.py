"""Audit rules for the journals: complete, in order, consistent with each other and with the scenario."""

from __future__ import annotations

from agent.process.agent_journal import Past, Step
from compose.audit.evidence import AgentLog, Evidence
from compose.audit.findings import Checks, Violation, between, difference
from protocol.wire import encode


def order(evidence: Evidence) -> Checks:
    """Check that each journal is complete and in order, and that journals agree on messages they share.

    A journal that ends early, or has a frame out of order, is one violation. Its earlier content is checked.
    """
    yield _world_journal(evidence)
    for robot, agent_log in evidence.testimonies.items():
        yield _agent_journal(evidence, robot, agent_log)
        past = agent_log.past
        if past is None:
            continue
        for step in past.steps:
            yield whole(robot, past, step, excused=evidence.forced)
            yield _same_command(evidence, robot, past, step)
        if past.end is not None and evidence.history.end is not None:
            yield _same_end(evidence, robot, past)
            yield _same_final_report(evidence, robot, past)


def _world_journal(evidence: Evidence) -> Violation | None:
    run = evidence.history
    if run.disorder is not None:
        return Violation("order", run.disorder.tick, None, run.disorder.what)
    if run.end is None:
        last = run.ticks[-1].world.truth.tick if run.ticks else None
        what = "its journal breaks off here, expected a MissionEnd"
        return Violation("order", last, None, what, breaks_off=True)
    return None


def _agent_journal(evidence: Evidence, robot: str, agent_log: AgentLog) -> Violation | None:
    past, end = agent_log.past, evidence.history.end
    if agent_log.missing:
        return Violation("order", None, robot, "its journal is missing", breaks_off=True)
    off = broken_off(robot, agent_log)
    if past is None or off is not None:
        return off
    if end is not None and len(past.steps) != end.tick + 1 and not evidence.forced:
        return Violation(
            "order", end.tick, robot, f"its journal has {len(past.steps)} ticks, expected {end.tick + 1}"
        )
    return None


def broken_off(robot: str, agent_log: AgentLog) -> Violation | None:
    """Return a violation if the agent's journal has a frame out of order, or ends early."""
    past = agent_log.past
    if agent_log.disorder is not None:
        return Violation("order", agent_log.disorder_tick, robot, agent_log.disorder)
    if past is None or past.final_report is None:
        last = past.steps[-1].observation.tick if past is not None and past.steps else None
        what = "its journal breaks off here, expected MissionEnd and FinalReport"
        return Violation("order", last, robot, what, breaks_off=True)
    return None


def whole(robot: str, past: Past, step: Step, *, excused: bool) -> Violation | None:
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


def _same_command(evidence: Evidence, robot: str, past: Past, step: Step) -> Violation | None:
    """Return a violation if the world's journal does not contain the robot's Command."""
    tick = step.observation.tick
    if tick >= len(evidence.history.ticks):
        return None
    received, sent = evidence.command(robot, tick), step.command
    if received is None and past.config.tick_s is None:
        return Violation("order", tick, robot, "the world continued without its Command, expected it to wait")
    if received is None or (sent is None and past.end is None):
        return None
    if sent is None:
        return Violation("order", tick, robot, "the world has a Command from it, expected none: it sent none")
    if encode(received) == encode(sent):
        return None
    what = f"the world's Command from it: {difference(received, sent)}"
    return Violation("order", tick, robot, what, between(received, sent))


def _same_end(evidence: Evidence, robot: str, past: Past) -> Violation | None:
    """Return a violation if the robot received another MissionEnd than the one in the world's journal."""
    assert past.end is not None
    assert evidence.history.end is not None
    if encode(past.end) == encode(evidence.history.end):
        return None
    what = f"the MissionEnd that it received: {difference(past.end, evidence.history.end)}"
    return Violation("order", past.end.tick, robot, what, between(past.end, evidence.history.end))


def _same_final_report(evidence: Evidence, robot: str, past: Past) -> Violation | None:
    """Return a violation if the world's journal does not contain the robot's FinalReport."""
    assert past.end is not None
    sent, received = past.final_report, evidence.history.final_reports.get(robot)
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


def config(evidence: Evidence) -> Checks:
    """Check that each RobotConfig follows from the scenario, with the same tick duration for all robots."""
    tick_s = next((past.config.tick_s for past in evidence.pasts.values()), None)
    for robot, past in evidence.pasts.items():
        expected = evidence.history.scenario.config(robot, tick_s)
        if encode(past.config) == encode(expected):
            yield None
        else:
            what = difference(past.config, expected)
            yield Violation("config", None, robot, what, between(past.config, expected))
