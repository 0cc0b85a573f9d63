"""The audit of a record: every rule held against it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from compose.audit import hardware_rules
from compose.audit.agent_rules import decision, limits, log
from compose.audit.claim_rules import claim
from compose.audit.delivery_rules import contact, observation, report
from compose.audit.evidence import Evidence, case_of, other_versions
from compose.audit.fault_rules import befallen, faults
from compose.audit.findings import Checks, Findings, findings_of
from compose.audit.hardware_rules import Alone, judge_alone
from compose.audit.journal_rules import config, order
from compose.audit.scenario_rules import scenario
from compose.recording.run import WORLD_JOURNAL, books
from protocol.journal.environment import of_world, otherwise

RULES: tuple[Callable[[Evidence], Checks], ...] = (
    order,
    scenario,
    config,
    observation,
    faults,
    contact,
    report,
    decision,
    limits,
    log,
    claim,
)
"""each by its name; where one violation follows from another, it comes later"""


def audit(folder: Path) -> Findings:
    """What there is to find in the record in `folder`; without a world, in what its robots have left.

    Raises OSError if there is none, journal.CorruptJournal if a frame in it cannot be understood, or stands
    in the journal of another robot, or of another run than its peer's.
    """
    return judged({name: book.frames for name, book in books(folder).items()}, folder)


def judged(
    journals: Mapping[str, Iterable[bytes]],
    folder: object,
    rules: Sequence[Callable[[Evidence], Checks]] = RULES,
    without: Sequence[Callable[[Alone], Checks]] = hardware_rules.RULES,
) -> Findings:
    """What there is to find by `rules`, or `without` a world, in the frames of `journals`, by name.

    `folder` is where errors say they are. Raises journal.CorruptJournal like `audit`.
    """
    if WORLD_JOURNAL in journals:
        return judge(journals, folder, rules)
    return judge_alone(journals, folder, without)


def judge(
    journals: Mapping[str, Iterable[bytes]],
    folder: object = "the record",
    rules: Sequence[Callable[[Evidence], Checks]] = RULES,
) -> Findings:
    """What there is to find in the frames of `journals`, by name; `folder` is where errors say they are.

    Raises journal.CorruptJournal like `audit`.
    """
    case = case_of(journals, folder)
    told = case.history
    return findings_of(
        rules,
        case,
        otherwise(told.environment, of_world()) or other_versions(case.pasts),
        scenario=told.scenario.name,
        ticks=len(told.ticks),
        links=befallen(case),
    )
