"""`tandem keys`: certificates and access rules, for missions over networks that are not trusted."""

from __future__ import annotations

import argparse

from compose.errors import ENDED, UserError
from compose.extras import need
from protocol.output import say


def main(options: argparse.Namespace) -> int:
    """Make what is not there yet."""
    need("cryptography", extra="deploy")
    from compose.security import certificates  # noqa: PLC0415  # a robot has no such library

    for host in options.host:
        if not certificates.is_host(host):
            raise UserError(f"--host: '{host}' is neither a name nor an address")
    try:
        made, kept = certificates.make(options.folder, options.robots, options.host, options.days)
    except certificates.BadKeys as error:
        raise UserError(str(error)) from None
    except OSError as error:
        raise UserError(f"{options.folder} cannot be written: {error.strerror or error}") from None
    if made:
        say(f"made, for {options.days} days: {', '.join(made)}")
    if kept:
        say(f"kept, with their keys and names: {', '.join(kept)}")
    say(f"copy each folder in {options.folder} to its machine only; ca-key.pem, which signs, to none")
    return ENDED
