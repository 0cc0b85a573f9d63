"""Checks of this machine: the installed packages, and the ports to listen on."""

from __future__ import annotations

import errno
import platform
import socket
from collections.abc import Iterator

from compose import extras
from compose.network import beyond
from compose.terminal.finding import Finding, fix, ok
from protocol import PACKAGE
from protocol.files import error_text
from protocol.network.endpoints import Endpoints, place
from protocol.wire import VERSION

PORT = {
    errno.EADDRINUSE: "in use; end the process that uses it (`ss -ltnp` lists them), or choose another port",
    errno.EADDRNOTAVAIL: "not an address of this host; `ip address` lists them, and 0.0.0.0 is all of them",
    errno.EACCES: "reserved for privileged users; choose a port from 1024 on",
}
"""The problem with a port and its solution, by the error of bind(2)."""


def versions() -> Iterator[Finding]:
    """Check that the installed packages have the versions that Tandem requires."""
    own = extras.version()
    if own is None:
        yield fix(f"{PACKAGE} is not installed; `uv sync`, or `pip install` it")
        return
    found = list(extras.libraries())
    fitting = [f"{one.name} {one.version}" for one in found if one.fits]
    installed = [
        f"python {platform.python_version()}",
        f"{PACKAGE} {own}",
        *fitting,
    ]
    if all(one.fits for one in found):
        from agent.estimation import compiled  # noqa: PLC0415  # it imports numpy, which has to be there

        try:
            installed.append(f"estimator compiled by {compiled.compiler()}")
        except compiled.NoKernel as error:
            yield fix(f"versions: {error_text(error)}")
    installed.append(f"protocol version {VERSION}")
    yield ok(f"versions: {', '.join(installed)}")
    for one in found:
        if not one.fits:
            what = f"{one.name} {one.version}" if one.version is not None else f"{one.name} is missing"
            yield fix(f"versions: {what}; {PACKAGE} {own} needs {one.bounds}: install it again")


def ports(endpoints: Endpoints) -> Iterator[Finding]:
    """Check that each port to listen on is free, and not open to other machines without keys."""
    for endpoint in endpoints.listen:
        problem = _problem(endpoint)
        yield fix(f"port: {endpoint}: {problem}") if problem else ok(f"port: {endpoint} is free")
    if (warning := beyond(endpoints)) is not None:
        yield fix(f"port: {warning}; create keys with `tandem keys`, or listen at 127.0.0.1")


def _problem(endpoint: str) -> str | None:
    """Return why a process cannot listen at `endpoint`, and what to do; None if it can."""
    where = place(endpoint)
    if where is None:
        return "not an address with a port"
    kind = socket.SOCK_DGRAM if endpoint.startswith("quic/") else socket.SOCK_STREAM
    try:
        for family, type_, number, _, address in socket.getaddrinfo(*where, type=kind):
            with socket.socket(family, type_, number) as probe:
                if kind == socket.SOCK_STREAM:  # as Zenoh does, so that links in TIME_WAIT do not matter
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
    except socket.gaierror:
        return f"there is no host '{where[0]}'; check the address"
    except OSError as error:
        return PORT.get(error.errno or 0, f"{error.strerror or error}; check the address")
    return None
