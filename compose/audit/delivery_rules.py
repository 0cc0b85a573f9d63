"""Audit rules for delivery: each robot received the world's Observations and its peer's Reports unchanged."""

from __future__ import annotations

import math
from collections.abc import Sequence

from agent.process.agent_journal import AgentHistory, FramedReport, Step
from compose.audit.findings import Checks, Violation, between, difference, quoted
from compose.recording.run import Run
from protocol.wire import encode


def observation(run: Run) -> Checks:
    """Check that the sensor models give each Observation, to the bit, from the journaled Commands."""
    for robot, agent in run.agents.items():
        for step in agent.steps[: len(run.observations)]:
            expected = run.observations[step.observation.tick][robot]
            if step.frame == encode(expected):
                yield None
            else:
                what = difference(step.observation, expected)
                yield Violation(
                    "observation", step.observation.tick, robot, what, between(step.observation, expected)
                )


def contact(run: Run) -> Checks:
    """Check that Reports were sent and received only in contact, and that those received are listed."""
    for robot, agent in run.agents.items():
        for step in agent.steps:
            if step.report is not None and step.observation.tick < len(run.observations):
                yield _sent(run, robot, step)
            if step.command is not None:
                yield _listed(robot, step)
            for framed in step.received:
                yield _received(run, robot, step, framed)


def _sent(run: Run, robot: str, step: Step) -> Violation | None:
    if run.contact(robot, step.observation.tick) is not None:
        return None
    return Violation(
        "contact", step.observation.tick, robot, "it sent a report, expected none: out of contact"
    )


def _listed(robot: str, step: Step) -> Violation | None:
    if not (step.observation.contacts or step.received or step.missed):
        return None
    listed = [tick for contact in step.observation.contacts for tick in contact.heard or ()]
    received = [framed.report.tick for framed in step.received]
    if len(received) + len(step.missed) == len(listed) and _is_subsequence(received, listed):
        return None
    missed = f" and missed {len(step.missed)}" if step.missed else ""
    what = f"it received the reports of ticks {quoted(received)}{missed}, expected {quoted(listed)}"
    return Violation("contact", step.observation.tick, robot, what)


def _is_subsequence(some: Sequence[int], of: Sequence[int]) -> bool:
    """Return whether `some` is `of` without some of its elements, in the same order."""
    rest = iter(of)
    return all(one in rest for one in some)


def _received(run: Run, robot: str, step: Step, framed: FramedReport) -> Violation | None:
    now, then = step.observation.tick, framed.report.tick
    if max(now, then) >= len(run.observations):
        return None  # the ground truth of these ticks is not in the recording
    for tick in (now, then):
        if run.contact(robot, tick) is None:
            what = f"it received the report of tick {then}, expected none: out of contact at tick {tick}"
            return Violation("contact", now, robot, what)
    return None


def report(run: Run) -> Checks:
    """Check that each received Report is, to the byte, the one in the peer's journal."""
    for robot, agent in run.agents.items():
        peer = run.agents.get(agent.config.peer)
        if peer is None:
            continue
        for step in agent.steps:
            for framed in step.received:
                if framed.report.tick < _complete_until(peer):
                    yield _as_sent(robot, step, framed, peer)


def _complete_until(peer: AgentHistory) -> float:
    """Return the tick before which the peer's journal contains every Report that it sent."""
    if peer.final_report is not None:
        return math.inf
    cut = peer.steps and peer.steps[-1].command is None and peer.steps[-1].report is None
    return len(peer.steps) - 1 if cut else len(peer.steps)


def _as_sent(robot: str, step: Step, framed: FramedReport, peer: AgentHistory) -> Violation | None:
    tick, steps = step.observation.tick, peer.steps
    sent = steps[framed.report.tick].report if framed.report.tick < len(steps) else None
    if sent is None:
        what = f"it received a report of tick {framed.report.tick}, which {peer.config.robot} never sent"
        return Violation("report", tick, robot, what)
    if framed.frame == sent.frame:
        return None
    what = f"in the report of tick {framed.report.tick}, {difference(framed.report, sent.report)}"
    return Violation("report", tick, robot, what, between(framed.report, sent.report))
