"""A mission whose processes are threads of this one, over a network and a clock in memory.

The world and the agents run as they do as processes, with files for journals. Exactly one of them runs at a
time, and the clock only advances while all wait: the thread that begins to wait advances it, until a thread
has something to do. So the same scenario and kills give the same order of events, and a wait of seconds takes
none. A kill ends a thread where its process would have ended; what it has
not written is lost.
"""

from __future__ import annotations

import heapq
import math
import random
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple, cast

import zenoh

from agent.process.node import AgentProcess
from agent.process.recovery import Memory, remember
from agent.process.robot import Robot
from compose.launch.planner_loader import planner_of
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.scenario.kills import WORLD, Kill
from protocol.journal.journal_file import Journal
from protocol.journal.resume import Retrace
from protocol.network.clock import Clock, ClockError
from protocol.network.inbox import NO_ARRIVAL, SIGNAL_S, Arrival, Inbox
from protocol.network.session import LinkLost
from world.process import WorldProcess
from world.scenario import Scenario
from world.simulation import Simulation, resumed

RUN = "virtual"
"""The name of the run."""
LATENCIES_S = (1e-4, 1e-2)
"""The bounds in s of the time from the sending of a frame to its arrival, which is log-uniform.

Frames on one key arrive in their order.
"""
NOTICE_S = 0.01
"""The time in s until others see that a process has been killed."""
VIRTUAL_START_S = 0.3
"""The time in s that a process takes to start."""
VIRTUAL_TIMEOUT_S = 30.0
"""The time in s of the virtual clock that the processes wait for each other."""


DRIVER = "driver of "
"""The beginning of the name of a driver's process in hardware mode."""
MOST_ARRIVALS = 4
"""The number of frames between two Commands whose order is noted."""
LEAST_WAIT_S = 1e-6
"""The least wait in s, so that rounding cannot make one without an end."""


class _Killed(BaseException):
    """The end of a killed process. It is no Exception, so nothing but the end of its thread handles it."""


class _Sample(NamedTuple):
    """A sample that a subscriber of Zenoh receives, as far as Tandem reads it."""

    key_expr: str
    payload: zenoh.ZBytes
    kind: zenoh.SampleKind = zenoh.SampleKind.PUT
    attachment: zenoh.ZBytes | None = None


def run_mission(
    scenario: Scenario,
    folder: Path,
    kills: Sequence[Kill] = (),
    clocks: Mapping[str, ClockError] = MappingProxyType({}),
) -> VirtualNetwork:
    """Run `scenario`, write its journals to `folder`, and return the network. Killed processes restart.

    `clocks` are the errors of the clocks of robots and of the world, by name.
    """
    network = VirtualNetwork(scenario, folder, kills, clocks)
    network.run({WORLD: world_process} | {one.id: agent_process for one in scenario.robots})
    return network


