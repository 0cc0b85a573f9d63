"""Why a router cannot be reached.

Zenoh says only that it cannot be, after a time-out; so this tries the same by itself, layer by layer.
"""

from __future__ import annotations

import socket
import ssl

from protocol.network.endpoints import Endpoints, is_encrypted, place

FIRST_WORD_S = 5.0
"""how long to look for a router, or a world, before saying so"""
STEP_S = 2.0
"""how long to wait for an address, for an answer, and for what comes after"""
ALERT_S = 0.5
"""how long a router that has taken part in a handshake may need to refuse the certificate after it"""

MUTE = (
    "something listens there, and makes no link; check that it is a Zenoh router, user and password, and tls/"
)
TOLD = {
    "certificate_expired": "this certificate has expired",
    "unknown_ca": "this certificate is not of an authority that it trusts",
    "decrypt_error": "this certificate is not of an authority that it trusts",
    "certificate_required": "it asks for a certificate, and there is none",
    "bad_certificate": "it does not take this certificate",
    "certificate_unknown": "it does not take this certificate",
    "certificate_revoked": "this certificate was revoked",
    "handshake_failure": "it refuses the handshake",
}
"""what a router's alert means"""


def why(endpoints: Endpoints) -> str:
    """What stands between this process and each of its routers, and what to check; takes seconds."""
    found = {endpoint: _why(endpoints, endpoint) for endpoint in endpoints.connect}
    if len(found) == 1:
        return next(iter(found.values()))
    return "; ".join(f"{endpoint}: {what}" for endpoint, what in found.items())


def _why(endpoints: Endpoints, endpoint: str) -> str:
    where = place(endpoint)
    if where is None or endpoint.startswith("quic/"):
        return "no answer; check address and certificate"
    try:
        with socket.create_connection(where, STEP_S) as link:
            if is_encrypted(endpoint):
                return _refused(endpoints, link, where[0])
            return _mute(link)
    except socket.gaierror:
        return f"there is no host '{where[0]}'; check the address"
    except ConnectionRefusedError:
        return "nobody listens there; check the address, and that the router runs"
    except TimeoutError:
        return f"no answer within {STEP_S:g} s; check the address, the network, and firewalls"
    except OSError as error:
        return f"{error.strerror or error}; check the address"


def _refused(endpoints: Endpoints, link: socket.socket, host: str) -> str:
    """What happens where Zenoh's own handshake would begin."""
    try:
        context = ssl.create_default_context(cafile=endpoints.file("transport/link/tls/root_ca_certificate"))
        context.check_hostname = endpoints.setting("transport/link/tls/verify_name_on_connect") is not False
        certificate = endpoints.file("transport/link/tls/connect_certificate")
        if certificate is not None:
            key = endpoints.file("transport/link/tls/connect_private_key")
            context.load_cert_chain(certificate, key, password="")  # or it would ask the terminal
    except (OSError, ValueError) as error:
        return f"the certificates here cannot be used: {error}"
    try:
        with context.wrap_socket(link, server_hostname=host) as secured:
            return _mute(secured)
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is refused here: {error.verify_message}; check certificates, and dates"
    except ssl.SSLError as error:
        return _alert(error)
    except TimeoutError:
        return "it answers, but not with TLS; check that it listens at tls/"
    except OSError as error:
        return f"it breaks off the handshake: {error.strerror or error}; check that it listens at tls/"


def _alert(error: ssl.SSLError) -> str:
    reason = (error.reason or "").lower()
    for name, meaning in TOLD.items():
        if reason.endswith(name):
            return f"{meaning}; check the certificate"
    if "wrong_version" in reason or "record_layer" in reason:
        return "it answers, but not with TLS; check that it listens at tls/"
    return f"TLS fails: {reason.replace('_', ' ') or error}; check the certificate"


def _mute(link: socket.socket) -> str:
    """The link stands, as far as can be seen from here."""
    link.settimeout(ALERT_S)
    try:
        closed = not link.recv(1)
    except TimeoutError:
        closed = False
    if closed:
        return "it closes the link; check that it is a Zenoh router, and tls/ or tcp/"
    return MUTE
