"""How a process reaches the network: where it connects, where it listens, and by which Zenoh configuration.

Who listens is a router, who does not is a client; routers that are linked pass on what is said at any of
them. What Tandem needs is laid over a configuration of the user's own.
"""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from protocol.files import open_file, read_text

CONNECT_TIMEOUT_S = 1.0
"""one attempt; a client makes as many as fit its patience"""
RETRY_MS = 50
"""a link that was lost is tried again as often, and then less and less"""
LEASE_S = 2.0
"""a link on which nothing has come for so long is given up, and made anew: its peer is stopped, or cut off"""

_ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/(?P<host>\[[0-9A-Fa-f:.%\w]+\]|[^\s/:\[\]]+):(?P<port>\d{1,5})")
_FILES = (
    *(
        f"transport/link/tls/{name}"
        for name in (
            "root_ca_certificate",
            "listen_private_key",
            "listen_certificate",
            "connect_private_key",
            "connect_certificate",
        )
    ),
    "transport/auth/usrpwd/dictionary_file",
)
"""what in a configuration names a file; a relative name starts at the configuration's folder"""


class BadEndpoint(ValueError):
    """An endpoint that Zenoh could not use; its text says what one looks like."""


class BadConfiguration(ValueError):
    """A Zenoh configuration that cannot be used; its text names the file, and what is wrong with it."""


class Endpoints(msgspec.Struct, frozen=True):
    """How a process reaches the network."""

    connect: tuple[str, ...] = ()
    """routers: a client is linked to one of them, a router to all"""
    listen: tuple[str, ...] = ()
    """where it is a router itself; a client listens nowhere"""
    settings: str = "{}"
    """a Zenoh configuration, in JSON5"""
    folder: str = ""
    """where relative names of files in the configuration start"""

    @property
    def mode(self) -> str:
        """What it is in Zenoh's words."""
        return "router" if self.listen else "client"

    @property
    def participant(self) -> str | None:
        """Whose configuration it is, if `tandem keys` made it."""
        about = self.setting("metadata")
        return about.get("participant") if isinstance(about, dict) else None

    @property
    def secured(self) -> bool:
        """Whether all links are encrypted, and nobody is let in without a certificate."""
        encrypted = all(is_encrypted(one) for one in (*self.connect, *self.listen))
        return encrypted and self.setting("transport/link/tls/enable_mtls") is True

    @property
    def exposed(self) -> tuple[str, ...]:
        """Where it lets in whoever comes, from beyond this machine."""
        return () if self.secured else tuple(one for one in self.listen if not is_loopback(one))

    def setting(self, path: str) -> Any:
        """What the configuration says at `path`, such as "transport/link/tls"; Zenoh's default if nothing."""
        return json.loads(zenoh.Config.from_json5(self.settings).get_json(path))

    def file(self, path: str) -> Path | None:
        """The file that the configuration names at `path`."""
        name = self.setting(path)
        return Path(self.folder, name).resolve() if name is not None else None

    def __str__(self) -> str:
        return " or ".join(self.connect or self.listen)


def at(*connect: str) -> Endpoints:
    """Those of a client of these routers."""
    return Endpoints(connect=connect)


def listening(*listen: str) -> Endpoints:
    """Those of a router that listens there."""
    return Endpoints(listen=listen)


