"""Zenoh sessions that open, become ready and close without hanging.

The world is the router and robots are its clients, over TCP, so nothing else has to be installed. What
arrives goes into one queue per process: `recv()` of Zenoh has no time-out, and a queue has. Whoever
subscribes first declares, then shows its liveliness token: a put before the match would be lost.
"""

from __future__ import annotations

import json
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import zenoh

from protocol.inbox import Inbox, Topic
from protocol.messages import Message
from protocol.wire import encode

CONNECT_TIMEOUT_S = 1.0
"""one attempt; `open_client` makes as many as fit its patience"""
CLOSE_TIMEOUT_S = 2.0
"""Zenoh's own close can take ten seconds under loss; the process ends without it"""
RETRY_MS = 50
"""a client looks for a world that went away as often"""
LEASE_S = 2.0
"""a link on which nothing has come for so long is given up, and made anew: its peer is stopped, or cut off"""
LISTEN_AGAIN_S = 0.1
"""how long to wait before trying once more to have a port"""

MSGPACK = zenoh.Encoding("application/msgpack")

_ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/(?P<host>\[[0-9A-Fa-f:.%\w]+\]|[^\s/:\[\]]+):(?P<port>\d{1,5})")

zenoh.init_log_from_env_or("off")


_left_open: list[zenoh.Session] = []
"""sessions that did not close in time"""


class BadEndpoint(ValueError):
    """An endpoint that Zenoh could not use; its text says what one looks like."""


class CannotListen(OSError):
    """The endpoint to listen on cannot be had; its text says why."""


def check_endpoint(endpoint: str) -> None:
    """Raises BadEndpoint if `endpoint` is not of the form protocol/host:port."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise BadEndpoint(f"'{endpoint}' is no endpoint; one looks like tcp/127.0.0.1:7447")


def _config(mode: str, listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": int(CONNECT_TIMEOUT_S * 1000),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": RETRY_MS, "period_max_ms": 1000, "period_increase_factor": 2.0},
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": int(LEASE_S * 1000),
        "transport/unicast/lowlatency": True,
        "transport/unicast/qos/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextmanager
def _closing(session: zenoh.Session) -> Iterator[zenoh.Session]:
    """A session that is closed at the end, or left behind after CLOSE_TIMEOUT_S."""
    try:
        yield session
    finally:
        closer = threading.Thread(target=session.close, daemon=True)
        closer.start()
        closer.join(CLOSE_TIMEOUT_S)
        if closer.is_alive():
            _left_open.append(session)


@contextmanager
def open_router(listen: str, wait: float = 0.0, connect: Sequence[str] = ()) -> Iterator[zenoh.Session]:
    """The world's session, listening on `listen`; waits `wait` seconds for it to be free.

    A router between it and its robots is one that also connects to it.

    Raises BadEndpoint or CannotListen.
    """
    check_endpoint(listen)
    give_up = time.monotonic() + wait
    while True:
        try:
            session = zenoh.open(_config("router", [listen], connect))
            break
        except zenoh.ZError as error:
            taken = "in use" in str(error)
            if not taken or time.monotonic() >= give_up:
                why = "already in use" if taken else "cannot listen there"
                raise CannotListen(f"{listen}: {why}") from None
        time.sleep(LISTEN_AGAIN_S)
    with _closing(session):
        yield session


@contextmanager
def open_client(connect: str, unanswered: Callable[[], None]) -> Iterator[zenoh.Session]:
    """A robot's session to the router at `connect`.

    Calls `unanswered` after each attempt of CONNECT_TIMEOUT_S in vain; it may raise to give up. Raises
    BadEndpoint.
    """
    check_endpoint(connect)
    while True:
        config = _config("client", [], [connect])
        try:
            session = zenoh.open(config)
            break
        except zenoh.ZError:
            unanswered()
    with _closing(session):
        yield session


def subscribe(session: zenoh.Session, key: str, inbox: Inbox, topic: Topic) -> None:
    """Put into `inbox` everything that is put under `key`."""

    def hand_over(sample: zenoh.Sample) -> None:
        inbox.put(topic, str(sample.key_expr), sample.payload.to_bytes())

    session.declare_subscriber(key, hand_over)


def watch_liveliness(session: zenoh.Session, key: str, inbox: Inbox) -> None:
    """Put "alive" or "gone" into `inbox` for tokens under `key`, those already there included."""

    def hand_over(sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        inbox.put("alive" if alive else "gone", str(sample.key_expr))

    session.liveliness().declare_subscriber(key, hand_over, history=True)


def alive(session: zenoh.Session, key: str, timeout: float) -> list[str]:
    """The keys of the liveliness tokens under `key`, now; waits `timeout` seconds at the most."""
    replies = session.liveliness().get(key, timeout=timeout)
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


def ask(session: zenoh.Session, key: str, timeout: float) -> bytes | str | None:
    """What the queryable at `key` answers: a frame, or its refusal in words, or None if nobody is there."""
    for reply in session.get(key, timeout=timeout):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        if reply.err is not None:
            return reply.err.payload.to_string()
    return None


def answer(session: zenoh.Session, key: str, reply: Callable[[str], Message | str]) -> None:
    """Answer queries under `key` with what `reply` makes of the key asked for: a message, or a refusal."""

    def hand_over(query: zenoh.Query) -> None:
        said = reply(str(query.key_expr))
        if isinstance(said, str):
            query.reply_err(said)
        else:
            query.reply(query.key_expr, encode(said), encoding=MSGPACK)

    session.declare_queryable(key, hand_over)


def show_alive(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    """A token under `key`, for as long as this session lives. Declare whatever must be heard before it."""
    return session.liveliness().declare_token(key)


def on_matching(publisher: zenoh.Publisher, tell: Callable[[bool], None]) -> None:
    """Tell, now and on every change, whether anyone listens to `publisher`."""
    publisher.declare_matching_listener(lambda status: tell(status.matching))
    status: Any = publisher.matching_status  # declared as bool, which it is not
    tell(status.matching)


def publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """A publisher for the tick's path: nothing waits to be batched, nothing is dropped."""
    return session.declare_publisher(
        key,
        encoding=MSGPACK,
        congestion_control=zenoh.CongestionControl.BLOCK,
        express=True,
    )


def leave(status: int) -> NoReturn:
    """End the process. An unclosed session would hang the interpreter's exit, so it is not asked."""
    if _left_open:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)
