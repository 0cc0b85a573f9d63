"""Whether what came to a robot is what was sent to it: by the world's sensors, and by its peer."""

from __future__ import annotations

import math
from collections.abc import Sequence

from agent.process.agent_journal import Past, Step
from agent.process.robot import FramedReport
from compose.audit.evidence import Evidence, Testified
from compose.audit.findings import Checks, Violation, between, difference, said
from protocol.wire import encode


def observation(case: Evidence) -> Checks:
    """Every Observation is, to the bit, what the sensors say where the Commands on record have led everyone."""
    for robot, past in case.pasts.items():
        for step in past.steps[: len(case.observations)]:
            expected = case.observations[step.observation.tick][robot]
            if step.frame == encode(expected):
                yield None
            else:
                what = difference(step.observation, expected)
                yield Violation(
                    "observation", step.observation.tick, robot, what, between(step.observation, expected)
                )


def contact(case: Evidence) -> Checks:
    """Nothing was sent or heard but in contact, and what was heard is what the Observation listed."""
    for robot, past in case.pasts.items():
        for step in past.steps:
            if step.report is not None and step.observation.tick < len(case.observations):
                yield _sent(case, robot, step)
            if step.command is not None:
                yield _listed(robot, step)
            for told in step.heard:
                yield _heard(case, robot, step, told)


def _sent(case: Evidence, robot: str, step: Step) -> Violation | None:
    if case.contact(robot, step.observation.tick) is not None:
        return None
    return Violation(
        "contact", step.observation.tick, robot, "it sent a report, expected none: out of contact"
    )


def _listed(robot: str, step: Step) -> Violation | None:
    listed = [tick for contact in step.observation.contacts for tick in contact.heard or ()]
    heard = [told.report.tick for told in step.heard]
    if len(heard) + len(step.missed) == len(listed) and _in_order(heard, listed):
        return None
    without = f" and went without {len(step.missed)}" if step.missed else ""
    what = f"it heard the reports of ticks {said(heard)}{without}, expected {said(listed)}"
    return Violation("contact", step.observation.tick, robot, what)


def _in_order(some: Sequence[int], of: Sequence[int]) -> bool:
    """Whether `some` is what is left of `of` without a few."""
    rest = iter(of)
    return all(one in rest for one in some)


def _heard(case: Evidence, robot: str, step: Step, told: FramedReport) -> Violation | None:
    now, then = step.observation.tick, told.report.tick
    if max(now, then) >= len(case.observations):
        return None  # where they were, nobody knows
    for tick in (now, then):
        if case.contact(robot, tick) is None:
            what = f"it heard the report of tick {then}, expected none: out of contact at tick {tick}"
            return Violation("contact", now, robot, what)
    return None


def report(case: Testified) -> Checks:
    """Every report that was heard is, to the byte, what the peer has on record as sent."""
    for robot, past in case.pasts.items():
        peer = case.pasts.get(past.config.peer)
        if peer is None:
            continue
        for step in past.steps:
            for told in step.heard:
                if told.report.tick < _on_record(peer):
                    yield _as_sent(robot, step, told, peer)


def _on_record(peer: Past) -> float:
    """Of the ticks before this, the peer's journal holds every report that it sent."""
    if peer.final_report is not None:
        return math.inf
    cut = peer.steps and peer.steps[-1].command is None and peer.steps[-1].report is None
    return len(peer.steps) - 1 if cut else len(peer.steps)


def _as_sent(robot: str, step: Step, told: FramedReport, peer: Past) -> Violation | None:
    tick, steps = step.observation.tick, peer.steps
    sent = steps[told.report.tick].report if told.report.tick < len(steps) else None
    if sent is None:
        what = f"it heard a report of tick {told.report.tick}, which {peer.config.robot} never sent"
        return Violation("report", tick, robot, what)
    if told.frame == sent.frame:
        return None
    what = f"in the report of tick {told.report.tick}, {difference(told.report, sent.report)}"
    return Violation("report", tick, robot, what, between(told.report, sent.report))
