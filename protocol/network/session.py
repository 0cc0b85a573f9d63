"""Zenoh sessions that open, become ready and close without hanging.

By default, the world is the router and robots are its clients, so no separate router is needed. Other routers
may be in between (protocol/network/endpoints.py). All arrivals go into one queue per process, because a queue
has a timeout and Zenoh's `recv()` has none. A process first declares its subscribers, and then its liveliness
token: a message that is sent before the subscriber is known would be lost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from itertools import count
from typing import Any, TypeVar

import zenoh

from protocol import limits
from protocol.messages import Message
from protocol.network import keys
from protocol.network.endpoints import Endpoints, zenoh_config
from protocol.network.inbox import COMPLAINT, NO_ARRIVAL, Arrival, Inbox, Line, LineClosed, Topic
from protocol.network.keys import Key
from protocol.network.watchdog import CALL, OPENING
from protocol.wire import encode

CLOSE_TIMEOUT_S = 2.0
"""The time in s to wait for a session to close. Under loss it can take ten seconds."""
LINK_CHECK_S = 1.0
"""The time in s between two checks whether a session that receives can also send."""
ASK_AGAIN_S = 0.05
"""The time in s between two attempts to reach a router, or to find a world."""
LISTEN_AGAIN_S = 0.1
"""The time in s between two attempts to listen on a port."""

LINE_FRAMES = 1 << 10
"""The number of messages that a Line stores; the next one replaces the oldest. A frame has at most 64 kB."""
WAKE = b"wake"
"""The attachment of the message that ends a wait. From another process, it has no effect."""
NO_KEY = "not a key of one mission and robot"
"""The reason for refusing a message on a wildcard or an unknown key."""

MSGPACK = zenoh.Encoding("application/msgpack")
"""The encoding of frames."""
REFUSAL = zenoh.Encoding.TEXT_PLAIN
"""The encoding of an answer that is the reason for a refusal."""

zenoh.init_log_from_env_or("off")

_left_open: list[zenoh.Session] = []
"""The sessions that last until the process ends; Zenoh closes those that are freed."""


T = TypeVar("T")


class CannotListen(OSError):
    """A process cannot listen on an endpoint. The text of the error names it and the reason."""


@contextmanager
def _closing(session: zenoh.Session) -> Iterator[zenoh.Session]:
    """Yield `session`, and close it at the end. Give up after CLOSE_TIMEOUT_S."""
    try:
        yield session
    finally:
        closer = threading.Thread(target=session.close, daemon=True)
        closer.start()
        closer.join(CLOSE_TIMEOUT_S)


def _check_limits() -> None:
    """Raise OSError if the process's limits do not allow a session."""
    limits.need_files(limits.SESSION_FILES, "a Zenoh session")
    limits.need_memory(limits.SESSION_BYTES, "a Zenoh session")


@contextmanager
def open_router(endpoints: Endpoints, wait: float = 0.0, *, closes: bool = True) -> Iterator[zenoh.Session]:
    """Yield a session in router mode. Wait up to `wait` s until its endpoints are free.

    The routers to which it connects may start later, and restart. If it `closes` while they do, Zenoh 1.10
    may panic, and print a stack trace. If not, it lasts until the process ends, which should be soon.

    Raises CannotListen, and OSError if the process's limits are too low.
    """
    _check_limits()
    for left in range(round(wait / LISTEN_AGAIN_S), -1, -1):
        try:
            with OPENING:
                session = zenoh.open(zenoh_config(endpoints))
            break
        except zenoh.ZError as error:
            taken = "in use" in str(error)
            if not (taken and left):
                why = "already in use" if taken else "cannot listen there"
                raise CannotListen(f"{' and '.join(endpoints.listen)}: {why}") from None
        time.sleep(LISTEN_AGAIN_S)
    if closes:
        with _closing(session):
            yield session
    else:
        _left_open.append(session)
        yield session


@contextmanager
def open_client(endpoints: Endpoints, unanswered: Callable[[], None]) -> Iterator[zenoh.Session]:
    """Yield a session in client mode that is connected to a router.

    `unanswered` is called after each unsuccessful attempt of CONNECT_TIMEOUT_S. It may raise an error to give
    up. Raises OSError if the process's limits are too low.
    """
    _check_limits()
    for attempt in count():
        try:
            with OPENING:
                session = zenoh.open(zenoh_config(endpoints, first=attempt))
            break
        except zenoh.ZError:
            unanswered()
    with _closing(session):
        yield session


def open_session(
    endpoints: Endpoints, unanswered: Callable[[], None], wait: float = 0.0
) -> AbstractContextManager[zenoh.Session]:
    """Return `open_router` if `endpoints` listens, and `open_client` otherwise. Raises CannotListen."""
    return open_router(endpoints, wait) if endpoints.listen else open_client(endpoints, unanswered)


