"""What missions there are on a network, from a moment's listening.

Nobody does anything for a listener that they would not do anyway: signs of life are asked for once, and what
is listened to are Observations and Commands, which are said whoever listens. Truth and estimates, which are said only
while somebody listens, are left alone; so are the robots. Listening ends as soon as each has said something.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

import msgspec
import zenoh

from protocol.messages import Command, FinalReport, MissionEnd, Observation, Outcome, Phase, RobotConfig
from protocol.network import keys, session
from protocol.network.keys import Key
from protocol.wire import MalformedFrame, decode, version_of

ASK_S = 2.0
"""how long to wait for one answer"""
FIND_S = 0.5
"""how long to look for a mission where none is to be seen: routers may have been linked just now"""
LOOK_AGAIN_S = 0.02
AHEAD = 4
"""ticks by which a Command may be ahead of the latest Observation that was heard, which may come by another way"""


class Participant(msgspec.Struct, frozen=True):
    """A robot of a mission, as it was heard last."""

    robot: str
    there: bool
    """whether it shows that it is alive"""
    tick: int | None = None
    """of its latest Command; none if it said none in the time"""
    phase: Phase | None = None
    state: str | None = None


class RunningMission(msgspec.Struct, frozen=True):
    """A run, as it was heard last."""

    run: str
    world: bool
    """whether its world shows that it is alive"""
    tick: int | None
    """of the latest Observation or MissionEnd; none if none was said in the time"""
    outcome: Outcome | None
    """once it is over"""
    versions: tuple[int, ...]
    """of the wire protocol, that were heard"""
    robots: tuple[Participant, ...]
    """all that the world or a peer has named, there or not"""

    @property
    def missing(self) -> tuple[str, ...]:
        """Who ought to be there."""
        world = () if self.world else ("its world",)
        return (*world, *(one.robot for one in self.robots if not one.there))


def look(link: zenoh.Session, wait: float) -> tuple[RunningMission, ...]:
    """The missions that `link` sees; listens for `wait` s at the most. For viewers, and worlds."""
    there = _there(link)
    if not there:
        return ()
    ear = _Ear(link, there)
    ear.listen(wait)
    return tuple(_mission(link, ear, run, robots) for run, robots in there.items())


def _there(link: zenoh.Session) -> dict[str, frozenset[str]]:
    """The signs of life by run: of the robots by their names, of the world by ""."""
    until = time.monotonic() + FIND_S
    while True:
        worlds = session.alive(link, keys.world_alive("*"), ASK_S)
        robots = session.alive(link, keys.robot_alive("*", "*"), ASK_S)
        if worlds or robots or time.monotonic() >= until:
            break
        time.sleep(LOOK_AGAIN_S)
    found: dict[str, set[str]] = {}
    for key in (*worlds, *robots):
        found.setdefault(key.run, set()).add(key.robot)
    return {run: frozenset(found[run]) for run in sorted(found)}


class _Ear:
    """The latest frame of each key, and how many there were. What comes under no such key is not heard."""

    def __init__(self, link: zenoh.Session, there: dict[str, frozenset[str]]) -> None:
        self._link = link
        self._there = there
        self.latest: dict[Key, bytes] = {}
        self._count = Counter[Key]()
        self._over = False

    def listen(self, wait: float) -> None:
        """Until everybody who is there has said something; `wait` s at the most."""
        declared: list[Any] = [
            self._link.declare_subscriber(key(run, "*"), self._hand_over)
            for run in self._there
            for key in (keys.observation, keys.command)
        ]
        until = time.monotonic() + wait
        while not all(map(self._is_heard, self._there)) and time.monotonic() < until:
            time.sleep(LOOK_AGAIN_S)
        self._over = True
        for one in declared:
            one.undeclare()

    def _hand_over(self, sample: zenoh.Sample) -> None:
        if self._over:  # what comes while one key after the other is given up would be of many ticks
            return
        key = keys.parse(str(sample.key_expr))
        if key is not None:
            self.latest[key] = sample.payload.to_bytes()
            self._count[key] += 1

    def _is_heard(self, run: str) -> bool:
        """The world speaks to all its robots in turn: who is spoken to twice was so after all the others."""
        robots = self._there[run] - {""}
        if "" not in self._there[run]:
            return True
        again = any(
            self._count[Key(keys.observation, run, one)] > 1 for one in self.named(run, keys.observation)
        )
        return again and robots <= self.named(run, keys.command)

    def named(self, run: str, kind: Any) -> set[str]:
        """The robots under whose key of this kind something came."""
        return {one.robot for one in tuple(self.latest) if (one.kind, one.run) == (kind, run)}

    def said(self, key: Key, messages: Any) -> Any:
        """The latest message under `key`, if it is one of `messages` and of the robot that the key names."""
        message = _said(self.latest.get(key), messages)
        return message if getattr(message, "robot", key.robot) == key.robot else None


def _mission(link: zenoh.Session, ear: _Ear, run: str, there: frozenset[str]) -> RunningMission:
    frames = [
        ear.latest[Key(kind, run, robot)]
        for kind in (keys.observation, keys.command)
        for robot in ear.named(run, kind)
    ]
    answers = _briefings(link, run, ear.named(run, keys.observation) | there - {""}) if "" in there else {}
    frames += answers.values()
    briefed = [one for frame in answers.values() if (one := _said(frame, RobotConfig)) is not None]
    named = there - {""} | ear.named(run, keys.observation) | ear.named(run, keys.command)
    named |= {one.peer for one in briefed}
    said = [
        ear.said(Key(keys.observation, run, robot), Observation | MissionEnd | FinalReport) for robot in named
    ]
    ends = [one for one in said if isinstance(one, MissionEnd)]
    tick = max((one.tick for one in said if isinstance(one, Observation | MissionEnd)), default=None)
    return RunningMission(
        run,
        "" in there,
        tick,
        ends[0].outcome if ends else None,
        tuple(sorted({version for frame in frames if (version := version_of(frame)) is not None})),
        tuple(
            _participant(
                robot, robot in there, tick, ear.said(Key(keys.command, run, robot), Command | FinalReport)
            )
            for robot in sorted(named)
        ),
    )


def _briefings(link: zenoh.Session, run: str, robots: set[str]) -> dict[str, bytes]:
    """One of each pair, which names the other: where drivers stand in the world's place, nobody else does."""
    found: dict[str, bytes] = {}
    paired: set[str] = set()
    until = time.monotonic() + ASK_S
    for robot in sorted(robots):
        if robot not in paired and time.monotonic() < until:
            answer = session.ask(
                link, keys.config(run, robot), ASK_S, lambda frame: _said(frame, RobotConfig) is not None
            )
            if isinstance(answer, bytes):
                found[robot] = answer
                config = _said(answer, RobotConfig)
                paired |= {config.peer} if config is not None else set()
    return found


def _participant(
    robot: str, there: bool, latest: int | None, command: Command | FinalReport | None
) -> Participant:
    """As `command` tells it, unless that is of a tick to come: the world is in tick `latest`."""
    if not isinstance(command, Command) or (latest is not None and command.tick > latest + AHEAD):
        return Participant(robot, there)
    return Participant(robot, there, command.tick, command.phase, command.state)


def _said(frame: bytes | None, kind: Any) -> Any:
    """The message in a frame; none if there is none, or none that is understood here."""
    try:
        return decode(frame, kind) if frame is not None else None
    except MalformedFrame:
        return None
