"""`tandem audit`: check a recording against the rules of the world, the planner and the protocol."""

from __future__ import annotations

import argparse

from msgspec.structs import astuple

from compose.audit.findings import Findings, LinkStatistics
from compose.audit.rules import audit_run
from compose.cli.recording import read_noted
from compose.errors import ENDED, VIOLATED
from compose.recording.recording_files import user_errors
from compose.terminal import text_width
from compose.terminal.text_width import tell
from protocol.output import say

SHOWN_VIOLATIONS = 20
"""The number of violations that are printed in full."""


def main(options: argparse.Namespace) -> int:
    """Audit the recording, print the findings, and return VIOLATED if a rule is violated."""
    with user_errors(options.recording):
        findings = audit_run(read_noted(options.recording, "audit", audited=True))
    _show(findings)
    return VIOLATED if findings.violations else ENDED


def _show(findings: Findings) -> None:
    found = len(findings.violations)
    violations = "one violation" if found == 1 else f"{found or 'no'} violations"
    tell(f"{findings.scenario}: {violations} over {findings.ticks} ticks", "")
    say(f"{'rule':10}{'checks':>8}{'violations':>12}")
    for one in findings.counts:
        say(f"{one.rule:10}{one.checks:>8}{one.violations:>12}")
    if findings.links:
        from compose.terminal import tables  # noqa: PLC0415  # rich is slow to import

        rows = [[str(value) for value in astuple(link)] for link in findings.links]
        made = tables.table(["link"], LinkStatistics.__struct_fields__[1:], rows)
        say("", *tables.lines(made, text_width.room()))
    if findings.rounding:
        tell("", f"{len(findings.rounding)} checks differ by rounding alone: {findings.versions}")
    elif findings.violations and findings.versions is not None:
        tell("", f"{findings.versions}: that alone can lead to other decisions")
    if findings.violations:
        say("")
    for violation in findings.violations[:SHOWN_VIOLATIONS]:
        tell(violation.line)
    if len(findings.violations) > SHOWN_VIOLATIONS:
        say(f"and {len(findings.violations) - SHOWN_VIOLATIONS} more")