class VirtualProcess:
    """One process of the mission: a thread that runs only while the network waits for it."""

    def __init__(self, network: VirtualNetwork, name: str, body: Body) -> None:
        self.name = name
        self._body = body
        self.left = [kill for kill in network.kills if kill.who == name]
        """The kills that have not taken place."""
        self._network = network
        self._turn = held()
        self._thread: threading.Thread | None = None
        self._waits = 0
        """The number of waits so far, so that the end of an earlier one does not wake it."""
        self.link: VirtualLink | None = None
        """The session; None while the process does not run."""

    def start(self) -> None:
        """Start the process: it is the next to run."""
        self.link = VirtualLink(self._network, self)
        self._thread = threading.Thread(target=self._main, daemon=True)
        self._network.ready.append(self)

    def wait(self, until: float) -> None:
        """Let others run until the clock reaches `until`, or an event arrives."""
        self._waits += 1
        if until < math.inf:
            self._network.at(until, lambda waits=self._waits: self.wake(waits))  # type: ignore[misc]
        if (following := self._network.advanced()) is not self:
            self._network.pass_to(following)
            self._turn.acquire()
        if self._network.over:
            raise _Killed

    def wake(self, waits: int | None = None) -> None:
        """Let the process run next, if it is in its wait number `waits`, or in any if that is None."""
        if self.link is not None and waits in (None, self._waits):
            self._network.ready.append(self)

    def go_on(self) -> None:
        """Let the thread of the process run, which has just been started or waits."""
        assert self._thread is not None
        if self._thread.ident is None:
            self._thread.start()
        else:
            self._turn.release()

    def end(self) -> None:
        """End the thread of the process, if it waits."""
        if self.link is not None and self._thread is not None and self._thread.ident is not None:
            self._turn.release()
            self._thread.join()

    def _main(self) -> None:
        network = self._network
        try:
            self._body(network, self)
        except _Killed:
            if not network.over:
                self._restart()
        except Exception as error:  # noqa: BLE001  # a process ends with whatever its code raises
            network.failures.append(f"{self.name}: {type(error).__name__}: {error}")
        else:
            network.ended.append(self.name)
        finally:
            network.close(self.link)
            self.link = None
            if not network.over:
                network.pass_to(network.advanced())

    def _restart(self) -> None:
        kill = self.left.pop(0)
        self._network.taken += 1
        if kill.after is not None:
            self._network.at(self._network.now + kill.after + VIRTUAL_START_S, self.start)

    def arguments(self) -> dict[str, Any]:
        """Return the arguments that the world and the agents share."""
        inbox = _VirtualInbox(self._network, self)
        shared = {"timeout": VIRTUAL_TIMEOUT_S, "on_kill_point": self._on_kill_point}
        return {"run": RUN, "inbox": inbox, **shared}

    def _on_kill_point(self, point: str, tick: int) -> None:
        """Kill this process if that is scheduled for `point` of `tick`."""
        for i, kill in enumerate(self.left):
            if (kill.point, kill.tick) == (point, tick):
                self.left.insert(0, self.left.pop(i))
                raise _Killed


