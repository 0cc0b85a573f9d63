"""Zenoh sessions that open, become ready and close without hanging.

The world is the router and robots are its clients, so nothing else has to be installed; other routers may
stand between (protocol/network/endpoints.py). What arrives goes into one queue per process: `recv()` of
Zenoh has no time-out, and a queue has. Whoever subscribes first declares, then shows its liveliness token: a put before
the match would be lost.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from itertools import count
from typing import Any, NoReturn, TypeVar

import zenoh

from protocol import limits
from protocol.messages import Message
from protocol.network import keys
from protocol.network.endpoints import Endpoints, zenoh_config
from protocol.network.inbox import COMPLAINT, Inbox, Topic
from protocol.network.keys import Key
from protocol.wire import encode

CLOSE_TIMEOUT_S = 2.0
"""Zenoh's own close can take ten seconds under loss; the process ends without it"""
LISTEN_AGAIN_S = 0.1
"""how long to wait before trying once more to have a port"""

NO_KEY = "not a key of one mission and robot"
"""why something that came under a wildcard, or under an unknown key, is refused"""

MSGPACK = zenoh.Encoding("application/msgpack")
REFUSAL = zenoh.Encoding.TEXT_PLAIN
"""of an answer that says why there is none"""

zenoh.init_log_from_env_or("off")


T = TypeVar("T")


class CannotListen(OSError):
    """The endpoint to listen on cannot be had; its text says why."""


@contextmanager
def _closing(session: zenoh.Session) -> Iterator[zenoh.Session]:
    """A session that is closed at the end, or left behind after CLOSE_TIMEOUT_S."""
    try:
        yield session
    finally:
        closer = threading.Thread(target=session.close, daemon=True)
        closer.start()
        closer.join(CLOSE_TIMEOUT_S)


def _check_limits() -> None:
    """Raises OSError where a session could not be opened, or would hang."""
    limits.need_files(limits.SESSION_FILES, "a Zenoh session")
    limits.need_memory(limits.SESSION_BYTES, "a Zenoh session")


@contextmanager
def open_router(endpoints: Endpoints, wait: float = 0.0) -> Iterator[zenoh.Session]:
    """The session of a router; waits `wait` seconds for where it listens to be free.

    Routers that it connects to may come later, and go. Raises CannotListen.
    """
    _check_limits()
    give_up = time.monotonic() + wait
    while True:
        try:
            session = zenoh.open(zenoh_config(endpoints))
            break
        except zenoh.ZError as error:
            taken = "in use" in str(error)
            if not taken or time.monotonic() >= give_up:
                why = "already in use" if taken else "cannot listen there"
                raise CannotListen(f"{' and '.join(endpoints.listen)}: {why}") from None
        time.sleep(LISTEN_AGAIN_S)
    with _closing(session):
        yield session


@contextmanager
def open_client(endpoints: Endpoints, unanswered: Callable[[], None]) -> Iterator[zenoh.Session]:
    """A session to a router that answers.

    Calls `unanswered` after each attempt of CONNECT_TIMEOUT_S in vain; it may raise to give up.
    """
    _check_limits()
    for attempt in count():
        try:
            session = zenoh.open(zenoh_config(endpoints, first=attempt))
            break
        except zenoh.ZError:
            unanswered()
    with _closing(session):
        yield session


def open_session(
    endpoints: Endpoints, unanswered: Callable[[], None], wait: float = 0.0
) -> AbstractContextManager[zenoh.Session]:
    """That of a router, or of a client, as `endpoints` say. Raises CannotListen, if it listens."""
    return open_router(endpoints, wait) if endpoints.listen else open_client(endpoints, unanswered)


def subscribe(session: zenoh.Session, key: str, inbox: Inbox, topic: Topic) -> None:
    """Put into `inbox` everything that is put under `key`."""
    handler: zenoh.handlers.Callback[zenoh.Sample] = _at_once(lambda sample: deliver(sample, inbox, topic))
    session.declare_subscriber(key, handler)


