"""How an agent finds the world of its run, and is told what it needs to start."""

from __future__ import annotations

import time

import zenoh

from protocol import keys, refusal, session
from protocol.endpoints import Endpoints
from protocol.inbox import Inbox
from protocol.messages import Briefing
from protocol.refusal import FIRST_WORD_S
from protocol.wire import MalformedFrame, decode

QUERY_S = 2.0
"""how long to wait for the answer to one query"""
SESSION_S = 3.0
"""how long to look for a world through one session, or to wait for a robot's former process to be gone"""
ASK_AGAIN_S = 0.05
"""how long to wait before looking for a world again"""


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

    def go_on(self, *, linked: bool = False) -> None:
        """Wait a moment. Raises NoWorld when that has been too long, Interrupted when told to stop.

        `linked`: there is a link to a router, and nothing of a world to be seen over it.
        """
        waited = time.monotonic() - self._began
        if waited >= self._wait:
            raise NoWorld(f"no {self._what}; gave up after {self._wait:g} s: {self._why(linked)}")
        if waited >= FIRST_WORD_S and not self._told:
            self._told = True
            self._inbox.say(f"no {self._what} yet; looking for one for {self._wait:g} s: {self._why(linked)}")
        self.pause()

    def _why(self, linked: bool) -> str:
        if linked:
            return "a router answers; check that the world runs, and that its access rules name this robot"
        return refusal.why(self._endpoints) or "nobody has linked with it; check who connects to it"

    def pause(self) -> None:
        """Wait a moment, with a world in sight. Raises Interrupted when told to stop."""
        self._inbox.next(ASK_AGAIN_S)


def join(link: zenoh.Session, run: str | None, robot: str, search: Search) -> tuple[str, Briefing] | None:
    """The run that `robot` belongs to, and its briefing; `run` may name it. None after SESSION_S without.

    A robot's former process may have ended just now, and seem to be there for a moment. Raises Unwelcome
    if there are several runs, if the world has no such robot, or if somebody plays it all the time; whatever
    `search` raises while there is no world.
    """
    until = time.monotonic() + SESSION_S
    played: str | None = None
    while time.monotonic() < until:
        worlds = [key.run for key in session.alive(link, keys.world_alive(run or "*"), QUERY_S)]
        if len(worlds) > 1:
            raise Unwelcome(f"several runs are alive: {', '.join(worlds)}; choose one with --run")
        played = None
        for world in worlds:
            if session.alive(link, keys.robot_alive(world, robot), QUERY_S):
                played = world
                continue
            answer = session.ask(link, keys.briefing(world, robot), QUERY_S)
            if isinstance(answer, str):
                raise Unwelcome(answer)
            if answer is not None:
                return world, _briefing(answer, robot)
        if played is None:
            search.go_on(linked=session.linked(link))
        else:
            search.pause()
    if played is not None:
        raise Unwelcome(f"robot '{robot}' is in run '{played}' already")
    return None


def _briefing(answer: bytes, robot: str) -> Briefing:
    """The briefing of `robot` in what the world answered. Raises Unwelcome."""
    try:
        briefing = decode(answer, Briefing)
    except MalformedFrame as error:
        raise Unwelcome(f"the world's briefing is not understood: {error}") from None
    if briefing.robot != robot:
        raise Unwelcome(f"the world's briefing is for '{briefing.robot}', not for '{robot}'")
    return briefing
