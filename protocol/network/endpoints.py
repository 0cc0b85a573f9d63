"""The network endpoints of a process, and its Zenoh configuration.

A process that listens is a router, and one that only connects is a client. Connected routers forward each
other's messages. Tandem's own settings override those in the user's Zenoh configuration.
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

from protocol import documents
from protocol.files import open_file, read_text

CONNECT_TIMEOUT_S = 1.0
"""The duration in s of one attempt to connect. A client repeats it until its connection timeout."""
RETRY_MS = 50
"""The time in ms before the first attempt to restore a lost link. It then increases."""
LEASE_S = 2.0
"""The time in s without any data after which a link is closed and restored."""

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
"""The settings that name a file. A relative name starts at the folder of the configuration."""


class BadEndpoint(ValueError):
    """An endpoint is malformed. The text of the error contains an example."""


class BadConfiguration(ValueError):
    """A Zenoh configuration cannot be used. The text of the error names the file and the reason."""


class Endpoints(msgspec.Struct, frozen=True):
    """The endpoints and the Zenoh configuration of a process."""

    connect: tuple[str, ...] = ()
    """The endpoints of routers. A client connects to one of them, a router to all."""
    listen: tuple[str, ...] = ()
    """The endpoints on which a router listens; empty for a client."""
    settings: str = "{}"
    """The user's Zenoh configuration, in JSON5."""
    folder: str = ""
    """The folder to which file names in the configuration are relative."""

    @property
    def mode(self) -> str:
        """The mode in Zenoh's terms: "router" or "client"."""
        return "router" if self.listen else "client"

    @property
    def participant(self) -> str | None:
        """The participant for which `tandem keys` made the configuration; None for other configurations."""
        about = self.setting("metadata")
        return about.get("participant") if isinstance(about, dict) else None

    @property
    def secured(self) -> bool:
        """True if all links are encrypted, and all participants need a certificate."""
        encrypted = all(is_encrypted(one) for one in (*self.connect, *self.listen))
        return encrypted and self.setting("transport/link/tls/enable_mtls") is True

    @property
    def exposed(self) -> tuple[str, ...]:
        """The endpoints that other machines can use without a certificate."""
        return () if self.secured else tuple(one for one in self.listen if not is_loopback(one))

    def setting(self, path: str) -> Any:
        """Return the setting at `path`, such as "transport/link/tls", or Zenoh's default."""
        return json.loads(zenoh.Config.from_json5(self.settings).get_json(path))

    def file(self, path: str) -> Path | None:
        """Return the path of the file that the setting at `path` names; None if it is not set."""
        name = self.setting(path)
        return Path(self.folder, name).resolve() if name is not None else None

    def __str__(self) -> str:
        return " or ".join(self.connect or self.listen)


def at(*connect: str) -> Endpoints:
    """Return the endpoints of a client of these routers."""
    return Endpoints(connect=connect)


def listening(*listen: str) -> Endpoints:
    """Return the endpoints of a router that listens there."""
    return Endpoints(listen=listen)


