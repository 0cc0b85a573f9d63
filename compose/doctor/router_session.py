"""A session for a command that looks at a network once."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from protocol.network import diagnosis, session
from protocol.network.endpoints import Endpoints

PATIENCE_S = 3.0
"""how long to try, beside the attempt that is being made then"""


class Unreached(OSError):
    """No router is reached at these endpoints; its text says what to check."""


@contextmanager
def linked(endpoints: Endpoints) -> Iterator[zenoh.Session]:
    """A client's session. Raises Unreached."""
    give_up = time.monotonic() + PATIENCE_S

    def unanswered() -> None:
        if time.monotonic() >= give_up:
            raise Unreached(f"no router at {endpoints}: {diagnosis.why(endpoints)}")

    with session.open_client(endpoints, unanswered) as link:
        yield link
