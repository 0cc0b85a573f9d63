"""`tandem doctor`: what a mission needs of this machine, its keys and its network, a line each."""

from __future__ import annotations

import argparse
from itertools import chain

from compose import layout
from compose.doctor.finding import FIX
from compose.doctor.machine import ports, versions
from compose.doctor.network import network
from compose.doctor.papers import papers
from compose.reach import reach
from compose.status import AMISS, CLEAN
from protocol.terminal import one_line, say


def main(options: argparse.Namespace) -> int:
    """Check everything, whatever of it fails."""
    endpoints = reach(options, None)
    status = CLEAN
    checks = (versions(), ports(endpoints), papers(endpoints), network(endpoints, options.wait))
    for finding in chain.from_iterable(checks):
        say(*layout.wrapped(one_line(str(finding)), len(finding.mark) + 2))
        status = AMISS if finding.mark == FIX else status
    return status
