"""How an agent hears and is heard: over one Zenoh session after the other, each as if it were the first."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import zenoh

from protocol.messages import RobotConfig
from protocol.network import keys, session
from protocol.network.inbox import NOTHING, Arrival, Inbox

SILENCE_S = 3.0
"""a link over which the world has said nothing for so long is replaced, though Zenoh gives one up after
`session.LEASE_S` and connects again: now and then nothing comes over such a link, for good"""


class WorldLinkLost(Exception):
    """Nothing comes over this link any more; over another the world may be there."""


class AgentLink:
    """One robot's in one run. Nothing is heard or said before a session is attached."""

    def __init__(self, config: RobotConfig, run: str, inbox: Inbox) -> None:
        self._id = config.robot
        self._peer = config.peer
        self._run = run
        self._inbox = inbox
        self._silence = SILENCE_S + (config.tick_s or 0.0)
        self.estimate_wanted = False
        """whether anybody listens to estimates"""

    def attach(self, link: zenoh.Session) -> None:
        """From now on, this is the session over which it hears and is heard."""
        me, peer, run = self._id, self._peer, self._run
        self._command = session.publisher(link, keys.command(run, me))
        self._report = session.publisher(link, keys.report(run, me, peer))
        self._estimate = session.publisher(link, keys.estimate(run, me))
        session.on_matching(self._estimate, self._want_estimate)
        session.subscribe(link, keys.observation(run, me), self._inbox, "observation")
        session.subscribe(link, keys.report(run, peer, me), self._inbox, "report")
        session.watch_liveliness(link, keys.world_alive(run), self._inbox)
        self._show_alive = partial(session.show_alive, link, keys.robot_alive(run, me))
        self._token = self._show_alive()
        self._heard_at = time.monotonic()

    def next(self, until: float) -> Arrival:
        """What arrives next, NOTHING after `until`, by the clock. Raises LinkLost after long silence."""
        lost = self._heard_at + self._silence
        arrival = self._inbox.next(min(until, lost) - time.monotonic())
        if arrival.topic == "observation":
            self._heard_at = time.monotonic()
        elif arrival is NOTHING and time.monotonic() >= lost:
            raise WorldLinkLost
        return arrival

    def appear(self) -> None:
        """Go and come, as the world sees it."""
        gone: Any = self._token  # its method is not typed
        gone.undeclare()
        self._token = self._show_alive()

    def command(self, frame: bytes) -> None:
        """Say a Command, or a FinalReport, to the world."""
        self._command.put(frame)

    def report(self, frame: bytes) -> None:
        """Say a Report to the peer."""
        self._report.put(frame)

    def estimate(self, frame: bytes) -> None:
        """Say an Estimate to whoever listens."""
        self._estimate.put(frame)

    def _want_estimate(self, wanted: bool) -> None:
        self.estimate_wanted = wanted