class VirtualNetwork:
    """The clock, the events that are due, and the subscriptions of all processes."""

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        kills: Sequence[Kill],
        clocks: Mapping[str, ClockError],
        tick_s: float | None = None,
    ) -> None:
        """`tick_s` is the duration of a tick in s; None in lockstep."""
        self.scenario, self.folder, self.kills, self.clocks = scenario, folder, kills, clocks
        self.tick_s = tick_s
        self.now = 0.0
        self.over = False
        self.taken = 0
        """The number of kills that took place."""
        self.failures: list[str] = []
        """The errors with which processes ended, in their order."""
        self.ended: list[str] = []
        self.orders: set[str] = set()
        """The orders in which frames have arrived at an agent between two of its Commands."""
        self.subscribers: list[tuple[VirtualLink, zenoh.KeyExpr, Callable[[_Sample], None]]] = []
        self.watchers: list[tuple[VirtualLink, zenoh.KeyExpr, Callable[[_Sample], None]]] = []
        self.tokens: list[tuple[VirtualLink, str]] = []
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._number = count()
        self._draw = random.Random(f"{scenario.seed}/latency")
        self._latest: dict[tuple[VirtualLink, str], float] = {}
        """The time of the latest arrival at each link on each key."""
        self._woken: dict[VirtualProcess, None] = {}
        """The processes for which something has arrived at this time, in its order."""
        self.ready = deque[VirtualProcess]()
        """The processes that run before the clock advances, in their order."""
        self._processes: list[VirtualProcess] = []
        self._ended = held()
        """The lock that is released at the end of the mission."""
        self._matching: dict[str, list[tuple[VirtualLink, Callable[[_Sample], None]]]] = {}

    def at(self, due: float, act: Callable[[], None]) -> None:
        """Call `act` when the clock reaches `due`, after everything that was due by then before this call."""
        heapq.heappush(self._due, (due, next(self._number), act))

    def run(self, bodies: Mapping[str, Body]) -> None:
        """Run a process for each of `bodies`, by name, until they have ended, or one has failed."""
        self._processes = [VirtualProcess(self, name, body) for name, body in bodies.items()]
        for one in self._processes:
            self.at(0.0, one.start)
        try:
            self.pass_to(self.advanced())
            self._ended.acquire()
        finally:
            self.over = True
        for one in self._processes:
            one.end()

    def advanced(self) -> VirtualProcess | None:
        """Advance the clock until a process has something to do, and return it; None at the end."""
        while not self.ready:
            if self._woken and (not self._due or self._due[0][0] > self.now):
                self.ready.extend([one for one in self._woken if one.link is not None])
                self._woken.clear()
            elif self.failures or len(self.ended) == len(self._processes):
                return None
            elif not self._due:
                self.failures.append("a process that was killed is missing")
            else:
                self.now, _, act = heapq.heappop(self._due)
                act()
        return self.ready.popleft()

    def pass_to(self, process: VirtualProcess | None) -> None:
        """Let the thread of `process` run in the place of this one, or that of the mission if it is None."""
        if process is not None:
            process.go_on()
        else:
            self._ended.release()

    def send(self, key: str, frame: bytes) -> None:
        """Deliver `frame` to all subscribers of `key`, after a time of LATENCIES_S."""
        if key not in self._matching:
            one = zenoh.KeyExpr(key)
            self._matching[key] = [(link, to) for link, keys, to in self.subscribers if keys.intersects(one)]
        sample = _Sample(key, zenoh.ZBytes(frame))
        low, high = LATENCIES_S
        for link, to in self._matching[key]:
            due = self.now + low * (high / low) ** self._draw.random()
            due = self._latest[link, key] = max(due, self._latest.get((link, key), 0.0))
            self.deliver(link, to, sample, due)

    def deliver(self, link: VirtualLink, to: Callable[[_Sample], None], sample: _Sample, due: float) -> None:
        """Give `sample` to a subscriber of `link` at the time `due` in s, and let its process run."""

        def arrive() -> None:
            if link.process.link is link:
                if len(link.arrivals) < MOST_ARRIVALS:
                    link.arrivals.append(
                        "report" if "/to/" in sample.key_expr else sample.key_expr.rpartition("/")[2]
                    )
                to(sample)
                self._woken[link.process] = None

        self.at(due, arrive)

    def subscribe(
        self, link: VirtualLink, key: str, to: Callable[[_Sample], None], *, tokens: bool = False
    ) -> None:
        """Let `to` receive what is sent on `key`, or the tokens there."""
        (self.watchers if tokens else self.subscribers).append((link, zenoh.KeyExpr(key), to))
        self._matching.clear()
        for _, shown in list(self.tokens) if tokens else ():
            if zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(shown)):
                self.deliver(link, to, _Sample(shown, zenoh.ZBytes(b"")), self.now + LATENCIES_S[0])

    def show(self, link: VirtualLink, key: str, *, gone: bool = False, delay: float = LATENCIES_S[0]) -> None:
        """Show the liveliness token `key` of `link` to others, or withdraw it. One of several is none."""
        self.tokens.remove((link, key)) if gone else self.tokens.append((link, key))
        if sum([shown == key for _, shown in self.tokens]) != (0 if gone else 1):
            return
        kind = zenoh.SampleKind.DELETE if gone else zenoh.SampleKind.PUT
        for other, keys, to in self.watchers:
            if keys.intersects(zenoh.KeyExpr(key)):
                self.deliver(other, to, _Sample(key, zenoh.ZBytes(b""), kind), self.now + delay)

    def close(self, link: VirtualLink | None, delay: float = NOTICE_S) -> None:
        """Remove the subscriptions and tokens of `link`, which others see after `delay` s."""
        self.subscribers = [one for one in self.subscribers if one[0] is not link]
        self.watchers = [one for one in self.watchers if one[0] is not link]
        self._matching.clear()
        for one, key in [token for token in self.tokens if token[0] is link]:
            self.show(one, key, gone=True, delay=delay)


