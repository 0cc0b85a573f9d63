"""The Zenoh link of an agent, which can be attached to one session after another."""

from __future__ import annotations

from functools import partial
from typing import Any

import zenoh

from protocol.messages import RobotConfig
from protocol.network import keys, session
from protocol.network.inbox import Arrival, Inbox
from protocol.network.watchdog import CALL


class AgentLink:
    """The link of one robot in one run. It needs an attached session to send or receive."""

    def __init__(self, config: RobotConfig, run: str, inbox: Inbox) -> None:
        self._id = config.robot
        self._senders = "*" if config.members or config.team is not None else config.peer
        """The robots whose Reports are received: the peer, or in a group or a team all robots."""
        self._run = run
        self._inbox = inbox
        self._tick_s = config.tick_s or 0.0
        self.estimate_wanted = False
        """True while any viewer subscribes to estimates."""

    def attach(self, link: zenoh.Session) -> None:
        """Use `link` to send and receive from now on."""
        me, run = self._id, self._run
        self._session = link
        self._command = session.publisher(link, keys.command(run, me))
        self._reports: dict[str, session.Publisher] = {}
        self._estimate = session.publisher(link, keys.estimate(run, me))
        session.on_matching(self._estimate, self._want_estimate)
        session.subscribe_directly(link, keys.observation(run, me), self._inbox, "observation")
        session.subscribe(link, keys.report(run, self._senders, me), self._inbox, "report")
        session.watch_liveliness(link, keys.world_alive(run), self._inbox)
        self._show_alive = partial(session.show_alive, link, keys.robot_alive(run, me))
        self._token = self._show_alive()
        self._check = session.LinkCheck(link, self._inbox, self._tick_s, "observation")

    def next(self, until: float) -> Arrival:
        """Return the next arrival, or NO_ARRIVAL once the clock reaches `until`.

        Raises LinkLost if no Observation has arrived for too long, or if the session cannot send.
        """
        return self._check.next(until - self._inbox.clock())

    def appear(self) -> None:
        """Withdraw the liveliness token and declare it again, so that the world sees the robot reappear."""
        gone: Any = self._token  # undeclare() is untyped
        with CALL:
            gone.undeclare()
        self._token = self._show_alive()

    def command(self, frame: bytes) -> None:
        """Send a Command or a FinalReport to the world."""
        self._command.put(frame)

    def report(self, peer: str, frame: bytes) -> None:
        """Send a Report to `peer`."""
        publisher = self._reports.get(peer)
        if publisher is None:
            key = keys.report(self._run, self._id, peer)
            publisher = self._reports[peer] = session.publisher(self._session, key)
        publisher.put(frame)

    def estimate(self, frame: bytes) -> None:
        """Send an Estimate to the viewers."""
        self._estimate.put(frame)

    def _want_estimate(self, wanted: bool) -> None:
        self.estimate_wanted = wanted
