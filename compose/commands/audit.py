"""`tandem audit`: whether a record keeps the rules."""

from __future__ import annotations

import argparse

from compose.audit.findings import Findings
from compose.audit.judge import audit
from compose.record import legible
from compose.status import CLEAN, VIOLATED
from protocol.terminal import say

SHOWN = 20
"""violations that are told in full"""


def main(options: argparse.Namespace) -> int:
    """Judge the record, and say what there is to find."""
    with legible(options.record):
        findings = audit(options.record)
    _show(findings)
    return VIOLATED if findings.violations else CLEAN


def _show(findings: Findings) -> None:
    say(f"{findings.scenario}: {_count(len(findings.violations))} in {findings.ticks} ticks", "")
    say(f"{'rule':10}{'checks':>8}{'violations':>12}")
    for one in findings.counts:
        say(f"{one.rule:10}{one.checks:>8}{one.violations:>12}")
    if findings.radio:
        say("", f"{'link':16}{'sent':>8}{'heard':>8}{'late':>8}{'twice':>8}{'damaged':>9}{'lost':>8}")
    for link in findings.radio:
        say(
            f"{link.link:16}{link.sent:>8}{link.heard:>8}{link.late:>8}{link.twice:>8}{link.damaged:>9}{link.lost:>8}"
        )
    if findings.rounding:
        say("", f"{len(findings.rounding)} checks differ by rounding alone: {findings.versions}")
    elif findings.violations and findings.versions is not None:
        say("", f"{findings.versions}: that alone can lead to other decisions")
    if findings.violations:
        say("")
    for violation in findings.violations[:SHOWN]:
        say(violation.line)
    if len(findings.violations) > SHOWN:
        say(f"and {len(findings.violations) - SHOWN} more")


def _count(violations: int) -> str:
    return "one violation" if violations == 1 else f"{violations or 'no'} violations"