class VirtualLink:
    """The part of a Zenoh session that `protocol/network/session.py` uses, without viewers and routers."""

    def __init__(self, network: VirtualNetwork, process: VirtualProcess) -> None:
        self._network, self.process = network, process
        self.arrivals: list[str] = []
        """The kinds of the first frames since the latest Command."""
        self.info = SimpleNamespace(routers_zid=tuple)

    def declare_publisher(self, key: str, **_: object) -> SimpleNamespace:
        """Return a publisher on `key`."""

        def put(frame: bytes) -> None:
            if key.endswith("/command"):
                self._network.orders.add(", ".join(self.arrivals))
                self.arrivals.clear()
            self._network.send(key, frame)

        return SimpleNamespace(
            put=put,
            declare_matching_listener=_ignored,
            matching_status=SimpleNamespace(matching=False),
        )

    def declare_subscriber(self, key: str, handler: Any) -> SimpleNamespace | None:
        """Let `handler` receive the frames on `key`; return their queue if it is a channel."""
        if not isinstance(handler, zenoh.handlers.RingChannel):
            self._network.subscribe(self, key, handler)
            return None
        frames = deque[_Sample]()
        self._network.subscribe(self, key, frames.append)
        return SimpleNamespace(try_recv=lambda: frames.popleft() if frames else None)

    def declare_queryable(self, key: str, handler: object) -> None:
        """Do nothing: agents have their configuration."""

    def put(self, *_: object, **__: object) -> None:
        """Do nothing: this would end a wait of Zenoh, and there is none."""

    def liveliness(self) -> SimpleNamespace:
        """Return what declares and watches tokens."""

        def declare_token(key: str) -> SimpleNamespace:
            self._network.show(self, key)
            return SimpleNamespace(undeclare=lambda: self._network.show(self, key, gone=True))

        return SimpleNamespace(
            declare_subscriber=lambda key, handler, history: self._network.subscribe(
                self, key, handler, tokens=history
            ),
            declare_token=declare_token,
        )


def held() -> threading.Lock:
    """Return a lock that is held, so that one thread waits for it until another one releases it."""
    lock = threading.Lock()
    lock.acquire()
    return lock


def _ignored(_: object) -> None:
    """Do nothing."""


class _VirtualInbox(Inbox):
    """An inbox whose waits last until the clock of the network."""

    def __init__(self, network: VirtualNetwork, process: VirtualProcess) -> None:
        error = network.clocks.get(process.name.removeprefix(DRIVER))
        super().__init__(process.name, Clock(error, true=lambda: network.now))
        self._network, self._process = network, process

    def next(self, timeout: float | None) -> Arrival:
        """Return the next event, or NO_ARRIVAL after `timeout` s."""
        until = math.inf
        if timeout is not None:
            until = self.clock() + (max(timeout, LEAST_WAIT_S) if timeout > 0.0 else timeout)
        while (arrival := super().next(0.0)) is NO_ARRIVAL and (left := until - self.clock()) > 0.0:
            began = self.clock()
            self._process.wait(self._network.now + max(min(left, SIGNAL_S), LEAST_WAIT_S))
            self.waited(began, SIGNAL_S)
        return arrival

    def say(self, line: str) -> None:
        """Say nothing."""


def agent_process(network: VirtualNetwork, process: VirtualProcess) -> None:
    """Run an agent from its journal to the end of the mission, as `tandem agent` does."""
    path, config = (
        network.folder / agent_journal(process.name),
        network.scenario.config(process.name, network.tick_s),
    )
    old = Retrace(path) if path.exists() else None
    memory = remember(old, planner_of) if old is not None else None
    with old.open_for_append()[0] if old is not None else Journal(path) as journal:
        if memory is None:
            memory = Memory(Robot(config, planner_of(config), journal))
        memory.robot.append_to(journal)
        agent = AgentProcess(memory, launched=True, **process.arguments())
        while True:
            agent.attach(cast(Any, process.link))
            try:
                agent.run()
            except LinkLost:
                network.close(process.link, LATENCIES_S[0])
                process.link = VirtualLink(network, process)
            else:
                return


def world_process(network: VirtualNetwork, process: VirtualProcess) -> None:
    """Run the world from its journal to the end of the mission, as `tandem world` does."""
    path = network.folder / WORLD_JOURNAL
    old = Retrace(path) if path.exists() else None
    simulation = resumed(network.scenario, old) if old is not None else None
    with old.open_for_append()[0] if old is not None else Journal(path) as journal:
        if simulation is None:
            simulation = Simulation(network.scenario, journal)
        simulation.append_to(journal)
        world = WorldProcess(simulation, **process.arguments())
        world.attach(cast(Any, process.link))
        world.run()


Body = Callable[[VirtualNetwork, VirtualProcess], None]
"""The function that a process runs."""
