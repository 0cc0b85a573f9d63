"""Certificates: who they say they are, who signed them, how long they hold, and who can read their keys.

Each is shown to an end of a TLS handshake in memory, and judged by OpenSSL there, but for the dates, which
are to be told. Nobody else sees it.
"""

from __future__ import annotations

import ipaddress
import ssl
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from compose.doctor.finding import Finding, fix, ok
from compose.network import KEYED
from protocol.network import access_control
from protocol.network.endpoints import Endpoints, is_encrypted, place

SOON_DAYS = 30
"""a certificate that ends sooner is to be renewed"""
DAY_S = 86_400.0
NO_CHECK_TIME = 0x200000
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME, for which the module ssl has no name"""
UNASKED = ""
"""the password of a key that has one, instead of a question on the terminal; Zenoh knows none either"""
FLIGHTS = 4
"""a handshake in memory is over after as many, either way"""


class CertificateSet(NamedTuple):
    """A certificate, its key, and the authority that must have signed it."""

    certificate: Path
    key: Path
    authority: Path
    connects: bool
    """it is for connecting with; else for listening"""


def papers(endpoints: Endpoints, now: float | None = None) -> Iterator[Finding]:
    """Of all certificates that the configuration names; `now` is the time, in s since 1970."""
    told = set()
    for side in ("connect", "listen"):
        certificate, key, authority = (
            endpoints.file(f"transport/link/tls/{name}")
            for name in (f"{side}_certificate", f"{side}_private_key", "root_ca_certificate")
        )
        if certificate is not None and key is not None and authority is not None:
            paper = CertificateSet(certificate, key, authority, side == "connect")
            for finding in _findings(paper, endpoints, time.time() if now is None else now):
                if finding not in told:
                    told.add(finding)
                    yield finding


def _findings(paper: CertificateSet, endpoints: Endpoints, now: float) -> Iterator[Finding]:
    at = paper.certificate
    if paper.key.stat().st_mode & 0o077:
        yield fix(f"key: others than its owner can read {paper.key}; chmod 600 {paper.key}")
    else:
        yield ok(f"key: only its owner reads {paper.key}")
    try:
        signed = True
        shown = _shown(paper, paper.authority)
    except ssl.SSLCertVerificationError as error:
        yield fix(
            f"certificate: {at} is refused by {paper.authority}: {error.verify_message}; "
            "take both from one folder that `tandem keys` made"
        )
        signed = False
        try:
            shown = _shown(paper, at)
        except ssl.SSLError:
            return
    except ssl.SSLError as error:
        yield fix(f"certificate: {at}: {_unusable(paper, error)}; copy the folder once more")
        return
    name = dict(pair for part in shown["subject"] for pair in part).get("commonName", "nobody")
    if signed:
        yield ok(f"certificate: {paper.authority.name} signs {at}, which is of {name}")
    yield _dated(f"certificate: {at}", shown, now)
    for authority in _context(ssl.PROTOCOL_TLS_CLIENT, paper.authority).get_ca_certs():
        finding = _dated(f"authority: {paper.authority}", authority, now)
        if finding.mark != ok("").mark:
            yield finding
    yield from _named(paper, name, endpoints)
    if not paper.connects:
        yield from _known(at, shown, endpoints)


def _unusable(paper: CertificateSet, error: ssl.SSLError) -> str:
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"{paper.key} is not its key"
    return f"with {paper.key.name} and {paper.authority.name} it cannot be read: {error.reason or error}"


def _named(paper: CertificateSet, name: str, endpoints: Endpoints) -> Iterator[Finding]:
    """Whether the certificate, the configuration and the folder are of the same participant."""
    if endpoints.participant is None:
        return
    folder = paper.certificate.parent
    if name != endpoints.participant:
        yield fix(
            f"names: {paper.certificate} is of {name}, and {folder / KEYED} of {endpoints.participant}; "
            f"copy the folder of {endpoints.participant} once more"
        )
    elif _is_participant(folder.name) and folder.name != name:
        yield fix(f"names: the folder {folder} holds the keys of {name}; copy the one of {folder.name}")
    else:
        yield ok(f"names: certificate and configuration are of {name}")


def _is_participant(folder: str) -> bool:
    return folder.startswith(access_control.agent("")) or folder in (
        *access_control.CARRIERS,
        access_control.VIEWER,
    )


def _known(at: Path, shown: Mapping[str, Any], endpoints: Endpoints) -> Iterator[Finding]:
    """Whether who connects to where this one listens finds that name in the certificate."""
    names = {_host(value) for _, value in shown.get("subjectAltName", ())}
    for endpoint in endpoints.listen:
        where = place(endpoint)
        if where is None or not is_encrypted(endpoint) or where[0] in ("0.0.0.0", "::"):
            continue
        if _host(where[0]) in names:
            yield ok(f"names: {at} names {where[0]}")
        else:
            yield fix(
                f"names: {at} does not name {where[0]}, so nobody will believe it there; remove the folder, "
                f"and make it anew by `tandem keys` with --host {where[0]}"
            )


def _host(text: str) -> str:
    try:
        return str(ipaddress.ip_address(text.partition("%")[0]))
    except ValueError:
        return text.lower()


def _dated(what: str, shown: Mapping[str, Any], now: float) -> Finding:
    begins, ends = (ssl.cert_time_to_seconds(shown[name]) for name in ("notBefore", "notAfter"))
    days = (ends - now) / DAY_S
    renew = "remove its folder, and make it anew by `tandem keys`"
    if now < begins:
        return fix(f"{what} is not valid before {_date(begins)}; set this host's clock, or wait")
    if now >= ends:
        return fix(f"{what} has expired on {_date(ends)}; {renew}")
    if days < SOON_DAYS:
        return fix(f"{what} expires on {_date(ends)}, in {days:.0f} days; {renew}")
    return ok(f"{what} is valid until {_date(ends)}")


def _date(when: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(when))


def _shown(paper: CertificateSet, trusted: Path) -> Mapping[str, Any]:
    """What an end of a handshake sees of who shows this certificate. Raises ssl.SSLError."""
    client = _context(ssl.PROTOCOL_TLS_CLIENT, trusted)
    server = _context(ssl.PROTOCOL_TLS_SERVER, trusted)
    server.load_cert_chain(paper.certificate, paper.key, UNASKED)
    if paper.connects:
        client.verify_mode = ssl.CERT_NONE
        client.load_cert_chain(paper.certificate, paper.key, UNASKED)
        server.verify_mode = ssl.CERT_REQUIRED
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True))
    for _ in range(FLIGHTS):
        for end in ends:
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return ends[1 if paper.connects else 0].getpeercert() or {}


def _context(protocol: int, trusted: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.check_hostname = False
    context.load_verify_locations(cafile=trusted)
    context.verify_flags |= ssl.VerifyFlags(NO_CHECK_TIME) | ssl.VerifyFlags.VERIFY_X509_PARTIAL_CHAIN
    return context
