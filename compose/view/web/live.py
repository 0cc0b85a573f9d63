"""Missions that run on a network, as whoever listens there hears them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from queue import Empty, SimpleQueue
from typing import Any

import zenoh

from compose.view.cast import of_briefings
from compose.view.facts import Gathering
from compose.view.web.sources import UNANSWERED, Show
from protocol.messages import (
    Command,
    Estimate,
    FinalReport,
    GroundTruth,
    Message,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.network import diagnosis, keys, session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Arrival, Inbox, Interrupted
from protocol.network.keys import Key
from protocol.wire import MalformedFrame, decode

LISTENED = (
    keys.truth("*"),
    keys.observation("*", "*"),
    keys.command("*", "*"),
    keys.report("*", "*", "*"),
    keys.estimate("*", "*"),
)
CARRIED: Mapping[Callable[..., str] | None, Any] = {
    keys.truth: GroundTruth,
    keys.config: RobotConfig,
    keys.observation: Observation | MissionEnd | FinalReport,
    keys.command: Command | FinalReport,
    keys.report: Report,
    keys.estimate: Estimate,
}
"""the messages that each kind of key carries"""
OF_WORLD = (keys.truth, keys.observation)
"""keys under which the world speaks"""
AHEAD = UNANSWERED - 1
"""ticks by which a robot's frame may be ahead of the world's latest, which may come by another way"""
LEAP = 100_000
"""ticks by which the world may be ahead of what was last heard of it; it plays fewer while a link is down"""
MOST_RUNS = 1000
"""missions that are listed at the most"""
MOST_APPEARING = 10_000
"""robots at the most that wait to be asked for"""
LOOK_AGAIN_S = 0.25
"""how often to look whether to end, and for a world that was not there"""
QUERY_S = 2.0
"""how long to wait for one answer"""
SILENCE_S = 10.0
"""a session over which nothing has come for so long, though a world was there, is replaced"""
TICKS_KEPT = 100_000
"""robots times ticks, of one mission; beyond, the oldest are forgotten"""


class RefusedFrame(ValueError):
    """A frame that the key it came under does not carry; its text says why."""


class Heard(Show):
    """A mission, as far as it has been heard."""

    def __init__(self, run: str) -> None:
        super().__init__(run, Gathering())
        self.stage = None
        self.live = True
        self._tick: int | None = None
        """the latest of which the world has spoken"""
        self._robots: dict[str, bool] = {}
        """those whose tokens have appeared or gone since the last poll: whether they are there"""

    def take(self, source: Key, frame: bytes) -> None:
        """Fold in what came under `source`.

        A robot can put frames under its own keys only, and so it speaks for nobody else: raises Refused
        unless kind, robot and tick are such as the key carries. Raises MalformedFrame.
        """
        message: Message = decode(frame, CARRIED[source.kind])
        robot = getattr(message, "robot", source.robot)
        if robot != source.robot:
            raise RefusedFrame(f"it says it is from '{robot}'")
        tick: int | None = getattr(message, "tick", None)
        if tick is not None and not self._timely(tick, by_world=source.kind in OF_WORLD):
            return
        briefed = len(self.known.configs)
        self.known.take(message, len(frame))
        if len(self.known.configs) > briefed:
            order = sorted(self.known.configs)
            self.stage = of_briefings(self.name, {robot: self.known.configs[robot] for robot in order})
        if self.known.end is not None:
            self.live = False

    def _timely(self, tick: int, *, by_world: bool) -> bool:
        """Whether `tick` has begun: the world says so, and before it has, nobody is heard. Raises Refused."""
        latest = self._tick
        if latest is not None and tick > latest + (LEAP if by_world else AHEAD):
            raise RefusedFrame("it is of a tick to come")
        if by_world:
            self._tick = max(tick, latest or 0)
        return self._tick is not None

    def poll(self) -> None:
        """Forget what is too long ago."""
        robots = len(self.stage.robots) if self.stage is not None else 1
        while len(self.known.ticks) * robots > TICKS_KEPT:
            del self.known.ticks[next(iter(self.known.ticks))]
        if not self.live:  # without its world, which may be the router, nobody is heard of
            self._robots.clear()
        for robot in self._robots.keys() & self.known.configs.keys():
            self.known.present(robot, self._robots.pop(robot))
        self.revised()

    def there(self, source: Key, alive: bool) -> None:
        """Fold in whether its world, or a robot, shows itself by the token at `source`."""
        if source.kind is not keys.world_alive:
            if len(self._robots) < MOST_APPEARING:
                self._robots[source.robot] = alive
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
        self._answers: SimpleQueue[Arrival] = SimpleQueue()
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
            self._take(arrival)
        while True:
            try:
                answer = self._answers.get_nowait()
            except Empty:
                break
            self._take(answer)
        for show in self.shows.values():
            show.poll()

    def _take(self, arrival: Arrival) -> None:
        """Fold it in. A mission is one whose world has shown itself."""
        run = arrival.source.run
        appears = arrival.topic == "alive" and arrival.source.kind is keys.world_alive
        if appears and run not in self.shows and len(self.shows) < MOST_RUNS:
            self.shows[run] = Heard(run)
        if run not in self.shows:
            return
        if arrival.topic in ("alive", "gone"):
            self.shows[run].there(arrival.source, arrival.topic == "alive")
            return
        try:
            self.shows[run].take(arrival.source, arrival.frame)
        except (MalformedFrame, RefusedFrame) as error:
            self._inbox.refuse(arrival, error)

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
        elif not self._told and time.monotonic() >= self._looking_since + diagnosis.FIRST_WORD_S:
            self._told = True
            self._inbox.say(f"no router at {self.endpoint} yet: {diagnosis.why(self._endpoints)}")
        if self._stop.wait(LOOK_AGAIN_S):
            raise Interrupted("stop")

    def _attend(self, link: zenoh.Session) -> None:
        """Listen, and ask for the briefing of every robot that appears, until the session is mute."""
        appeared: SimpleQueue[Key] = SimpleQueue()

        def appears(sample: zenoh.Sample) -> None:
            robot = keys.parse(str(sample.key_expr))
            if robot is not None and appeared.qsize() < MOST_APPEARING:
                appeared.put(robot)

        heard = threading.Event()
        session.watch_liveliness(link, keys.world_alive("*"), self._inbox)
        for key in LISTENED:
            link.declare_subscriber(key, self._hand_over(heard))
        session.watch_liveliness(link, keys.robot_alive("*", "*"), self._inbox)
        told: Any = link.liveliness()
        told.declare_subscriber(keys.robot_alive("*", "*"), appears, history=True)
        silent = 0.0
        while not self._stop.is_set():
            try:
                robot = appeared.get(timeout=LOOK_AGAIN_S)
            except Empty:
                silent = 0.0 if heard.is_set() else silent + LOOK_AGAIN_S
                heard.clear()
                if silent >= SILENCE_S:
                    return
                continue
            self._ask(link, robot.run, robot.robot)

    def _hand_over(self, heard: threading.Event) -> Callable[[zenoh.Sample], None]:
        def hand_over(sample: zenoh.Sample) -> None:
            heard.set()
            session.deliver(sample, self._inbox, "command")

        return hand_over

    def _ask(self, link: zenoh.Session, run: str, robot: str) -> None:
        known = self.shows.get(run)
        if known is not None and robot in known.known.configs:
            return
        asked = keys.config(run, robot)
        answer = session.ask(link, asked, QUERY_S)
        if isinstance(answer, bytes):
            self._answers.put(Arrival("command", asked, answer, Key(keys.config, run, robot)))