def subscribe(session: zenoh.Session, key: str, inbox: Inbox, topic: Topic) -> None:
    """Put all messages on `key` into `inbox`. Zenoh hands each of them to a thread of the subscriber."""
    with CALL:
        session.declare_subscriber(key, lambda sample: deliver(sample, inbox, topic))


def _at_once(hand_over: Callable[[T], None]) -> zenoh.handlers.Callback[T]:
    """Return a callback that runs on the receiving thread. It must be short, and must not wait for Zenoh.

    By default, Zenoh hands each message to a separate thread of the subscriber. That is faster for many
    messages, because the receiving thread enters and leaves the interpreter for each of them.
    """
    return zenoh.handlers.Callback(hand_over, indirect=False)


def deliver(sample: zenoh.Sample, inbox: Inbox, topic: Topic) -> None:
    """Put the message into `inbox`, which refuses it if it is a deletion, or on a wildcard or unknown key."""
    arrival = _arrival(sample, inbox, topic)
    if arrival is not None:
        inbox.put(*arrival)


def _arrival(sample: zenoh.Sample, inbox: Inbox, topic: Topic) -> Arrival | None:
    """Return the message, or None if `inbox` refuses it: a deletion, or on a wildcard or unknown key.

    A liveliness token that disappears, of the topic "gone", is a deletion for Zenoh.
    """
    key = str(sample.key_expr)
    source = keys.parse(key)
    if source is None:
        inbox.turn_away(topic, key, NO_KEY)
    elif sample.kind == zenoh.SampleKind.DELETE and topic != "gone":
        inbox.turn_away(topic, key, "a deletion")
    else:
        return Arrival(topic, key, sample.payload.to_bytes(), source)
    return None


def subscribe_directly(session: zenoh.Session, key: str, inbox: Inbox, topic: Topic) -> None:
    """Let `inbox` take all messages on `key` from Zenoh itself, without a callback (see `inbox.Line`)."""
    inbox.take_from(_Subscription(session, key, inbox, topic))


class _Subscription(Line):
    """A subscription to `key`, with room for the latest LINE_FRAMES messages.

    Zenoh's channels have no timeout, but one wakes for every message. `wake` therefore sends one that only
    this session receives.
    """

    def __init__(self, session: zenoh.Session, key: str, inbox: Inbox, topic: Topic) -> None:
        self._session = session
        self._key = key
        self._inbox = inbox
        self._topic: Topic = topic
        with CALL:
            self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(LINE_FRAMES))

    def receive(self, *, wait: bool) -> Arrival | None:
        try:
            with CALL:
                sample = self._subscriber.recv() if wait else self._subscriber.try_recv()
        except zenoh.ZError:
            raise LineClosed from None
        if sample is None or (sample.attachment is not None and sample.attachment.to_bytes() == WAKE):
            return None
        return _arrival(sample, self._inbox, self._topic)

    def wake(self) -> None:
        with suppress(zenoh.ZError):  # the session is closed
            self._session.put(
                self._key, b"", attachment=WAKE, allowed_destination=zenoh.Locality.SESSION_LOCAL
            )


def watch_liveliness(session: zenoh.Session, key: str, inbox: Inbox) -> None:
    """Put "alive" or "gone" into `inbox` for each token on `key`, including those that exist already."""

    def hand_over(sample: zenoh.Sample) -> None:
        deliver(sample, inbox, "alive" if sample.kind == zenoh.SampleKind.PUT else "gone")

    with CALL:
        session.liveliness().declare_subscriber(key, _at_once(hand_over), history=True)


def alive(session: zenoh.Session, key: str, timeout: float) -> list[Key]:
    """Return the keys of the current liveliness tokens on `key`, within `timeout` s."""
    with CALL:
        replies = session.liveliness().get(key, timeout=timeout)
        shown = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
    return [source for one in sorted(shown) if (source := keys.parse(one)) is not None]


def linked(session: zenoh.Session) -> bool:
    """Return whether the session has a link to a router."""
    with CALL:
        return bool(session.info.routers_zid())


class LinkLost(Exception):
    """Nothing passes over a session in one direction; the other side may be reachable over a new one."""


SILENCE_S = 3.0
"""The time in s without a message after which a session is replaced.

Zenoh itself drops a link after LEASE_S and reconnects, but occasionally nothing ever arrives over the
reconnected link.
"""


