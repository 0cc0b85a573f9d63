"""Missions observed on a network, for viewers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from queue import Empty, SimpleQueue
from typing import Any

import zenoh

from compose.recording.run_setup import of_configs
from compose.view.run_data import RunData
from compose.view.web.sources import UNANSWERED, WatchedRun
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
"""The message types that each kind of key carries."""
OF_WORLD = (keys.truth, keys.observation)
"""The kinds of keys under which the world publishes."""
FRAMES_AHEAD = UNANSWERED - 1
"""The number of ticks by which a robot's frame may precede the world's, which may take another route."""
MOST_TICKS_MISSED = 100_000
"""The number of ticks by which the world may advance between two received frames.

It is more than a world can run while a link is down.
"""
MOST_RUNS = 1000
"""The maximum number of listed missions."""
MOST_APPEARING = 10_000
"""The maximum number of robots that wait for the query of their configuration."""
MOST_COUNTED_LINKS = 100_000
"""The maximum number of robots and of links between them of which frames of one mission are stored."""
FRAMES_AT_ONCE = 1000
"""The number of frames that one poll processes: some 10 ms of work."""
STOP_POLL_S = 0.25
"""The interval in s between checks for the stop request, and between attempts to connect."""
LIVE_QUERY_S = 2.0
"""The timeout of a query in s."""
STALE_SESSION_S = 10.0
"""The time in s without any received frame after which the session is replaced."""
TICKS_KEPT = 100_000
"""The maximum number of ticks times robots stored per mission. The oldest ticks are dropped."""


class RefusedFrame(ValueError):
    """A frame that does not belong under its key; the text says why."""


class ReceivedMission(WatchedRun):
    """A mission, built from the frames received from the network."""

    def __init__(self, run: str) -> None:
        super().__init__(run, RunData())
        self.setup = None
        self.live = True
        self._links: set[tuple[str, str]] = set()
        """The robots of all frames so far, and the receivers of their reports."""
        self._tick: int | None = None
        """The latest tick in a frame of the world; None before the first."""
        self._robots: dict[str, bool] = {}
        """Robots whose liveliness tokens changed since the last poll: True if the token is present."""

    def take(self, source: Key, frame: bytes) -> None:
        """Add a frame received under the key `source`.

        Access control lets a robot publish only under its own keys, so the key identifies the sender. Raises
        RefusedFrame unless kind, robot and tick match the key, and MalformedFrame if the frame is invalid.
        """
        message: Message = decode(frame, CARRIED[source.kind])
        robot = getattr(message, "robot", source.robot)
        if robot != source.robot:
            raise RefusedFrame(f"it names robot '{robot}' as its sender")
        tick: int | None = getattr(message, "tick", None)
        config = self.known.configs.get(source.robot)
        if source.peer and config is not None and source.peer not in config.others:
            raise RefusedFrame(f"it is for '{source.peer}', which is not in the mission")
        if len(self._links) >= MOST_COUNTED_LINKS and source[2:] not in self._links:
            raise RefusedFrame("there are too many robots")
        self._links.add(source[2:])
        if tick is not None and not self._timely(tick, by_world=source.kind in OF_WORLD):
            return
        configured = len(self.known.configs)
        self.known.add(message, receiver=source.peer)
        if len(self.known.configs) > configured:
            order = sorted(self.known.configs)
            self.setup = of_configs(self.name, {robot: self.known.configs[robot] for robot in order})
        if self.known.end is not None:
            self.live = False

    def _timely(self, tick: int, *, by_world: bool) -> bool:
        """Return whether the world has begun any tick. Frames before that are ignored.

        Raises RefusedFrame if `tick` is too far in the future.
        """
        latest = self._tick
        if latest is not None and tick > latest + (MOST_TICKS_MISSED if by_world else FRAMES_AHEAD):
            raise RefusedFrame("its tick is in the future")
        if by_world:
            self._tick = max(tick, latest or 0)
        return self._tick is not None

    def poll(self) -> None:
        """Drop the oldest ticks beyond TICKS_KEPT, and apply changes of liveliness tokens."""
        robots = len(self.setup.robots) if self.setup is not None else 1
        while len(self.known.ticks) * robots > TICKS_KEPT:
            del self.known.ticks[next(iter(self.known.ticks))]
        if not self.live:  # the world may be the router: without it, robots' tokens disappear as well
            self._robots.clear()
        for robot in self._robots.keys() & self.known.configs.keys():
            self.known.present(robot, self._robots.pop(robot))
        self.revised()

    def there(self, source: Key, alive: bool) -> None:
        """Record that the liveliness token at `source`, of the world or a robot, appeared or disappeared."""
        if source.kind is not keys.world_alive:
            if len(self._robots) < MOST_APPEARING:
                self._robots[source.robot] = alive
            return
        self.live = alive and self.known.end is None
        self.known.present(None, alive)


class Listener:
    """A viewer's connection to a router, in a thread of its own. It only subscribes and queries."""

    def __init__(self, endpoints: Endpoints) -> None:
        self.endpoint = str(endpoints)
        self._endpoints = endpoints
        self.shows: dict[str, ReceivedMission] = {}
        """The missions by run name, in the order in which they were found."""
        self.reached = False
        """True while connected to a router."""
        self.more = False
        """True if the last poll has left frames to be processed by the next one."""
        self._inbox = Inbox("tandem watch")
        self._stop = threading.Event()
        self._looking_since: float | None = None
        self._reported = False
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread, and wait until the session is closed or the time for that is over."""
        self._stop.set()
        self._thread.join(session.CLOSE_TIMEOUT_S + 1.0)

    def poll(self) -> None:
        """Process received frames and answers, at most FRAMES_AT_ONCE."""
        self.more = True
        for _ in range(FRAMES_AT_ONCE):
            arrival = self._inbox.next(0.0)
            if arrival.topic == "nothing":
                self.more = False
                break
            self._take(arrival)
        for show in self.shows.values():
            show.poll()

    def _take(self, arrival: Arrival) -> None:
        """Process one arrival. A mission is listed once its world's liveliness token has appeared."""
        run = arrival.source.run
        appears = arrival.topic == "alive" and arrival.source.kind is keys.world_alive
        if appears and run not in self.shows and len(self.shows) < MOST_RUNS:
            self.shows[run] = ReceivedMission(run)
        show = self.shows.get(run)
        if show is not None and arrival.topic in ("alive", "gone"):
            show.there(arrival.source, arrival.topic == "alive")
        elif show is not None:
            try:
                show.take(arrival.source, arrival.frame)
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
        elif not self._reported and time.monotonic() >= self._looking_since + diagnosis.FIRST_WORD_S:
            self._reported = True
            self._inbox.say(f"no router at {self.endpoint} yet: {diagnosis.why(self._endpoints)}")
        if self._stop.wait(STOP_POLL_S):
            raise Interrupted("stop")

    def _attend(self, link: zenoh.Session) -> None:
        """Subscribe, and query the configuration of each robot that appears, until no frames arrive."""
        appeared: SimpleQueue[Key] = SimpleQueue()

        def appears(sample: zenoh.Sample) -> None:
            robot = keys.parse(str(sample.key_expr))
            if robot is not None and appeared.qsize() < MOST_APPEARING:
                appeared.put(robot)

        def hand_over(sample: zenoh.Sample) -> None:
            received.set()
            session.deliver(sample, self._inbox, "command")

        received = threading.Event()
        session.watch_liveliness(link, keys.world_alive("*"), self._inbox)
        for key in LISTENED:
            link.declare_subscriber(key, hand_over)
        session.watch_liveliness(link, keys.robot_alive("*", "*"), self._inbox)
        liveliness: Any = link.liveliness()
        liveliness.declare_subscriber(keys.robot_alive("*", "*"), appears, history=True)
        idle_s = 0.0
        while not self._stop.is_set():
            try:
                robot = appeared.get(timeout=STOP_POLL_S)
            except Empty:
                idle_s = 0.0 if received.is_set() else idle_s + STOP_POLL_S
                received.clear()
                if idle_s >= STALE_SESSION_S:
                    return
                continue
            self._ask(link, robot.run, robot.robot)

    def _ask(self, link: zenoh.Session, run: str, robot: str) -> None:
        known = self.shows.get(run)
        if known is not None and robot in known.known.configs:
            return
        key = keys.config(run, robot)
        answer = session.ask(link, key, LIVE_QUERY_S)
        if isinstance(answer, bytes):  # queued apart from what is published, which may be too much
            self._inbox.put("observation", key, answer, Key(keys.config, run, robot))
