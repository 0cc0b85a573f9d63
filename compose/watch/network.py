"""Missions that run on a network, as whoever listens there hears them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

import zenoh

from compose.scene.facts import Gathering
from compose.scene.stage import of_briefings
from compose.watch.shows import Show
from protocol import keys, refusal, session
from protocol.endpoints import Endpoints
from protocol.inbox import Inbox, Interrupted
from protocol.messages import Briefing, Drive, End, Estimate, Farewell, Message, Report, Sense, Truth
from protocol.wire import MalformedFrame, decode

LISTENED = (
    keys.truth("*"),
    keys.sense("*", "*"),
    keys.drive("*", "*"),
    keys.report("*", "*", "*"),
    keys.estimate("*", "*"),
)
KINDS = Briefing | Truth | Sense | Report | Drive | Estimate | End | Farewell
LOOK_AGAIN_S = 0.25
"""how often to look whether to end, and for a world that was not there"""
QUERY_S = 2.0
"""how long to wait for one answer"""
SILENCE_S = 10.0
"""a session over which nothing has come for so long, though a world was there, is replaced"""
TICKS_KEPT = 100_000
"""robots times ticks, of one mission; beyond, the oldest are forgotten"""


class Heard(Show):
    """A mission, as far as it has been heard."""

    def __init__(self, run: str) -> None:
        super().__init__(run, Gathering())
        self.stage = None
        self.live = True
        self._robots: dict[str, bool] = {}
        """those whose tokens have appeared or gone since the last poll: whether they are there"""

    def take(self, frame: bytes) -> None:
        """Fold in a frame; one that is malformed is nothing that a viewer could refuse."""
        try:
            message: Message = decode(frame, KINDS)
        except MalformedFrame:
            return
        briefed = len(self.known.briefings)
        self.known.take(message, len(frame))
        if len(self.known.briefings) > briefed:
            order = sorted(self.known.briefings)
            self.stage = of_briefings(self.name, {robot: self.known.briefings[robot] for robot in order})
        if self.known.end is not None:
            self.live = False

    def poll(self) -> None:
        """Forget what is too long ago."""
        robots = len(self.stage.robots) if self.stage is not None else 1
        while len(self.known.ticks) * robots > TICKS_KEPT:
            del self.known.ticks[next(iter(self.known.ticks))]
        for robot, there in self._robots.items():
            if self.live:  # without its world, who may be the router, nobody is heard of
                self.known.present(robot, there)
        self._robots.clear()
        self.revised()

    def there(self, key: str, alive: bool) -> None:
        """Fold in whether its world, or a robot, shows itself by the token at `key`."""
        if key != keys.world_alive(self.name):
            self._robots[keys.robot_of(key)] = alive
            return
        self.live = alive and self.known.end is None
        self.known.present(None, alive)


class Listener:
    """Somebody who listens at an endpoint, in a thread of its own; says nothing but questions."""

    def __init__(self, endpoints: Endpoints) -> None:
        self.endpoint = str(endpoints)
        self._endpoints = endpoints
        self.shows: dict[str, Heard] = {}
        """by run, in the order in which they were found"""
        self.reached = False
        """whether there is a router at the endpoint"""
        self._inbox = Inbox("tandem watch")
        self._answers: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
        self._stop = threading.Event()
        self._looking_since: float | None = None
        self._told = False
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; waits a moment for the session to close."""
        self._stop.set()
        self._thread.join(session.CLOSE_TIMEOUT_S + 1.0)

    def poll(self) -> None:
        """Fold in what has come."""
        while (arrival := self._inbox.next(0.0)).topic != "nothing":
            run = keys.run_of(arrival.key)
            match arrival.topic:
                case "alive" | "gone":
                    self._show(run).there(arrival.key, arrival.topic == "alive")
                case _:
                    self._show(run).take(arrival.frame)
        while True:
            try:
                run, frame = self._answers.get_nowait()
            except Empty:
                break
            self._show(run).take(frame)
        for show in self.shows.values():
            show.poll()

    def _show(self, run: str) -> Heard:
        if run not in self.shows:
            self.shows[run] = Heard(run)
        return self.shows[run]

    # --- in the thread ---

    def _listen(self) -> None:
        while not self._stop.is_set():
            try:
                with session.open_client(self._endpoints, self._unanswered) as link:
                    self.reached = True
                    self._looking_since = None
                    self._attend(link)
            except Interrupted:
                return
            self.reached = False

    def _unanswered(self) -> None:
        if self._looking_since is None:
            self._looking_since = time.monotonic()
        elif not self._told and time.monotonic() >= self._looking_since + refusal.FIRST_WORD_S:
            self._told = True
            self._inbox.say(f"no router at {self.endpoint} yet: {refusal.why(self._endpoints)}")
        if self._stop.wait(LOOK_AGAIN_S):
            raise Interrupted("stop")

    def _attend(self, link: zenoh.Session) -> None:
        """Listen, and ask for the briefing of every robot that appears, until the session is mute."""
        appeared: SimpleQueue[str] = SimpleQueue()
        heard = threading.Event()
        for key in LISTENED:
            link.declare_subscriber(key, self._hand_over(heard))
        session.watch_liveliness(link, keys.world_alive("*"), self._inbox)
        session.watch_liveliness(link, keys.robot_alive("*", "*"), self._inbox)
        told: Any = link.liveliness()
        told.declare_subscriber(
            keys.robot_alive("*", "*"), lambda sample: appeared.put(str(sample.key_expr)), history=True
        )
        silent = 0.0
        while not self._stop.is_set():
            try:
                key = appeared.get(timeout=LOOK_AGAIN_S)
            except Empty:
                silent = 0.0 if heard.is_set() else silent + LOOK_AGAIN_S
                heard.clear()
                if silent >= SILENCE_S:
                    return
                continue
            self._ask(link, keys.run_of(key), keys.robot_of(key))

    def _hand_over(self, heard: threading.Event) -> Callable[[zenoh.Sample], None]:
        def hand_over(sample: zenoh.Sample) -> None:
            heard.set()
            self._inbox.put("drive", str(sample.key_expr), sample.payload.to_bytes())

        return hand_over

    def _ask(self, link: zenoh.Session, run: str, robot: str) -> None:
        known = self.shows.get(run)
        if known is not None and robot in known.known.briefings:
            return
        answer = session.ask(link, keys.briefing(run, robot), QUERY_S)
        if isinstance(answer, bytes):
            self._answers.put((run, answer))
