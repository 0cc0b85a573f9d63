"""Audit rules for delivery: each robot received the world's Observations and its peer's Reports unchanged."""

from __future__ import annotations

import math
from collections.abc import Sequence

from agent.process.agent_journal import AgentHistory, FramedReport, Step
from compose.audit.findings import Checks, LinkStatistics, Violation, quoted, unlike
from compose.recording.run import Run
from protocol.wire import encode


def observation(run: Run) -> Checks:
    """Check that the world gives each Observation, to the bit, from the journaled Commands.

    It lists the Reports that are received, damaged and lost by the radio model and the fault plan.
    """
    for robot, agent in run.agents.items():
        for step in agent.steps[: len(run.observations)]:
            found, expected = step.observation, run.observations[step.observation.tick][robot]
            same = step.frame == encode(expected)
            yield None if same else unlike("observation", found.tick, robot, found, expected)


def contact(run: Run) -> Checks:
    """Check that Reports were sent only in contact, and those received are listed."""
    for robot, agent in run.agents.items():
        for step in agent.steps:
            if step.reports and step.observation.tick < len(run.observations):
                yield _sent(run, robot, step)
            if step.command is not None:
                yield _listed(robot, step)


def _sent(run: Run, robot: str, step: Step) -> Violation | None:
    tick, sent = step.observation.tick, len(step.reports)
    partners = len(run.observations[tick][robot].contacts)
    if sent <= partners:
        return None
    what = "a report, expected none" if sent == 1 else f"{sent} reports, expected {partners}"
    return Violation("contact", tick, robot, f"it sent {what}: out of contact")


def _listed(robot: str, step: Step) -> Violation | None:
    if not (step.observation.contacts or step.received or step.missed):
        return None
    contacts = step.observation.contacts
    listed = [(contact.peer, tick) for contact in contacts for tick in contact.heard or ()]
    received = [(framed.report.robot, framed.report.tick) for framed in step.received]
    if len(received) + len(step.missed) == len(listed) and _is_subsequence(received, listed):
        return None
    missed = f" and missed {len(step.missed)}" if step.missed else ""
    found, expected = [[tick for _, tick in reports] for reports in (received, listed)]
    what = f"it received the reports of ticks {quoted(found)}{missed}, expected {quoted(expected)}"
    return Violation("contact", step.observation.tick, robot, what)


def _is_subsequence(some: Sequence[object], of: Sequence[object]) -> bool:
    """Return whether `some` is `of` without some of its elements, in the same order."""
    rest = iter(of)
    return all(one in rest for one in some)


def report(run: Run) -> Checks:
    """Check that each received Report is, to the byte, the one in its sender's journal."""
    for robot, agent in run.agents.items():
        for step in agent.steps:
            for framed in step.received:
                sender = run.agents.get(framed.report.robot)
                if sender is not None and framed.report.tick < _complete_until(sender):
                    yield _as_sent(robot, step, framed, sender)


def _complete_until(peer: AgentHistory) -> float:
    """Return the tick before which the peer's journal contains every Report that it sent."""
    if peer.final_report is not None:
        return math.inf
    cut = peer.steps and peer.steps[-1].command is None and not peer.steps[-1].reports
    return len(peer.steps) - 1 if cut else len(peer.steps)


def _as_sent(robot: str, step: Step, framed: FramedReport, peer: AgentHistory) -> Violation | None:
    tick, steps = step.observation.tick, peer.steps
    sent = steps[framed.report.tick].sent_to(robot) if framed.report.tick < len(steps) else None
    if sent is None:
        what = f"it received a report of tick {framed.report.tick}, which {peer.config.robot} never sent"
        return Violation("report", tick, robot, what)
    if framed.frame == sent.frame:
        return None
    where = f"in the report of tick {framed.report.tick}, "
    return unlike("report", tick, robot, framed.report, sent.report, where)


def link_statistics(run: Run) -> tuple[LinkStatistics, ...]:
    """Return the statistics of each link whose receiver has a journal; none if all reports are delivered."""
    if not run.scenario.faults and run.scenario.radio is None:
        return ()
    return tuple([_statistics(agent, peer) for agent in run.agents.values() for peer in _peers(agent)])


def _peers(agent: AgentHistory) -> list[str]:
    """Return the robots that the robot whose journal is `agent` met, and the one that it should have met."""
    contacts = [contact for step in agent.steps for contact in step.observation.contacts]
    due = [agent.config.peer] if agent.config.team is None else []
    return list(dict.fromkeys([*due, *[contact.peer for contact in contacts]]))


def _statistics(agent: AgentHistory, peer: str) -> LinkStatistics:
    """Return the statistics of the link from `peer` to the robot whose journal is `agent`."""
    contacts = [
        (step.observation.tick, contact)
        for step in agent.steps
        for contact in step.observation.contacts
        if contact.peer == peer
    ]
    received = [(now, tick) for now, contact in contacts for tick in contact.heard or ()]
    damaged = [tick for _, contact in contacts for tick in contact.damaged]
    ticks = [tick for _, tick in received]
    return LinkStatistics(
        link=f"{peer}->{agent.config.robot}",
        sent=len(contacts),
        heard=len(received),
        late=sum([tick < now for now, tick in received]),
        twice=len(ticks) - len(set(ticks)),
        damaged=len(damaged),
        lost=sum([one.sender == peer for step in agent.steps for one in step.observation.lost]),
    )
