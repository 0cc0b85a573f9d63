"""The audit of a recording by all rules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from compose.audit import hardware_rules
from compose.audit.agent_rules import decision, limits, log
from compose.audit.claim_rules import claim
from compose.audit.delivery_rules import contact, observation, report
from compose.audit.evidence import Evidence, evidence_of, other_versions
from compose.audit.fault_rules import faults, link_statistics
from compose.audit.findings import Checks, Findings, findings_of
from compose.audit.hardware_rules import Alone, audit_hardware_run
from compose.audit.journal_rules import config, order
from compose.audit.scenario_rules import scenario
from compose.recording.run import WORLD_JOURNAL, read_journals
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
"""The rules of the audit, in order: if violations of one cause violations of another, it comes first."""


def audit(folder: Path) -> Findings:
    """Audit the recording in `folder`, with or without a world's journal, and return the findings.

    Raises OSError if there is no recording. Raises CorruptJournal if a frame cannot be decoded, if it is in
    the journal of another robot, or if two peers' journals are of different runs.
    """
    return audit_journals({name: book.frames for name, book in read_journals(folder).items()}, folder)


def audit_journals(
    journals: Mapping[str, Iterable[bytes]],
    folder: object,
    rules: Sequence[Callable[[Evidence], Checks]] = RULES,
    rules_without_world: Sequence[Callable[[Alone], Checks]] = hardware_rules.RULES,
) -> Findings:
    """Return the findings in the frames of `journals`, by file name; errors name `folder`.

    The rules are `rules`, or `rules_without_world` if there is no world's journal. Raises CorruptJournal like
    `audit`.
    """
    if WORLD_JOURNAL in journals:
        return audit_world_run(journals, folder, rules)
    return audit_hardware_run(journals, folder, rules_without_world)


def audit_world_run(
    journals: Mapping[str, Iterable[bytes]],
    folder: object = "the recording",
    rules: Sequence[Callable[[Evidence], Checks]] = RULES,
) -> Findings:
    """Return the findings of `rules` in the frames of `journals`, one of which is the world's.

    Errors name `folder`. Raises CorruptJournal like `audit`.
    """
    evidence = evidence_of(journals, folder)
    run = evidence.history
    return findings_of(
        rules,
        evidence,
        otherwise(run.environment, of_world()) or other_versions(evidence.pasts),
        scenario=run.scenario.name,
        ticks=run.ticks[-1].world.truth.tick if run.ticks else 0,
        links=link_statistics(evidence),
    )
