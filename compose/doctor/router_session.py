"""A client session for commands that inspect a network."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from protocol.network import diagnosis, session
from protocol.network.endpoints import Endpoints

ROUTER_TIMEOUT_S = 3.0
"""Time in s after which no new attempt to connect is made."""


class Unreached(OSError):
    """No router was reached at these endpoints; the text says what to check."""


@contextmanager
def linked(endpoints: Endpoints) -> Iterator[zenoh.Session]:
    """Yield a client session. Raises Unreached."""
    give_up = time.monotonic() + ROUTER_TIMEOUT_S

    def unanswered() -> None:
        if time.monotonic() >= give_up:
            raise Unreached(f"no router at {endpoints}: {diagnosis.why(endpoints)}")

    with session.open_client(endpoints, unanswered) as link:
        yield link
