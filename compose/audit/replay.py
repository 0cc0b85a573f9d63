"""A run once more, on what its journals say came in; and whether everything follows as it is on record.

The world is moved by the Commands on record, and senses anew; every robot's planner is run on the Observations and
Reports that came to its process. This is the judge's own doing: of his rules those that recompute something.
Where there was no world, the robots' journals are held against themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import msgspec

from compose.audit.agent_rules import decision
from compose.audit.claim_rules import outcome
from compose.audit.delivery_rules import contact, observation, report
from compose.audit.evidence import Evidence
from compose.audit.findings import Checks, Violation
from compose.audit.hardware_rules import Alone
from compose.audit.hardware_rules import order as order_alone
from compose.audit.journal_rules import config, order
from compose.audit.rules import judged
from compose.recording.run import books

RULES: tuple[Callable[[Evidence], Checks], ...] = (
    config,
    observation,
    contact,
    report,
    decision,
    order,
    outcome,
)
"""in the order of a tick: what differs first has caused what differs later"""
ALONE: tuple[Callable[[Alone], Checks], ...] = (report, decision, order_alone)
"""the same without a world"""


class Replay(msgspec.Struct, frozen=True):
    """What came of it."""

    scenario: str
    ticks: int
    checks: int
    """messages that were held against what follows"""
    differences: tuple[Violation, ...]
    """the first of them first"""
    tears: tuple[Violation, ...]
    """where journals break off"""
    rounding: int = 0
    """messages that differ by rounding alone, in a recording that was made with other versions"""
    versions: str | None = None
    """in what they are others than here"""


def replay(folder: Path) -> tuple[Replay, dict[str, int]]:
    """Of the record in `folder`; and of each of its journals how many bytes of a torn write it ends with.

    Raises OSError if there is none, journal.CorruptJournal if a frame in it cannot be understood, or stands
    in the journal of another robot.
    """
    found = books(folder)
    told = replayed({name: book.frames for name, book in found.items()}, folder)
    return told, {name: book.torn for name, book in found.items()}


def replayed(journals: Mapping[str, Iterable[bytes]], folder: object = "the record") -> Replay:
    """Of the frames of `journals`, by name; `folder` is where errors say they are.

    Raises journal.CorruptJournal like `replay`.
    """
    findings = judged(journals, folder, RULES, ALONE)
    return Replay(
        findings.scenario,
        findings.ticks,
        sum([count.checks for count in findings.counts]),
        tuple([one for one in findings.violations if not one.breaks_off]),
        tuple([one for one in findings.violations if one.breaks_off]),
        len(findings.rounding),
        findings.versions,
    )
