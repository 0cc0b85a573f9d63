"""The diagnosis of a router that cannot be reached.

Zenoh only reports a timeout. This module tries to connect on its own, layer by layer, to find the cause.
"""

from __future__ import annotations

import socket
import ssl

from protocol.network.endpoints import Endpoints, is_encrypted, place

FIRST_WORD_S = 5.0
"""The time in s without a router or a world after which a process prints a message."""
STEP_S = 2.0
"""The timeout in s of each step of the diagnosis."""
ALERT_S = 0.5
"""The time in s in which a router refuses a certificate after the TLS handshake."""

MUTE = "something listens there, but links fail; check that it is a Zenoh router, user and password, and tls/"
ALERTS = {
    "certificate_expired": "this certificate has expired",
    "unknown_ca": "it does not trust the authority of this certificate",
    "decrypt_error": "it does not trust the authority of this certificate",
    "certificate_required": "it requires a certificate, and there is none",
    "bad_certificate": "it does not accept this certificate",
    "certificate_unknown": "it does not accept this certificate",
    "certificate_revoked": "this certificate was revoked",
    "handshake_failure": "it refuses the handshake",
}
"""The TLS alerts of a router, with their meaning."""


def why(endpoints: Endpoints) -> str:
    """Return the cause for each router of `endpoints`, and what to check, for a user. This takes seconds."""
    reasons = {endpoint: _why(endpoints, endpoint) for endpoint in endpoints.connect}
    if len(reasons) == 1:
        return next(iter(reasons.values()))
    return "; ".join(f"{endpoint}: {what}" for endpoint, what in reasons.items())


def _why(endpoints: Endpoints, endpoint: str) -> str:
    where = place(endpoint)
    if where is None or endpoint.startswith("quic/"):
        return "no answer; check address and certificate"
    try:
        with socket.create_connection(where, STEP_S) as link:
            if is_encrypted(endpoint):
                return _refused(endpoints, link, where[0])
            return _no_link(link)
    except socket.gaierror:
        return f"there is no host '{where[0]}'; check the address"
    except ConnectionRefusedError:
        return "nothing listens there; check the address, and that the router runs"
    except TimeoutError:
        return f"no answer within {STEP_S:g} s; check the address, the network, and firewalls"
    except OSError as error:
        return f"{error.strerror or error}; check the address"


def _refused(endpoints: Endpoints, link: socket.socket, host: str) -> str:
    """Return the cause that a TLS handshake over `link` shows."""
    try:
        context = ssl.create_default_context(cafile=endpoints.file("transport/link/tls/root_ca_certificate"))
        context.check_hostname = endpoints.setting("transport/link/tls/verify_name_on_connect") is not False
        certificate = endpoints.file("transport/link/tls/connect_certificate")
        if certificate is not None:
            key = endpoints.file("transport/link/tls/connect_private_key")
            context.load_cert_chain(certificate, key, password="")  # without it, OpenSSL asks the terminal
    except (OSError, ValueError) as error:
        return f"the certificates here cannot be used: {error}"
    try:
        with context.wrap_socket(link, server_hostname=host) as secured:
            return _no_link(secured)
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is not valid here: {error.verify_message}; check certificates and dates"
    except ssl.SSLError as error:
        return _alert(error)
    except TimeoutError:
        return "it answers, but not with TLS; check that it listens at tls/"
    except OSError as error:
        return f"it aborts the handshake: {error.strerror or error}; check that it listens at tls/"


def _alert(error: ssl.SSLError) -> str:
    reason = (error.reason or "").lower()
    for name, meaning in ALERTS.items():
        if reason.endswith(name):
            return f"{meaning}; check the certificate"
    if "wrong_version" in reason or "record_layer" in reason:
        return "it answers, but not with TLS; check that it listens at tls/"
    return f"TLS fails: {reason.replace('_', ' ') or error}; check the certificate"


def _no_link(link: socket.socket) -> str:
    """Return the cause if the link itself works: the router closes it, or does not answer."""
    link.settimeout(ALERT_S)
    try:
        closed = not link.recv(1)
    except TimeoutError:
        closed = False
    if closed:
        return "it closes the link; check that it is a Zenoh router, and tls/ or tcp/"
    return MUTE
