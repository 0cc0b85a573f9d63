"""The audit of a recording of hardware mode, which contains agents' journals only, and no ground truth.

The rules check that each robot's decisions follow from its inputs. If both journals of a pair are there, they
also check that each robot received what its peer sent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import msgspec

from agent.process.agent_journal import Past
from compose.audit.agent_rules import decision, limits, log
from compose.audit.delivery_rules import report
from compose.audit.evidence import AgentLog, other_versions, testimony_of
from compose.audit.findings import Checks, Findings, findings_of
from compose.audit.journal_rules import broken_off, whole
from compose.audit.scenario_rules import config
from compose.recording.robots import agree
from protocol.journal.journal_file import CorruptJournal


class Alone(msgspec.Struct, frozen=True):
    """The evidence of a run in hardware mode: the agents' journals."""

    testimonies: dict[str, AgentLog]

    @property
    def pasts(self) -> dict[str, Past]:
        """The content of each agent's journal, by robot; robots without a RobotConfig are omitted."""
        return {robot: one.past for robot, one in self.testimonies.items() if one.past is not None}


def order(evidence: Alone) -> Checks:
    """Check that each journal is complete and in order."""
    for robot, agent_log in evidence.testimonies.items():
        yield broken_off(robot, agent_log)
        if agent_log.past is None:
            continue
        for step in agent_log.past.steps:
            yield whole(robot, agent_log.past, step, excused=True)


RULES: tuple[Callable[[Alone], Checks], ...] = (order, config, report, decision, limits, log)
"""The rules of the audit of hardware mode; a rule whose violations follow from another's comes after it."""


def audit_hardware_run(
    journals: Mapping[str, Iterable[bytes]],
    folder: object,
    rules: Sequence[Callable[[Alone], Checks]] = RULES,
) -> Findings:
    """Return the findings of `rules` in the frames of `journals`, by file name; errors name `folder`.

    Raises CorruptJournal, whose text names the journal.
    """
    testimonies: dict[str, AgentLog] = {}
    for name, frames in journals.items():
        agent_log = testimony_of(list(frames), f"{folder}/{name}")
        robot = name.removeprefix("agent-").removesuffix(".journal")
        if agent_log.past is not None and agent_log.past.config.robot != robot:
            raise CorruptJournal(f"{folder}/{name} is the journal of {agent_log.past.config.robot}")
        testimonies[robot] = agent_log
    evidence = Alone(testimonies)
    agree({robot: past.config for robot, past in evidence.pasts.items()}, folder)
    return findings_of(
        rules,
        evidence,
        other_versions(evidence.pasts),
        scenario=f"{' and '.join(testimonies)}, hardware mode",
        ticks=max([0, *[past.steps[-1].observation.tick for past in evidence.pasts.values() if past.steps]]),
    )
