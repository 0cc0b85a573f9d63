"""Discovery: find the world of a run, and request the RobotConfig from it."""

from __future__ import annotations

import os
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
"""The seconds to wait for the answer to one query."""
SESSION_S = 3.0
"""The seconds to search through one session."""
FORMER_S = 10.0
"""The seconds to wait for a robot's former process to disappear.

It may need five seconds to end after its launcher was killed, and two to close its session. Its link has a
lease of two seconds.
"""
REFUSED_S = 1.0
"""The seconds for which a refusal must persist, without a RobotConfig from any world, to be accepted."""
MOST_WORLDS = 8
"""The largest number of worlds that are asked, because a process may announce any number of them."""


class Unwelcome(Exception):
    """There is a world, but this robot cannot join it. The text gives the reason."""


class NoWorld(TimeoutError):
    """No world was found in time, or the run cannot be resumed with it. The text gives the reason."""


class Search:
    """A search for a world that lasts at most `wait` s, and is reported to the user after FIRST_WORD_S."""

    def __init__(self, what: str, endpoints: Endpoints, wait: float, inbox: Inbox) -> None:
        self._what = f"{what} at {endpoints}"
        self._endpoints = endpoints
        self._wait = wait
        self._inbox = inbox
        self.process = os.urandom(8)
        """The identifier by which a world tells this process from another one of the same robot."""
        self._began = inbox.clock()
        self._reported = False

    def wait(self, *, linked: bool = False, why: str | None = None) -> None:
        """Wait briefly before the next attempt.

        `linked` is whether the session has a link to a router. `why` explains why an answer was unusable.

        Raises NoWorld when the search has lasted too long, and Interrupted when the process is asked to stop.
        """
        waited = self._inbox.clock() - self._began
        if waited >= self._wait:
            raise NoWorld(f"no {self._what}; gave up after {self._wait:g} s: {why or self._why(linked)}")
        if waited >= FIRST_WORD_S and not self._reported:
            self._reported = True
            self._inbox.say(
                f"no {self._what} yet; searching for up to {self._wait:g} s: {why or self._why(linked)}"
            )
        self.pause()

    def _why(self, linked: bool) -> str:
        if linked:
            return "a router answers; check that the world runs, and that its access rules name this robot"
        return diagnosis.why(self._endpoints) or "no process has connected to it; check the others' endpoints"

    def clock(self) -> float:
        """Return the time in s."""
        return self._inbox.clock()

    def pause(self) -> None:
        """Wait briefly while a world is visible. Raises Interrupted when the process is asked to stop."""
        self._inbox.next(session.ASK_AGAIN_S)


class _Offers(NamedTuple):
    """The answers that the worlds gave to one robot."""

    configs: dict[str, RobotConfig]
    """The RobotConfig from each run."""
    occupied: str | None
    """A run in which a process for this robot is already alive."""
    refused: str | None
    unusable: str | None
    """The reason why an answer could not be used."""


def join(link: zenoh.Session, run: str | None, robot: str, search: Search) -> tuple[str, RobotConfig] | None:
    """Return the run that `robot` belongs to, and its RobotConfig; None if none is found within SESSION_S.

    `run` may name the run. A former process of the robot may have ended a moment ago and still appear alive,
    for up to FORMER_S. Unknown processes may announce and answer anything, so a refusal is accepted only
    after REFUSED_S, also if the world ends meanwhile.

    Raises Unwelcome if there are several runs, if the world has no such robot, or if another process for this
    robot stays alive, or did so until the world ended. Raises whatever `search` raises while there is no
    world.
    """
    began = search.clock()
    refused_since: float | None = None
    occupied: str | None = None
    second: str | None = None  # the last refusal while another process of the robot was alive
    while search.clock() < began + (SESSION_S if occupied is None and second is None else FORMER_S):
        worlds = [key.run for key in session.alive(link, keys.world_alive(run or "*"), QUERY_S)]
        offers = _offers(link, worlds[:MOST_WORLDS], robot, search.process)
        if len(offers.configs) > 1:
            raise Unwelcome(f"several runs are alive: {', '.join(offers.configs)}; choose one with --run")
        for robot_run, config in offers.configs.items():
            return robot_run, config
        occupied = offers.occupied
        if occupied is not None:
            second = offers.refused or second
        why = offers.refused or second
        if why is None or occupied is not None:
            refused_since = None
        elif refused_since is None:
            refused_since = search.clock()
        elif search.clock() > refused_since + REFUSED_S:
            raise Unwelcome(why)
        if occupied is None and why is None:
            search.wait(linked=session.linked(link), why=offers.unusable)
        else:
            search.pause()
    refusal = second or (occupied and session.occupied(robot, occupied))
    if refusal:
        raise Unwelcome(refusal)
    return None


def _offers(link: zenoh.Session, worlds: Sequence[str], robot: str, process: bytes) -> _Offers:
    configs: dict[str, RobotConfig] = {}
    occupied = refused = unusable = None
    for world in worlds:
        if is_occupied := bool(session.alive(link, keys.robot_alive(world, robot), QUERY_S)):
            occupied = world
        answer = _answer(link, world, robot, process)
        if isinstance(answer, str):
            refused = answer
        elif answer is not None and not is_occupied:
            config = _decoded_config(answer, robot)
            if isinstance(config, str):
                unusable = config
            else:
                configs[world] = config
    return _Offers(configs, occupied, refused, unusable)


def _answer(link: zenoh.Session, world: str, robot: str, process: bytes) -> bytes | str | None:
    """Return the answer of `world` to the query of `process` for the RobotConfig of `robot`."""
    key = keys.config(world, robot)
    return session.ask(
        link, key, QUERY_S, lambda frame: not isinstance(_decoded_config(frame, robot), str), process
    )


def confirm(link: zenoh.Session, run: str, robot: str, search: Search) -> None:
    """Ask again for the RobotConfig of `robot`, just before its liveliness token appears.

    The world reserves it for a short time only, and this process may have needed longer until it was ready.
    Raises Unwelcome if another process has it since, for REFUSED_S.
    """
    began = search.clock()
    while isinstance(why := _answer(link, run, robot, search.process), str):
        if search.clock() > began + REFUSED_S:
            raise Unwelcome(why)
        search.pause()


def _decoded_config(answer: bytes, robot: str) -> RobotConfig | str:
    """Return the RobotConfig of `robot` in the answer of a world, or the reason why there is none."""
    try:
        config: RobotConfig = decode(answer, RobotConfig)
    except MalformedFrame as error:
        return f"the world's RobotConfig cannot be decoded: {error}"
    if config.robot != robot:
        return f"the world's RobotConfig is for '{config.robot}', not for '{robot}'"
    return config
