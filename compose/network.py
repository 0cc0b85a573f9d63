"""How a command reaches the network, as its flags say: --connect, --listen, --config, --keys."""

from __future__ import annotations

import argparse
from pathlib import Path

from msgspec.structs import replace

from compose.errors import UserError
from protocol.network import access_control
from protocol.network.endpoints import (
    BadConfiguration,
    BadEndpoint,
    Endpoints,
    check_endpoint,
    configured,
    is_encrypted,
)

KEYED = "zenoh.json5"
"""the configuration in a participant's folder, which `tandem keys` makes"""


DEFAULT_ADDRESS = "127.0.0.1:7447"
"""where viewers look for missions"""


def reach(options: argparse.Namespace, who: str | None) -> Endpoints:
    """The endpoints of `who`: "world", "viewer", a robot's "agent-ID", or anybody's. Raises UserError."""
    connect, listen = tuple(options.connect), tuple(getattr(options, "listen", ()))
    file = _keyed(options.keys) if options.keys is not None else options.config
    for flag, endpoints in (("--connect", connect), ("--listen", listen)):
        for endpoint in endpoints:
            _check(flag, endpoint, keyed=options.keys is not None, configured=file is not None)
    if file is None:
        return Endpoints(connect, listen)
    try:
        found = configured(file, connect, listen)
    except BadConfiguration as error:
        raise UserError(f"{'--config' if options.keys is None else '--keys'}: {error}") from None
    if options.keys is not None and who is not None and found.participant != who:
        raise UserError(f"--keys: {options.keys} is the folder of {found.participant}, not of {who}")
    return found


def places(options: argparse.Namespace) -> list[Endpoints]:
    """Where a viewer looks for missions, each of which may be anywhere else. Raises UserError."""
    found = reach(options, access_control.VIEWER)
    if not found.connect:
        return [replace(found, connect=(f"{'tls' if options.keys else 'tcp'}/{DEFAULT_ADDRESS}",))]
    return [replace(found, connect=(one,)) for one in found.connect] if options.connect else [found]


def _check(flag: str, endpoint: str, *, keyed: bool, configured: bool) -> None:
    try:
        check_endpoint(endpoint)
    except BadEndpoint as error:
        raise UserError(f"{flag}: {error}") from None
    encrypted = is_encrypted(endpoint)
    if keyed and not encrypted:
        raise UserError(
            f"{flag}: {endpoint} is not encrypted; with --keys it is tls/{endpoint.partition('/')[2]}"
        )
    if encrypted and not configured:
        raise UserError(
            f"{flag}: {endpoint} takes certificates: --keys DIR, or --config FILE that names them"
        )


def _keyed(folder: Path) -> Path:
    """The configuration in the folder of one participant. Raises UserError."""
    try:
        there = (folder / KEYED).is_file()
    except OSError as error:
        raise UserError(f"--keys: {folder}: cannot be read: {error.strerror or error}") from None
    if not there:
        within = sorted(path.parent.name for path in folder.glob(f"*/{KEYED}"))
        why = (
            f"name one of those in it: {', '.join(within)}" if within else "`tandem keys` makes such folders"
        )
        raise UserError(f"--keys: {folder} is no participant's folder of keys; {why}")
    return folder / KEYED


def beyond(endpoints: Endpoints) -> str | None:
    """What to know about them, if they let in whoever comes."""
    if not endpoints.exposed:
        return None
    return (
        f"listening beyond this machine without --keys, at {' and '.join(endpoints.exposed)}: "
        "whoever reaches it can read and steer the mission"
    )
