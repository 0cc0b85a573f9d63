"""What a mission needs of this machine: what is installed, and the ports to listen on."""

from __future__ import annotations

import errno
import platform
import socket
from collections.abc import Iterator

from compose import extras
from compose.doctor.finding import Finding, fix, ok
from compose.extras import PACKAGE
from compose.network import beyond
from protocol.network.endpoints import Endpoints, place
from protocol.wire import VERSION

PORT = {
    errno.EADDRINUSE: "taken; end the process that has it (`ss -ltnp` lists them), or choose another port",
    errno.EADDRNOTAVAIL: "no address of this machine; `ip address` lists those, and 0.0.0.0 is all of them",
    errno.EACCES: "not for everybody; choose a port from 1024 on",
}
"""what there is to be done about a port"""


def versions() -> Iterator[Finding]:
    """What is installed is what Tandem asks for."""
    own = extras.version()
    if own is None:
        yield fix(f"{PACKAGE} is not installed; `uv sync`, or `pip install` it")
        return
    found = list(extras.libraries())
    well = [f"{one.name} {one.version}" for one in found if one.fits]
    said = [f"python {platform.python_version()}", f"{PACKAGE} {own}", *well, f"protocol version {VERSION}"]
    yield ok(f"versions: {', '.join(said)}")
    for one in found:
        if not one.fits:
            what = f"{one.name} {one.version}" if one.version is not None else f"{one.name} is missing"
            yield fix(f"versions: {what}; {PACKAGE} {own} needs {one.bounds}: install it anew")


def ports(endpoints: Endpoints) -> Iterator[Finding]:
    """Each place to listen can be had, and nobody is let in by mistake."""
    for endpoint in endpoints.listen:
        complaint = _taken(endpoint)
        yield fix(f"port: {endpoint}: {complaint}") if complaint else ok(f"port: {endpoint} is free")
    if (warning := beyond(endpoints)) is not None:
        yield fix(f"port: {warning}; make keys by `tandem keys`, or listen at 127.0.0.1")


def _taken(endpoint: str) -> str | None:
    """What keeps a process from listening there; none if it can."""
    where = place(endpoint)
    if where is None:
        return "no place with a port"
    kind = socket.SOCK_DGRAM if endpoint.startswith("quic/") else socket.SOCK_STREAM
    try:
        for family, type_, number, _, address in socket.getaddrinfo(*where, type=kind):
            with socket.socket(family, type_, number) as probe:
                if kind == socket.SOCK_STREAM:  # as Zenoh does: the remains of old links do not matter
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
    except socket.gaierror:
        return f"there is no host '{where[0]}'; check the address"
    except OSError as error:
        return PORT.get(error.errno or 0, f"{error.strerror or error}; check the address")
    return None