def _at_once(hand_over: Callable[[T], None]) -> zenoh.handlers.Callback[T]:
    """A callback that the thread which receives calls itself; it must be short, and never wait for Zenoh.

    Otherwise each subscriber has a thread of its own, to which every message is handed on.
    """
    return zenoh.handlers.Callback(hand_over, indirect=False)


def deliver(sample: zenoh.Sample, inbox: Inbox, topic: Topic) -> None:
    """Put what has come into `inbox`, or have it refused there: a wildcard, an unknown key, a deletion."""
    key = str(sample.key_expr)
    source = keys.parse(key)
    if source is None:
        inbox.turn_away(topic, key, NO_KEY)
    elif sample.kind == zenoh.SampleKind.DELETE:
        inbox.turn_away(topic, key, "a deletion")
    else:
        inbox.put(topic, key, sample.payload.to_bytes(), source)


def watch_liveliness(session: zenoh.Session, key: str, inbox: Inbox) -> None:
    """Put "alive" or "gone" into `inbox` for tokens under `key`, those already there included."""

    def hand_over(sample: zenoh.Sample) -> None:
        topic: Topic = "alive" if sample.kind == zenoh.SampleKind.PUT else "gone"
        shown = str(sample.key_expr)
        source = keys.parse(shown)
        if source is None:
            inbox.turn_away(topic, shown, NO_KEY)
        else:
            inbox.put(topic, shown, source=source)

    session.liveliness().declare_subscriber(key, _at_once(hand_over), history=True)


def alive(session: zenoh.Session, key: str, timeout: float) -> list[Key]:
    """The keys of the liveliness tokens under `key`, now; waits `timeout` seconds at the most."""
    replies = session.liveliness().get(key, timeout=timeout)
    shown = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
    return [source for one in sorted(shown) if (source := keys.parse(one)) is not None]


def linked(session: zenoh.Session) -> bool:
    """Whether there is a link to a router."""
    return bool(session.info.routers_zid())


def ask(
    session: zenoh.Session, key: str, timeout: float, is_understood: Callable[[bytes], bool] = lambda _: True
) -> bytes | str | None:
    """Return the answer at `key`: a frame that `is_understood`, else a refusal in words, else any frame.

    None if nobody answers. Strangers may answer, too: whoever is understood is preferred.
    """
    refusal: str | None = None
    strange: bytes | None = None
    everyone, everything = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
    for reply in session.get(key, timeout=timeout, target=everyone, consolidation=everything):
        if reply.ok is not None and str(reply.ok.key_expr) == key:
            frame = reply.ok.payload.to_bytes()
            if is_understood(frame):
                return frame
            strange = strange or frame
        elif (
            reply.err is not None and reply.err.encoding == REFUSAL
        ):  # Zenoh's own is that nobody answered in time
            refusal = refusal or reply.err.payload.to_bytes()[:COMPLAINT].decode(errors="replace")
    return refusal if refusal is not None else strange


def answer(session: zenoh.Session, key: str, reply: Callable[[str], Message | str]) -> None:
    """Answer queries under `key` with what `reply` makes of the robot asked for: a message, or a refusal."""

    def hand_over(query: zenoh.Query) -> None:
        asked = keys.parse(str(query.key_expr))
        said = reply(asked.robot) if asked is not None else NO_KEY
        if isinstance(said, str):
            query.reply_err(said, encoding=REFUSAL)
        else:
            query.reply(query.key_expr, encode(said), encoding=MSGPACK)

    session.declare_queryable(key, hand_over)


def show_alive(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    """A token under `key`, for as long as this session lives. Declare whatever must be heard before it."""
    return session.liveliness().declare_token(key)


def on_matching(publisher: zenoh.Publisher, tell: Callable[[bool], None]) -> None:
    """Tell, now and on every change, whether anyone listens to `publisher`."""
    handler: zenoh.handlers.Callback[zenoh.MatchingStatus] = _at_once(lambda status: tell(status.matching))
    publisher.declare_matching_listener(handler)
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
    """End the process, without the interpreter's own end.

    A session that did not close would hang it; and a thread of Zenoh's that is just then in a callback, as it
    may be for a moment after its session has closed, would abort the process.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # nobody reads it any more
            stream.flush()
    os._exit(status)