def check_endpoint(endpoint: str) -> None:
    """Raise BadEndpoint if `endpoint` is not of the form protocol/host:port."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise BadEndpoint(f"'{endpoint}' is not an endpoint; expected one such as tcp/127.0.0.1:7447")


def place(endpoint: str) -> tuple[str, int] | None:
    """Return the host and port of `endpoint`; None if it has none."""
    match = _ENDPOINT.match(endpoint)
    return (match["host"].strip("[]"), int(match["port"])) if match is not None else None


def is_loopback(endpoint: str) -> bool:
    """Return whether only this machine can reach `endpoint`."""
    where = place(endpoint)
    if where is None or where[0] == "localhost":
        return where is not None or endpoint.startswith("unix")
    try:
        return ipaddress.ip_address(where[0].partition("%")[0]).is_loopback
    except ValueError:
        return False


def is_encrypted(endpoint: str) -> bool:
    """Return whether the protocol of `endpoint` uses certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def configured(file: Path, connect: Sequence[str] = (), listen: Sequence[str] = ()) -> Endpoints:
    """Return the endpoints `connect` and `listen`, or those in `file` if both are empty, with its settings.

    Raises BadConfiguration.
    """
    settings = _read(file)
    written = Endpoints(settings=settings, folder=str(file.parent))
    mode = written.setting("mode")
    if not connect and not listen:
        connect = _for_mode(written.setting("connect/endpoints"), mode or "client")
        if (found := written.setting("listen/endpoints")) != Endpoints().setting("listen/endpoints"):
            listen = _for_mode(found, mode or "router")
    endpoints = Endpoints(tuple(connect), tuple(listen), settings, written.folder)
    if mode is not None and (connect or listen) and mode != endpoints.mode:
        does = "listens" if listen else "only connects"
        raise BadConfiguration(
            f"{file}: mode: '{mode}', but a process that {does} is a {endpoints.mode} here; leave it out"
        )
    for name in _FILES:
        if (path := endpoints.file(name)) is not None:
            try:
                open_file(path).close()
            except OSError as error:
                raise BadConfiguration(f"{file}: {name}: {path}: {error.strerror or error}") from None
    return endpoints


def zenoh_config(endpoints: Endpoints, first: int = 0) -> zenoh.Config:
    """Return the user's configuration with Tandem's settings. The router at index `first` is tried first."""
    config = zenoh.Config.from_json5(endpoints.settings)
    for name in _FILES:
        if (path := endpoints.file(name)) is not None:
            config.insert_json5(name, json.dumps(str(path)))
    client = endpoints.mode == "client"
    # A low-latency link writes while Zenoh holds the lock on its routes. The thread that finds out that a new
    # link to another router can be written waits for the same lock: the process hangs.
    low_latency = not (endpoints.listen and endpoints.connect)
    if client and endpoints.participant is not None:  # its only neighbour is the router, which may send all
        config.insert_json5("access_control/enabled", "false")
    turn = first % len(endpoints.connect) if endpoints.connect else 0
    for key, value in {
        "mode": endpoints.mode,
        "listen/endpoints": endpoints.listen,
        "connect/endpoints": endpoints.connect[turn:] + endpoints.connect[:turn],
        "connect/timeout_ms": int(CONNECT_TIMEOUT_S * 1000),
        "connect/exit_on_failure": client,  # a router also serves others
        "connect/retry": {"period_init_ms": RETRY_MS, "period_max_ms": 1000, "period_increase_factor": 2.0},
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tls/close_link_on_expiration": False,  # with low latency, Zenoh panics
        "transport/link/tx/lease": int(LEASE_S * 1000),
        "transport/unicast/lowlatency": low_latency,
        "transport/unicast/qos/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _for_mode(endpoints: Any, mode: str) -> tuple[str, ...]:
    """Return the endpoints for `mode` of a setting that is one list, or one for each mode."""
    return tuple(endpoints.get(mode, ()) if isinstance(endpoints, dict) else endpoints)


def _read(file: Path) -> str:
    """Return the text of the Zenoh configuration in `file`. Raises BadConfiguration."""
    try:
        text = read_text(file, documents.MOST_DOCUMENT_BYTES)
        documents.check_nesting(text, "JSON5")
        zenoh.Config.from_json5(text)
    except OSError as error:
        raise BadConfiguration(f"{file}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise BadConfiguration(f"{file}: is not UTF-8") from None
    except documents.TooNested as error:
        raise BadConfiguration(f"{file}: {error}") from None
    except zenoh.ZError as error:
        raise BadConfiguration(f"{file}: {_what(str(error))}") from None
    return text


def _what(complaint: str) -> str:
    """Return Zenoh's error message about a configuration, without the position in Zenoh's source."""
    match = re.search(r"--> (?P<line>\d+):.*= (?P<what>[^\n]*)", complaint, re.DOTALL)
    if match is None:
        return complaint.partition(" at /")[0]
    return f"line {match['line']}: {match['what'].partition(' at /')[0]}"