class LinkCheck:
    """Checks of a session: it may have lost the ability to receive, or to send.

    A process that is stopped until Zenoh gives up its link connects again when it continues. Occasionally
    (in about one of a hundred such reconnections on a busy machine), its session then receives everything
    and sends nothing: its publishers match, its tokens are visible, but it lists no router.
    """

    def __init__(self, session: zenoh.Session, inbox: Inbox, tick_s: float, *topics: Topic) -> None:
        """Check `session`, whose messages are put into `inbox`.

        While nothing of the `topics`, or of any without them, arrives for SILENCE_S and a tick, it is lost.
        Whether it can send is not checked if it has no router from the start because it is one.
        """
        self._session, self._inbox, self._topics = session, inbox, topics
        self._silence = SILENCE_S + tick_s
        self._received_at = inbox.awake()
        self._failed = 0 if linked(session) else None
        """The number of failed checks in sequence; None if the session is not checked."""
        self._check_at = inbox.clock() + LINK_CHECK_S

    def next(self, timeout: float) -> Arrival:
        """Return the next arrival, or NO_ARRIVAL after `timeout` s.

        Raises LinkLost if there has been no message for too long, or if the session cannot send.
        """
        lost = self._received_at + self._silence
        arrival = self._inbox.next(min(timeout, lost - self._inbox.awake()))
        if arrival is NO_ARRIVAL:
            if self._inbox.awake() >= lost:
                raise LinkLost
        elif not self._topics or arrival.topic in self._topics:
            self._received_at = self._inbox.awake()
            if self._is_mute(self._inbox.clock()):
                raise LinkLost
        return arrival

    def _is_mute(self, now: float) -> bool:
        """Return whether the session cannot send, given that it has received a message at time `now`.

        A link that is just being replaced fails one check at most.
        """
        if now < self._check_at or self._failed is None:
            return False
        self._check_at = now + LINK_CHECK_S
        self._failed = 0 if linked(self._session) else self._failed + 1
        return self._failed > 1


def ask(
    session: zenoh.Session,
    key: str,
    timeout: float,
    is_understood: Callable[[bytes], bool] = lambda _: True,
    process: bytes | None = None,
) -> bytes | str | None:
    """Return the answer to a query on `key`, or None if there is none within `timeout` s.

    `process` identifies the process that asks, if that matters. Any participant may answer. A frame that
    `is_understood` is preferred to the text of a refusal, and that to any other frame.
    """
    refusal: str | None = None
    strange: bytes | None = None
    everyone, everything = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
    with CALL:
        replies = session.get(
            key, timeout=timeout, payload=process, target=everyone, consolidation=everything
        )
        for reply in replies:
            if reply.ok is not None and str(reply.ok.key_expr) == key:
                frame = reply.ok.payload.to_bytes()
                if is_understood(frame):
                    return frame
                strange = strange or frame
            elif (
                reply.err is not None and reply.err.encoding == REFUSAL
            ):  # Zenoh's own errors, such as a timeout, have another encoding
                refusal = refusal or reply.err.payload.to_bytes()[:COMPLAINT].decode(errors="replace")
    return refusal if refusal is not None else strange


def occupied(robot: str, run: str) -> str:
    """Return the text of the refusal of a second process for `robot`."""
    return f"robot '{robot}' is in run '{run}' already: another process is {robot}"


def answer(session: zenoh.Session, key: str, reply: Callable[[str, bytes], Message | str]) -> None:
    """Answer queries on `key` with `reply`, which returns a message, or the text of a refusal.

    It gets the robot, and the identifier of the process that asks, which is empty if it has given none.
    """

    def hand_over(query: zenoh.Query) -> None:
        asked = keys.parse(str(query.key_expr))
        answered: Message | str = NO_KEY
        if asked is not None:
            process = query.payload.to_bytes() if query.payload is not None else b""
            answered = reply(asked.robot, process)
        if isinstance(answered, str):
            query.reply_err(answered, encoding=REFUSAL)
        else:
            query.reply(query.key_expr, encode(answered), encoding=MSGPACK)

    with CALL:
        session.declare_queryable(key, hand_over)


def show_alive(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    """Declare a liveliness token on `key`, which lasts as long as the session. Declare subscribers before."""
    with CALL:
        return session.liveliness().declare_token(key)


class Publisher:
    """A publisher of frames on one key. It neither batches nor drops messages."""

    def __init__(self, declared: zenoh.Publisher) -> None:
        self.declared = declared

    def put(self, frame: bytes, **options: Any) -> None:
        """Send a frame, with the `options` of Zenoh."""
        with CALL:
            self.declared.put(frame, **options)


def publisher(session: zenoh.Session, key: str) -> Publisher:
    """Return a publisher of frames on `key`."""
    with CALL:
        declared = session.declare_publisher(
            key,
            encoding=MSGPACK,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
    return Publisher(declared)


def on_matching(publisher: Publisher, tell: Callable[[bool], None]) -> None:
    """Call `tell`, now and on every change, with whether `publisher` has a subscriber."""
    handler: zenoh.handlers.Callback[zenoh.MatchingStatus] = _at_once(lambda status: tell(status.matching))
    with CALL:
        publisher.declared.declare_matching_listener(handler)
        status: Any = publisher.declared.matching_status  # its declared type, bool, is wrong
    tell(status.matching)
