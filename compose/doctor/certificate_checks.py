"""Checks of certificates: their name, their authority, their validity, and the permissions of their keys.

OpenSSL verifies each certificate in a TLS handshake in memory, without the network. The dates are checked
separately, so that a finding can state them.
"""

from __future__ import annotations

import ipaddress
import ssl
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from compose.network import KEYED
from compose.terminal.finding import FIX, Finding, fix, ok
from protocol.network import access_control
from protocol.network.endpoints import Endpoints, is_encrypted, place

SOON_DAYS = 30
"""The number of days before its expiry from which a certificate must be renewed."""
DAY_S = 86_400.0
NO_CHECK_TIME = 0x200000
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME, which the module ssl does not define."""
UNASKED = ""
"""The password for encrypted keys. Zenoh supports none; without this value, OpenSSL asks on the terminal."""
FLIGHTS = 4
"""The number of exchanges after which a handshake in memory has succeeded or failed."""


class CertificateSet(NamedTuple):
    """A certificate, its key, and the authority that must have signed it."""

    certificate: Path
    key: Path
    authority: Path
    connects: bool
    """True if it is used for connecting; otherwise it is used for listening."""


def certificate_findings(endpoints: Endpoints, now: float | None = None) -> Iterator[Finding]:
    """Check all certificates in the configuration; `now` is the time in s since 1970."""
    yielded = set()
    for side in ("connect", "listen"):
        certificate, key, authority = (
            endpoints.file(f"transport/link/tls/{name}")
            for name in (f"{side}_certificate", f"{side}_private_key", "root_ca_certificate")
        )
        if certificate is not None and key is not None and authority is not None:
            files = CertificateSet(certificate, key, authority, side == "connect")
            for finding in _findings(files, endpoints, time.time() if now is None else now):
                if finding not in yielded:
                    yielded.add(finding)
                    yield finding


def _findings(files: CertificateSet, endpoints: Endpoints, now: float) -> Iterator[Finding]:
    at = files.certificate
    if files.key.stat().st_mode & 0o077:
        yield fix(f"key: other users can read {files.key}; chmod 600 {files.key}")
    else:
        yield ok(f"key: only its owner can read {files.key}")
    try:
        shown = _shown(files)
    except ssl.SSLCertVerificationError as error:
        yield fix(
            f"certificate: {at} is not accepted by {files.authority}: {error.verify_message}; "
            "take both from one folder that `tandem keys` created"
        )
        return
    except ssl.SSLError as error:
        yield fix(f"certificate: {at}: {_unusable(files, error)}; copy the folder again")
        return
    name = dict(pair for part in shown["subject"] for pair in part).get("commonName", "no name")
    yield ok(f"certificate: {at} is signed by {files.authority.name} and is of {name}")
    yield _dated(f"certificate: {at}", shown, now)
    for authority in _context(ssl.PROTOCOL_TLS_CLIENT, files.authority).get_ca_certs():
        finding = _dated(f"authority: {files.authority}", authority, now)
        if finding.mark == FIX:
            yield finding
    yield from _named(files, name, endpoints)
    if not files.connects:
        yield from _known(at, shown, endpoints)


def _unusable(files: CertificateSet, error: ssl.SSLError) -> str:
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"{files.key} is not its key"
    return f"with {files.key.name} and {files.authority.name} it cannot be read: {error.reason or error}"


def _named(files: CertificateSet, name: str, endpoints: Endpoints) -> Iterator[Finding]:
    """Check that the certificate, the configuration and the folder are of the same participant."""
    if endpoints.participant is None:
        return
    folder = files.certificate.parent
    if name != endpoints.participant:
        yield fix(
            f"names: {files.certificate} is of {name}, and {folder / KEYED} of {endpoints.participant}; "
            f"copy the folder of {endpoints.participant} again"
        )
    elif _is_participant(folder.name) and folder.name != name:
        yield fix(f"names: the folder {folder} contains the keys of {name}; copy the folder of {folder.name}")
    else:
        yield ok(f"names: certificate and configuration are of {name}")


def _is_participant(folder: str) -> bool:
    return folder.startswith(access_control.agent("")) or folder in (
        *access_control.CARRIERS,
        access_control.VIEWER,
    )


def _known(at: Path, shown: Mapping[str, Any], endpoints: Endpoints) -> Iterator[Finding]:
    """Check that the certificate names each host at which this participant listens."""
    names = {_host(value) for _, value in shown.get("subjectAltName", ())}
    for endpoint in endpoints.listen:
        where = place(endpoint)
        if where is None or not is_encrypted(endpoint) or where[0] in ("0.0.0.0", "::"):
            continue
        if _host(where[0]) in names:
            yield ok(f"names: {at} names {where[0]}")
        else:
            yield fix(
                f"names: {at} does not name {where[0]}, so clients will refuse it there; remove the folder, "
                f"and create it again with `tandem keys --host {where[0]}`"
            )


def _host(text: str) -> str:
    try:
        return str(ipaddress.ip_address(text.partition("%")[0]))
    except ValueError:
        return text.lower()


def _dated(what: str, shown: Mapping[str, Any], now: float) -> Finding:
    begins, ends = (ssl.cert_time_to_seconds(shown[name]) for name in ("notBefore", "notAfter"))
    days = (ends - now) / DAY_S
    renew = "remove its folder, and create it again with `tandem keys`"
    if now < begins:
        return fix(f"{what} is not valid before {_date(begins)}; set this host's clock, or wait")
    if now >= ends:
        return fix(f"{what} expired on {_date(ends)}; {renew}")
    if days < SOON_DAYS:
        return fix(f"{what} expires on {_date(ends)}, in {days:.0f} days; {renew}")
    return ok(f"{what} is valid until {_date(ends)}")


def _date(when: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(when))


def _shown(files: CertificateSet) -> Mapping[str, Any]:
    """Return the certificate as its peer receives and verifies it in a handshake. Raises ssl.SSLError."""
    client = _context(ssl.PROTOCOL_TLS_CLIENT, files.authority)
    server = _context(ssl.PROTOCOL_TLS_SERVER, files.authority)
    server.load_cert_chain(files.certificate, files.key, UNASKED)
    if files.connects:
        client.verify_mode = ssl.CERT_NONE
        client.load_cert_chain(files.certificate, files.key, UNASKED)
        server.verify_mode = ssl.CERT_REQUIRED
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True))
    for _ in range(FLIGHTS):
        for end in ends:
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return ends[1 if files.connects else 0].getpeercert() or {}


def _context(protocol: int, trusted: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.check_hostname = False
    context.load_verify_locations(cafile=trusted)
    context.verify_flags |= ssl.VerifyFlags(NO_CHECK_TIME)
    return context