def check_endpoint(endpoint: str) -> None:
    """Raises BadEndpoint if `endpoint` is not of the form protocol/host:port."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise BadEndpoint(f"'{endpoint}' is no endpoint; one looks like tcp/127.0.0.1:7447")


def place(endpoint: str) -> tuple[str, int] | None:
    """Host and port; none if it has no such thing."""
    match = _ENDPOINT.match(endpoint)
    return (match["host"].strip("[]"), int(match["port"])) if match is not None else None


def is_loopback(endpoint: str) -> bool:
    """Whether only this machine reaches it."""
    where = place(endpoint)
    if where is None or where[0] == "localhost":
        return where is not None or endpoint.startswith("unix")
    try:
        return ipaddress.ip_address(where[0].partition("%")[0]).is_loopback
    except ValueError:
        return False


def is_encrypted(endpoint: str) -> bool:
    """Whether it is of a protocol that takes certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def configured(file: Path, connect: Sequence[str] = (), listen: Sequence[str] = ()) -> Endpoints:
    """By the Zenoh configuration in `file`; where no endpoints are given, by those in it.

    Raises BadConfiguration.
    """
    settings = _read(file)
    written = Endpoints(settings=settings, folder=str(file.parent))
    mode = written.setting("mode")
    if not connect and not listen:
        connect = _said(written.setting("connect/endpoints"), mode or "client")
        if (said := written.setting("listen/endpoints")) != Endpoints().setting("listen/endpoints"):
            listen = _said(said, mode or "router")
    endpoints = Endpoints(tuple(connect), tuple(listen), settings, written.folder)
    if mode is not None and (connect or listen) and mode != endpoints.mode:
        does = "listens" if listen else "only connects"
        raise BadConfiguration(
            f"{file}: mode: '{mode}', but who {does} is a {endpoints.mode} here; leave it out"
        )
    for name in _FILES:
        if (path := endpoints.file(name)) is not None:
            try:
                open_file(path).close()
            except OSError as error:
                raise BadConfiguration(f"{file}: {name}: {path}: {error.strerror or error}") from None
    return endpoints


def zenoh_config(endpoints: Endpoints, first: int = 0) -> zenoh.Config:
    """What Tandem needs, over what the endpoints' own configuration says; tries router `first` first."""
    config = zenoh.Config.from_json5(endpoints.settings)
    for name in _FILES:
        if (path := endpoints.file(name)) is not None:
            config.insert_json5(name, json.dumps(str(path)))
    client = endpoints.mode == "client"
    if client and endpoints.participant is not None:  # there is nobody but the router, which may say anything
        config.insert_json5("access_control/enabled", "false")
    turn = first % len(endpoints.connect) if endpoints.connect else 0
    for key, value in {
        "mode": endpoints.mode,
        "listen/endpoints": endpoints.listen,
        "connect/endpoints": endpoints.connect[turn:] + endpoints.connect[:turn],
        "connect/timeout_ms": int(CONNECT_TIMEOUT_S * 1000),
        "connect/exit_on_failure": client,  # a router is there for others, too
        "connect/retry": {"period_init_ms": RETRY_MS, "period_max_ms": 1000, "period_increase_factor": 2.0},
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tls/close_link_on_expiration": False,  # it panics where a low-latency link closes
        "transport/link/tx/lease": int(LEASE_S * 1000),
        "transport/unicast/lowlatency": True,
        "transport/unicast/qos/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _said(endpoints: Any, mode: str) -> tuple[str, ...]:
    """A list of endpoints, which a configuration may have for each mode."""
    return tuple(endpoints.get(mode, ()) if isinstance(endpoints, dict) else endpoints)


def _read(file: Path) -> str:
    """The text of a configuration that Zenoh understands. Raises BadConfiguration."""
    try:
        text = read_text(file)
        zenoh.Config.from_json5(text)
    except OSError as error:
        raise BadConfiguration(f"{file}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise BadConfiguration(f"{file}: is not UTF-8") from None
    except zenoh.ZError as error:
        raise BadConfiguration(f"{file}: {_what(str(error))}") from None
    return text


def _what(complaint: str) -> str:
    """Zenoh's complaint about a configuration, without the place in its own source."""
    said = re.search(r"--> (?P<line>\d+):.*= (?P<what>[^\n]*)", complaint, re.DOTALL)
    if said is None:
        return complaint.partition(" at /")[0]
    return f"line {said['line']}: {said['what'].partition(' at /')[0]}"
