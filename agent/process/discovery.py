"""How an agent finds the world of its run, and is told what it needs to start."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import zenoh

from protocol.messages import RobotConfig
from protocol.network import diagnosis, keys, session
from protocol.network.diagnosis import FIRST_WORD_S
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Inbox
from protocol.wire import MalformedFrame, decode

QUERY_S = 2.0
"""how long to wait for the answer to one query"""
SESSION_S = 3.0
"""how long to look for a world through one session, or to wait for a robot's former process to be gone"""
ASK_AGAIN_S = 0.05
"""how long to wait before looking for a world again"""


REFUSED_S = 1.0
"""how long a refusal must last, with no briefing beside it, to be believed"""
MOST_WORLDS = 8
"""worlds that are asked for a briefing; anybody may show any number of them"""


class Unwelcome(Exception):
    """There is a world, but this robot cannot join it; says why."""


class NoWorld(TimeoutError):
    """There is no world within the wait, or none to go on with; says so."""


class Search:
    """Looking for a world, for `wait` seconds at the most, and saying so after FIRST_WORD_S."""

    def __init__(self, what: str, endpoints: Endpoints, wait: float, inbox: Inbox) -> None:
        self._what = f"{what} at {endpoints}"
        self._endpoints = endpoints
        self._wait = wait
        self._inbox = inbox
        self._began = time.monotonic()
        self._told = False

    def go_on(self, *, linked: bool = False, why: str | None = None) -> None:
        """Wait a moment. Raises NoWorld when that has been too long, Interrupted when told to stop.

        `linked`: there is a link to a router. `why` says what is wrong with what is seen over it.
        """
        waited = time.monotonic() - self._began
        if waited >= self._wait:
            raise NoWorld(f"no {self._what}; gave up after {self._wait:g} s: {why or self._why(linked)}")
        if waited >= FIRST_WORD_S and not self._told:
            self._told = True
            self._inbox.say(
                f"no {self._what} yet; looking for one for {self._wait:g} s: {why or self._why(linked)}"
            )
        self.pause()

    def _why(self, linked: bool) -> str:
        if linked:
            return "a router answers; check that the world runs, and that its access rules name this robot"
        return diagnosis.why(self._endpoints) or "nobody has linked with it; check who connects to it"

    def pause(self) -> None:
        """Wait a moment, with a world in sight. Raises Interrupted when told to stop."""
        self._inbox.next(ASK_AGAIN_S)


class _Offers(NamedTuple):
    """The answers to a robot of the worlds that are alive."""

    configs: dict[str, RobotConfig]
    """by run"""
    played: str | None
    """a run in which the robot is there already"""
    refused: str | None
    strange: str | None
    """why an answer is not understood"""


def join(link: zenoh.Session, run: str | None, robot: str, search: Search) -> tuple[str, RobotConfig] | None:
    """Return the run that `robot` belongs to, and its briefing; None after SESSION_S without.

    `run` may name it. A robot's former process may have ended just now, and seem to be there for a moment.
    Strangers may show and answer anything, so a refusal is believed once it lasts for REFUSED_S.

    Raises Unwelcome if there are several runs, if the world has no such robot, or if somebody plays it all
    the time; whatever `search` raises while there is no world.
    """
    until = time.monotonic() + SESSION_S
    refused: float | None = None
    played: str | None = None
    while time.monotonic() < until:
        worlds = [key.run for key in session.alive(link, keys.world_alive(run or "*"), QUERY_S)]
        offers = _offers(link, worlds[:MOST_WORLDS], robot)
        if len(offers.configs) > 1:
            raise Unwelcome(f"several runs are alive: {', '.join(offers.configs)}; choose one with --run")
        for found, config in offers.configs.items():
            return found, config
        played = offers.played
        if offers.refused is None:
            refused = None
        elif refused is None:
            refused = time.monotonic()
        elif time.monotonic() > refused + REFUSED_S:
            raise Unwelcome(offers.refused)
        if played is None and offers.refused is None:
            search.go_on(linked=session.linked(link), why=offers.strange)
        else:
            search.pause()
    if played is not None:
        raise Unwelcome(f"robot '{robot}' is in run '{played}' already")
    return None


def _offers(link: zenoh.Session, worlds: Sequence[str], robot: str) -> _Offers:
    briefings: dict[str, RobotConfig] = {}
    played = refused = strange = None
    for world in worlds:
        if session.alive(link, keys.robot_alive(world, robot), QUERY_S):
            played = world
            continue
        key = keys.config(world, robot)
        answer = session.ask(
            link, key, QUERY_S, lambda frame: isinstance(_briefing(frame, robot), RobotConfig)
        )
        if isinstance(answer, str):
            refused = answer
        elif answer is not None:
            found = _briefing(answer, robot)
            if isinstance(found, RobotConfig):
                briefings[world] = found
            else:
                strange = found
    return _Offers(briefings, played, refused, strange)


def _briefing(answer: bytes, robot: str) -> RobotConfig | str:
    """Return the briefing of `robot` in a world's answer, or why there is none in it."""
    try:
        config = decode(answer, RobotConfig)
    except MalformedFrame as error:
        return f"the world's briefing is not understood: {error}"
    if config.robot != robot:
        return f"the world's briefing is for '{config.robot}', not for '{robot}'"
    return config
