"""The network endpoints that the flags --connect, --listen, --config and --keys describe."""

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
"""The name of the Zenoh configuration in a participant's folder, which `tandem keys` writes."""

DEFAULT_ADDRESS = "127.0.0.1:7447"
"""The address at which viewers look for missions without --connect."""


def reach(options: argparse.Namespace, who: str | None) -> Endpoints:
    """Return the endpoints that the flags describe.

    `who` is the participant that --keys must belong to: "world", "viewer" or "agent-ID"; any if None.
    Raises UserError.
    """
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
    """Return the endpoints at each of which a viewer looks for missions. Raises UserError."""
    found = reach(options, access_control.VIEWER)
    if not found.connect:
        return [replace(found, connect=(f"{'tls' if options.keys else 'tcp'}/{DEFAULT_ADDRESS}",))]
    return [replace(found, connect=(one,)) for one in found.connect] if options.connect else [found]


def _check(flag: str, endpoint: str, *, keyed: bool, configured: bool) -> None:
    """Check that `endpoint` is valid, and that it fits the flags for certificates. Raises UserError."""
    try:
        check_endpoint(endpoint)
    except BadEndpoint as error:
        raise UserError(f"{flag}: {error}") from None
    encrypted = is_encrypted(endpoint)
    if keyed and not encrypted:
        raise UserError(
            f"{flag}: {endpoint} is not encrypted; with --keys, use tls/{endpoint.partition('/')[2]}"
        )
    if encrypted and not configured:
        raise UserError(
            f"{flag}: {endpoint} needs certificates: --keys DIR, or --config FILE that names them"
        )


def _keyed(folder: Path) -> Path:
    """Return the path of the configuration in a participant's folder. Raises UserError."""
    try:
        exists = (folder / KEYED).is_file()
    except OSError as error:
        raise UserError(f"--keys: {folder}: cannot be read: {error.strerror or error}") from None
    if not exists:
        within = sorted(path.parent.name for path in folder.glob(f"*/{KEYED}"))
        why = (
            f"choose one of its folders: {', '.join(within)}"
            if within
            else "`tandem keys` creates such folders"
        )
        raise UserError(f"--keys: {folder} is not a participant's folder of keys; {why}")
    return folder / KEYED


def beyond(endpoints: Endpoints) -> str | None:
    """Return a warning if other machines can connect without authentication, or None."""
    if not endpoints.exposed:
        return None
    return (
        f"listening without --keys at {' and '.join(endpoints.exposed)}: "
        "every machine that reaches it can read and control the mission"
    )
