"""The replay of a recording: the run is computed again from the journaled inputs, and compared to the bit.

The world moves by the journaled Commands and computes new Observations. Each robot's planner runs on the
Observations and Reports that its process received. A replay applies those audit rules that recompute
something. In hardware mode, only the agents' journals are replayed.
"""

from __future__ import annotations

import msgspec

from compose.audit.agent_rules import decision
from compose.audit.claim_rules import outcome
from compose.audit.delivery_rules import contact, observation, report
from compose.audit.findings import Violation
from compose.audit.journal_rules import config, order
from compose.audit.rules import Rules, audit_run
from compose.recording.run import Run

REPLAY_RULES: Rules = (config, observation, contact, report, decision, order, outcome)
"""The rules of a replay, in the order of a tick: the first difference is the cause of later ones."""
HARDWARE_REPLAY_RULES: Rules = (report, decision, order)
"""The rules of a replay in hardware mode."""


class Replay(msgspec.Struct, frozen=True):
    """The result of a replay."""

    scenario: str
    ticks: int
    """Number of elapsed ticks, as in `Findings`."""
    checks: int
    """Number of compared messages."""
    differences: tuple[Violation, ...]
    """Differences, by tick."""
    tears: tuple[Violation, ...]
    """Journals that end early."""
    rounding: int = 0
    """Number of messages that differ by rounding alone, in a recording made with other versions."""
    versions: str | None = None
    """Description of how those versions differ from the ones of this process; None if they do not."""


def replayed(run: Run) -> Replay:
    """Replay `run`, and return the result.

    Raises CorruptJournal if a frame cannot be decoded or is in the journal of another robot.
    """
    findings = audit_run(run, REPLAY_RULES, HARDWARE_REPLAY_RULES)
    return Replay(
        findings.scenario,
        findings.ticks,
        sum([count.checks for count in findings.counts]),
        tuple([one for one in findings.violations if not one.breaks_off]),
        tuple([one for one in findings.violations if one.breaks_off]),
        len(findings.rounding),
        findings.versions,
    )
