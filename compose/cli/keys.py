"""`tandem keys`: create certificates and access rules for missions over networks without trust."""

from __future__ import annotations

import argparse

from compose.cli.arguments import add_closing, days, folder, names
from compose.errors import ENDED, CannotWrite, UserError
from compose.extras import need
from compose.terminal.text_width import tell


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem keys`."""
    parser.add_argument(
        "folder",
        type=folder,
        metavar="DIR",
        help="folder for the keys, one subfolder per participant; existing keys are not replaced",
    )
    parser.add_argument(
        "--robots", type=names, required=True, metavar="A,B", help="ids of the robots that take part"
    )
    parser.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="NAME",
        help="host name or IP address of the world or a router; may be repeated "
        "[always included: localhost, 127.0.0.1, ::1]",
    )
    parser.add_argument(
        "--days",
        type=days,
        default=365,
        metavar="N",
        help="days for which the certificates are valid, 1 to 36500 [default: %(default)s]",
    )
    add_closing(parser, "tandem keys keys --robots a,b --host 10.0.0.1", "docs/network.md")


def main(options: argparse.Namespace) -> int:
    """Create the certificates that do not exist yet, and write all access rules."""
    need("cryptography", extra="deploy")
    from compose.security import certificates  # noqa: PLC0415  # the library is optional

    for host in options.host:
        if not certificates.is_host(host):
            raise UserError(f"--host: '{host}' is neither a host name nor an IP address")
    try:
        made, kept = certificates.make(options.folder, options.robots, options.host, options.days)
    except OSError as error:
        raise CannotWrite(options.folder, error) from None
    if made:
        tell(f"created, valid for {options.days} days: {', '.join(made)}")
    if kept:
        tell(f"unchanged: {', '.join(kept)}")
    tell(f"Copy each folder in {options.folder} to its own machine only. Do not copy ca-key.pem: it signs.")
    return ENDED
