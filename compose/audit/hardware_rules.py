"""A record without a world: what robots with drivers of their own have left, judged by what it tells itself.

Nobody knows where they were; but what each decided must follow from what came in, and what it heard must be
what its peer sent, where that is on record, too.
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
    """The robots' journals, and nothing else."""

    testimonies: dict[str, AgentLog]

    @property
    def pasts(self) -> dict[str, Past]:
        """Of the robots that tell one."""
        return {robot: one.past for robot, one in self.testimonies.items() if one.past is not None}


def order(alone: Alone) -> Checks:
    """Every journal is whole and in its order."""
    for robot, testimony in alone.testimonies.items():
        yield broken_off(robot, testimony)
        if testimony.past is None:
            continue
        for step in testimony.past.steps:
            yield whole(robot, testimony.past, step, excused=True)


RULES: tuple[Callable[[Alone], Checks], ...] = (order, config, report, decision, limits, log)
"""each by its name; where one violation follows from another, it comes later"""


def judge_alone(
    journals: Mapping[str, Iterable[bytes]],
    folder: object,
    rules: Sequence[Callable[[Alone], Checks]] = RULES,
) -> Findings:
    """What there is to find in the frames of `journals`, by name; `folder` is where errors say they are.

    Raises CorruptJournal, whose text names the journal.
    """
    testimonies: dict[str, AgentLog] = {}
    for name, frames in journals.items():
        testimony = testimony_of(list(frames), f"{folder}/{name}")
        robot = name.removeprefix("agent-").removesuffix(".journal")
        if testimony.past is not None and testimony.past.config.robot != robot:
            raise CorruptJournal(f"{folder}/{name} is the journal of {testimony.past.config.robot}")
        testimonies[robot] = testimony
    alone = Alone(testimonies)
    agree({robot: past.config for robot, past in alone.pasts.items()}, folder)
    return findings_of(
        rules,
        alone,
        other_versions(alone.pasts),
        scenario=f"{' and '.join(testimonies)}, without a world",
        ticks=max([len(past.steps) for past in alone.pasts.values()], default=0),
    )
