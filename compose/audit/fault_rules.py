"""What befell the reports on their way: whether it is what the fault plan says, and how much it was."""

from __future__ import annotations

from agent.process.agent_journal import Past
from compose.audit.evidence import Evidence
from compose.audit.findings import Checks, LinkStatistics, Violation, said


def faults(case: Evidence) -> Checks:
    """What each Observation lists as heard, and as damaged, is what the fault plan does to the reports sent."""
    if not case.history.scenario.faults:
        return
    for robot, past in case.pasts.items():
        for step in past.steps[: len(case.observations)]:
            expected = case.contact(robot, step.observation.tick)
            if expected is None:
                continue
            for found in step.observation.contacts:
                listed, planned = (found.heard, found.damaged), (expected.heard, expected.damaged)
                if listed == planned:
                    yield None
                else:
                    what = f"heard and damaged are {said(listed)}, expected {said(planned)}"
                    yield Violation("faults", step.observation.tick, robot, what)


def befallen(case: Evidence) -> tuple[LinkStatistics, ...]:
    """Of every link of the scenario's pairs whose receiver is on record; nothing without a fault plan."""
    if not case.history.scenario.faults:
        return ()
    return tuple([_befallen(past) for past in case.pasts.values()])


def _befallen(past: Past) -> LinkStatistics:
    """Of the link to this robot."""
    contacts = [
        (step.observation.tick, contact) for step in past.steps for contact in step.observation.contacts
    ]
    heard = [(now, tick) for now, contact in contacts for tick in contact.heard or ()]
    damaged = [tick for _, contact in contacts for tick in contact.damaged]
    ticks = [tick for _, tick in heard]
    return LinkStatistics(
        link=f"{past.config.peer}->{past.config.robot}",
        sent=len(contacts),
        heard=len(heard),
        late=sum([tick < now for now, tick in heard]),
        twice=len(ticks) - len(set(ticks)),
        damaged=len(damaged),
        lost=len({now for now, _ in contacts} - {*ticks, *damaged}),
    )
