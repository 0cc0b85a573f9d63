"""An audit rule that recomputes the effect of the fault plan on Reports, and statistics of each link."""

from __future__ import annotations

from agent.process.agent_journal import AgentHistory
from compose.audit.findings import Checks, LinkStatistics, Violation, quoted
from compose.recording.run import Run


def faults(run: Run) -> Checks:
    """Check that each Observation lists the received, damaged and lost Reports that follow from the world.

    These are what the radio model delivers, and the fault plan leaves of it.
    """
    if not run.scenario.faults and run.scenario.radio is None:
        return
    for robot, agent in run.agents.items():
        for step in agent.steps[: len(run.observations)]:
            tick, lost = step.observation.tick, step.observation.lost
            if lost != (planned_losses := run.observations[tick][robot].lost):
                what = f"lost are {quoted(lost)}, expected {quoted(planned_losses)}"
                yield Violation("faults", tick, robot, what)
            for found in step.observation.contacts:
                expected = run.contact(robot, tick, found.peer)
                if expected is None:
                    continue
                listed, planned = (found.heard, found.damaged), (expected.heard, expected.damaged)
                if listed == planned:
                    yield None
                else:
                    what = f"heard and damaged are {quoted(listed)}, expected {quoted(planned)}"
                    yield Violation("faults", tick, robot, what)


def link_statistics(run: Run) -> tuple[LinkStatistics, ...]:
    """Return the statistics of each link whose receiver has a journal; none if all reports are delivered."""
    if not run.scenario.faults and run.scenario.radio is None:
        return ()
    return tuple([_statistics(agent, peer) for agent in run.agents.values() for peer in _peers(agent)])


def _peers(agent: AgentHistory) -> list[str]:
    """Return the robots that the robot whose journal is `agent` met, and the one that it should have met."""
    contacts = [contact for step in agent.steps for contact in step.observation.contacts]
    return list(dict.fromkeys([agent.config.peer, *[contact.peer for contact in contacts]]))


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
