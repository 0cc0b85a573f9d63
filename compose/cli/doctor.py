"""`tandem doctor`: check this machine, its keys and its network before a mission; one line per check."""

from __future__ import annotations

import argparse
from itertools import chain

from compose.doctor.certificate_checks import certificate_findings
from compose.doctor.machine_checks import ports, versions
from compose.doctor.network_checks import network
from compose.network import reach
from compose.terminal.finding import tell_all


def main(options: argparse.Namespace) -> int:
    """Run all checks, and return VIOLATED if one of them failed."""
    endpoints = reach(options, None)
    of_network = network(endpoints, options.timeout)
    return tell_all(chain(versions(), ports(endpoints), certificate_findings(endpoints), of_network), width=4)
