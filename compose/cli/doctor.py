"""`tandem doctor`: check this machine, its keys and its network before a mission; one line per check."""

from __future__ import annotations

import argparse
from itertools import chain

from compose.doctor.certificate_checks import certificate_findings
from compose.doctor.finding import FIX
from compose.doctor.machine_checks import ports, versions
from compose.doctor.network_checks import network
from compose.errors import ENDED, VIOLATED
from compose.network import reach
from compose.terminal import text_width
from protocol.output import one_line, say


def main(options: argparse.Namespace) -> int:
    """Run all checks, and return VIOLATED if one of them failed."""
    endpoints = reach(options, None)
    status = ENDED
    checks = (
        versions(),
        ports(endpoints),
        certificate_findings(endpoints),
        network(endpoints, options.timeout),
    )
    for finding in chain.from_iterable(checks):
        say(*text_width.wrapped(one_line(str(finding)), len(finding.mark) + 2))
        status = VIOLATED if finding.mark == FIX else status
    return status
