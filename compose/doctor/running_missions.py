"""The missions that run on a network, found by listening for a short time.

The search causes no additional work for a mission. It asks for liveliness tokens once, and subscribes to
Observations and Commands, which are published in any case. It does not subscribe to the ground truth and the
estimates, which are published only for subscribers. It ends as soon as each process has sent a message.
"""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import msgspec
import zenoh

from protocol.messages import Command, FinalReport, MissionEnd, Observation, Outcome, Phase, RobotConfig
from protocol.network import diagnosis, keys, session
from protocol.network.endpoints import Endpoints
from protocol.network.keys import Key
from protocol.wire import MalformedFrame, decode, version_of

ROUTER_TIMEOUT_S = 3.0
"""Time in s after which no new attempt to connect is made."""
ASK_S = 2.0
"""Time in s to wait for one answer."""
FIND_S = 0.5
"""Time in s to look for a mission if there is none: routers may just have connected to each other."""
MISSIONS_POLL_S = 0.02
"""The polling interval in s."""
Frames = Mapping[Key, tuple[bytes, ...]]
"""The latest two frames of each key."""


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


class Participant(msgspec.Struct, frozen=True):
    """The latest known state of a robot of a mission."""

    robot: str
    there: bool
    """True if its agent has a liveliness token."""
    tick: int | None = None
    """Tick of its latest Command; None if none was received."""
    phase: Phase | None = None
    state: str | None = None


class RunningMission(msgspec.Struct, frozen=True):
    """The latest known state of a run."""

    run: str
    world: bool
    """True if its world has a liveliness token."""
    tick: int | None
    """Tick of the latest Observation or MissionEnd; None if none was received."""
    outcome: Outcome | None
    """Outcome; None while the mission runs."""
    versions: tuple[int, ...]
    """Versions of the wire protocol in the received frames."""
    robots: tuple[Participant, ...]
    """All robots that the world or a peer named, alive or not."""

    @property
    def missing(self) -> tuple[str, ...]:
        """The processes of the run that have no liveliness token."""
        world = () if self.world else ("its world",)
        return (*world, *(one.robot for one in self.robots if not one.there))


def look(link: zenoh.Session, wait: float) -> tuple[RunningMission, ...]:
    """Return the missions that `link` sees, after listening for at most `wait` s.

    The session needs the access rights of a viewer or a world.
    """
    alive = _alive(link)
    if not alive:
        return ()
    frames = _received(link, alive, wait)
    return tuple(_mission(link, frames, run, robots) for run, robots in alive.items())


def _alive(link: zenoh.Session) -> dict[str, frozenset[str]]:
    """Return the liveliness tokens by run: the names of the robots, and "" for the world."""
    until = time.monotonic() + FIND_S
    while True:
        worlds = session.alive(link, keys.world_alive("*"), ASK_S)
        robots = session.alive(link, keys.robot_alive("*", "*"), ASK_S)
        if worlds or robots or time.monotonic() >= until:
            break
        time.sleep(MISSIONS_POLL_S)
    found: dict[str, set[str]] = {}
    for key in (*worlds, *robots):
        found.setdefault(key.run, set()).add(key.robot)
    return {run: frozenset(found[run]) for run in sorted(found)}


def _decoded(frame: bytes | None, kind: Any) -> Any:
    """Return the message in a frame; None if there is no frame, or it cannot be decoded."""
    try:
        return decode(frame, kind) if frame is not None else None
    except MalformedFrame:
        return None


def _received(link: zenoh.Session, alive: dict[str, frozenset[str]], wait: float) -> Frames:
    """Return the frames received until each process that is alive has sent a message, or for `wait` s.

    Samples under other keys are ignored.
    """
    latest: defaultdict[Key, deque[bytes]] = defaultdict(lambda: deque(maxlen=2))

    def hand_over(sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is not None:
            latest[key].append(sample.payload.to_bytes())

    declared: list[Any] = [
        link.declare_subscriber(key(run, "*"), hand_over)
        for run in alive
        for key in (keys.observation, keys.command)
    ]
    until = time.monotonic() + wait
    while True:
        frames = {key: tuple(some) for key, some in tuple(latest.items())}
        if all(_is_complete(frames, *one) for one in alive.items()) or time.monotonic() >= until:
            break
        time.sleep(MISSIONS_POLL_S)
    for one in declared:  # frames received meanwhile would be of several ticks
        one.undeclare()
    return frames


def _is_complete(frames: Frames, run: str, alive: frozenset[str]) -> bool:
    """Return whether all robots of `run` have sent a Command, and its world Observations to all of them.

    The world sends to its robots in turn: once one has received two, all have received one.
    """
    if "" not in alive:
        return True
    again = any(
        len(frames[Key(keys.observation, run, one)]) > 1 for one in _named(frames, run, keys.observation)
    )
    return again and alive - {""} <= _named(frames, run, keys.command)


def _named(frames: Frames, run: str, kind: Any) -> set[str]:
    """Return the robots for whose key of this kind a frame was received."""
    return {one.robot for one in frames if (one.kind, one.run) == (kind, run)}


def _message(frames: Frames, key: Key, messages: Any) -> Any:
    """Return the latest message under `key`, if it is one of `messages` and of the robot in the key."""
    message = _decoded(frames.get(key, (None,))[-1], messages)
    return message if getattr(message, "robot", key.robot) == key.robot else None


def _mission(link: zenoh.Session, frames: Frames, run: str, alive: frozenset[str]) -> RunningMission:
    observed, there = _named(frames, run, keys.observation), alive - {""}
    answers = _configs(link, run, observed | there) if "" in alive else {}
    configs = [one for frame in answers.values() if (one := _decoded(frame, RobotConfig)) is not None]
    named = there | observed | _named(frames, run, keys.command)
    named |= {robot for one in configs for robot in one.others}
    received = [
        _message(frames, Key(keys.observation, run, robot), Observation | MissionEnd | FinalReport)
        for robot in named
    ]
    seen = [*[some[-1] for key, some in frames.items() if key.run == run], *answers.values()]
    return RunningMission(
        run,
        "" in alive,
        max([one.tick for one in received if isinstance(one, Observation | MissionEnd)], default=None),
        next((one.outcome for one in received if isinstance(one, MissionEnd)), None),
        tuple(sorted({version for frame in seen if (version := version_of(frame)) is not None})),
        tuple([_participant(frames, run, robot, there=robot in alive) for robot in sorted(named)]),
    )


def _participant(frames: Frames, run: str, robot: str, *, there: bool) -> Participant:
    command = _message(frames, Key(keys.command, run, robot), Command | FinalReport)
    if not isinstance(command, Command):
        return Participant(robot, there)
    return Participant(robot, there, command.tick, command.phase, command.task)


def _configs(link: zenoh.Session, run: str, robots: set[str]) -> dict[str, bytes]:
    """Return the frame of one RobotConfig of each pair or group, by robot.

    The RobotConfig names the other robots. In hardware mode, no other message does.
    """
    found: dict[str, bytes] = {}
    paired: set[str] = set()
    until = time.monotonic() + ASK_S
    for robot in sorted(robots):
        if robot not in paired and time.monotonic() < until:
            answer = session.ask(
                link, keys.config(run, robot), ASK_S, lambda frame: _decoded(frame, RobotConfig) is not None
            )
            if isinstance(answer, bytes):
                found[robot] = answer
                config = _decoded(answer, RobotConfig)  # None if it is of another version
                paired.update(config.others if config is not None else ())
    return found
