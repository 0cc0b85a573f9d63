"""`tandem keys`: create certificates and access rules for missions over networks without trust."""

from __future__ import annotations

import argparse

from compose.errors import ENDED, UserError, writing
from compose.extras import need
from compose.terminal.text_width import tell


def main(options: argparse.Namespace) -> int:
    """Create the certificates that do not exist yet, and write all access rules."""
    need("cryptography", extra="deploy")
    from compose.security import certificates  # noqa: PLC0415  # the library is optional

    for host in options.host:
        if not certificates.is_host(host):
            raise UserError(f"--host: '{host}' is neither a host name nor an IP address")
    with writing(options.folder):
        made, kept = certificates.make(options.folder, options.robots, options.host, options.days)
    if made:
        tell(f"created, valid for {options.days} days: {', '.join(made)}")
    if kept:
        tell(f"unchanged: {', '.join(kept)}")
    tell(f"Copy each folder in {options.folder} to its own machine only. Do not copy ca-key.pem: it signs.")
    return ENDED
