"""Certificates for all participants of missions, and their Zenoh configurations.

Each participant has a folder with its certificate and key, the authority's certificate, and a configuration.
The configuration names these files, requires certificates of all other participants, and enforces the rules
of protocol/network/access_control.py. Both Tandem (`--keys`) and the official Zenoh router can use it.
"""

from __future__ import annotations

import ipaddress
import json
import re
import shutil
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from compose.errors import UserError
from compose.network import KEYED
from protocol import files
from protocol.network import access_control

AUTHORITY_DAYS = 36_500
"""The validity of the authority's certificate in days."""
SKEW = timedelta(days=1)
"""The time by which a participant's clock may be behind."""
SECRET = 0o600
"""The mode with which a secret file is created: only its owner can read it."""
GITIGNORE = ".gitignore"
CERTIFIED_HOSTS = ("localhost", "127.0.0.1", "::1")
"""The host names in every certificate."""


class Authority(NamedTuple):
    """The certificate authority, with its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make(folder: Path, robots: Sequence[str], hosts: Sequence[str], days: int) -> tuple[list[str], list[str]]:
    """Create the missing participants' folders in `folder`; return the created names and the existing ones.

    The participants are the router, the world, the viewer, and the agents of `robots` and of robots that have
    a folder. Certificates are valid for `days`; those of the router and the world also name `hosts`. Existing
    certificates are not changed; all configurations are written again. Raises UserError or OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    authority = _authority(folder)
    if not (folder / GITIGNORE).exists():
        files.write(folder / GITIGNORE, "# Keys do not belong in a repository.\n*\n")
    known = {path.parent.name.removeprefix("agent-") for path in folder.glob(f"agent-*/{KEYED}")}
    agents = sorted(known | set(robots))
    created, existing = [], []
    for name in (
        access_control.ROUTER_NAME,
        access_control.WORLD_NAME,
        access_control.VIEWER,
        *(access_control.agent(robot) for robot in agents),
    ):
        own = folder / name
        if own.exists():
            for file in ("cert.pem", "key.pem", "ca.pem"):
                if not (own / file).is_file():
                    raise UserError(f"{own} has no {file}; remove the folder, and it is created again")
            if files.read_bytes(own / "ca.pem") != files.read_bytes(folder / "ca.pem"):
                raise UserError(f"{own} is of another authority than {folder / 'ca.pem'}")
            existing.append(name)
        else:
            _participant(own, name, authority, hosts, days)
            created.append(name)
        files.write(own / KEYED, configuration(name, agents))
    return created, existing


def configuration(name: str, robots: Sequence[str]) -> str:
    """Return the Zenoh configuration of a participant, which is in the same folder as its files."""
    settings = {
        "metadata": {"participant": name},
        "transport": {
            "link": {
                "tls": {
                    "root_ca_certificate": "ca.pem",
                    "enable_mtls": True,
                    "listen_certificate": "cert.pem",
                    "listen_private_key": "key.pem",
                    "connect_certificate": "cert.pem",
                    "connect_private_key": "key.pem",
                    "verify_name_on_connect": True,
                }
            }
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "access_control": access_control.access_control(robots),
    }
    return f"// Written by `tandem keys`, and overwritten each time.\n{json.dumps(settings, indent=1)}\n"


def _authority(folder: Path) -> Authority:
    """Return the authority of `folder`; create it if the folder is empty. Raises UserError."""
    certificate, key = folder / "ca.pem", folder / "ca-key.pem"
    if certificate.exists() and key.exists():
        try:
            private = load_pem_private_key(files.read_bytes(key), None)
            found = x509.load_pem_x509_certificate(files.read_bytes(certificate))
        except (TypeError, ValueError) as error:
            raise UserError(f"{folder}: its authority cannot be read: {error}") from None
        if not isinstance(private, ec.EllipticCurvePrivateKey) or private.public_key() != found.public_key():
            raise UserError(f"{key} is not the key of {certificate}")
        return Authority(found, private)
    if any(path.name != GITIGNORE and path.suffix != files.DRAFT for path in folder.iterdir()):
        raise UserError(f"{folder} is not empty and has no ca.pem with ca-key.pem; choose another folder")
    private = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"Tandem {x509.random_serial_number() % 16**8:08x}")
    now = datetime.now(UTC)
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(private.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now + timedelta(days=AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(private.public_key()), critical=False)
        .sign(private, hashes.SHA256())
    )
    with files.draft(key, SECRET) as one, files.draft(certificate) as other:  # both files or none
        one.write_bytes(_pem(private))
        other.write_bytes(signed.public_bytes(Encoding.PEM))
    return Authority(signed, private)


def _participant(own: Path, name: str, authority: Authority, hosts: Sequence[str], days: int) -> None:
    """Create the folder `own` with the key and certificates of a participant, completely or not at all."""
    private = ec.generate_private_key(ec.SECP256R1())
    names = (*CERTIFIED_HOSTS, *hosts) if name in access_control.CARRIERS else CERTIFIED_HOSTS
    issued = issue(authority, name, private.public_key(), names, timedelta(days=days))
    draft = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=own.parent))
    try:
        files.write(draft / "key.pem", _pem(private), SECRET)
        (draft / "cert.pem").write_bytes(issued.public_bytes(Encoding.PEM))
        (draft / "ca.pem").write_bytes(authority.certificate.public_bytes(Encoding.PEM))
        draft.rename(own)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def issue(
    authority: Authority, name: str, public: ec.EllipticCurvePublicKey, hosts: Sequence[str], lasts: timedelta
) -> x509.Certificate:
    """Return a certificate of `name` for connecting and for listening at `hosts`, valid for `lasts`."""
    now = datetime.now(UTC)
    key_id = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(authority.certificate.subject)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, now + lasts) - SKEW)
        .not_valid_after(now + lasts)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(
            x509.SubjectAlternativeName([_host(host) for host in dict.fromkeys(hosts)]), critical=False
        )
        .add_extension(key_id, critical=False)
        .sign(authority.key, hashes.SHA256())
    )


def is_host(text: str) -> bool:
    """Return whether `text` is an IP address, or a host name of letters, digits, - and dots."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return len(text) <= 253 and all(
            re.fullmatch(r"(?!-)[A-Za-z0-9-]{1,63}(?<!-)", part) for part in text.split(".")
        )
    return True


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
