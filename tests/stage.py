"""A simulated environment for the bridge of hardware mode.

Time passes only while the bridge waits, and the test answers the frames that it sends.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from protocol.network import keys
from protocol.network.clock import Clock
from protocol.network.inbox import NO_ARRIVAL, Arrival, Inbox, Topic
from world.hardware import bridge

TRANSPORT_S = 1e-4
"""The simulated transport time of a frame, in s."""


class Stage(Inbox):
    """The clock, network and inbox of a bridge, in one thread and independent of the speed of the machine."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        super().__init__("field", Clock(true=self.monotonic))
        self.put_frames: list[tuple[str, bytes]] = []
        """keys and frames that the bridge has sent"""
        self.answer: Callable[[str, bytes], None] = lambda _key, _frame: None
        self._coming: list[tuple[float, int, Arrival]] = []
        monkeypatch.setattr(
            bridge,
            "session",
            SimpleNamespace(
                publisher=lambda _link, key: SimpleNamespace(put=lambda frame: self._on_put(key, frame)),
                subscribe=lambda *_: None,
                watch_liveliness=lambda *_: None,
                answer=lambda *_: None,
                show_alive=lambda *_: None,
            ),
        )

    def monotonic(self) -> float:
        """Return the simulated time in s."""
        return self.now

    def alive(self, *robots: str) -> None:
        """Report the agents of these robots as alive."""
        for robot in robots:
            self.comes("alive", keys.robot_alive("r", robot))

    def comes(self, topic: Topic, key: str, frame: bytes = b"", after: float = TRANSPORT_S) -> None:
        """Schedule an arrival `after` seconds from now."""
        heapq.heappush(
            self._coming,
            (
                self.now + after,
                len(self._coming),
                Arrival(topic, key, frame, keys.parse(key) or keys.UNKNOWN_KEY),
            ),
        )

    def next(self, timeout: float | None) -> Arrival:
        """Return the next arrival at its time; NO_ARRIVAL if there is none within `timeout` seconds."""
        assert timeout is not None
        until = self.now + max(timeout, 0.0)
        if self._coming and self._coming[0][0] <= until:
            when, _, arrival = heapq.heappop(self._coming)
            self.now = max(self.now, when)
            return arrival
        self.now = until
        return NO_ARRIVAL

    def _on_put(self, key: str, frame: bytes) -> None:
        self.put_frames.append((key, frame))
        self.answer(key, frame)
