"""What the world says out of step with what an agent knows, and when that is believed."""

from __future__ import annotations

import time
from collections.abc import Callable

from agent.process.discovery import NoWorld
from protocol.messages import MissionEnd, Observation
from protocol.network.inbox import Inbox

BEHIND_S = 3.0
"""how long the world must go on saying what is out of step, and nothing else, to be believed: a stranger may
say anything, and in real time what lies between may be outstanding"""


class OutOfStep:
    """What has been said out of step, with nothing in step since."""

    def __init__(self, robot: str, inbox: Inbox, appear: Callable[[], None], *, real_time: bool) -> None:
        """`appear` has the world tell what was missed."""
        self._robot = robot
        self._inbox = inbox
        self._appear = appear
        self._real_time = real_time
        self._odd: tuple[Observation | MissionEnd, float] | None = None
        """the latest, and since when"""
        self._world_there = True

    def over(self) -> None:
        """Something in step has been said."""
        self._odd = None

    def world(self, *, there: bool) -> None:
        """The world has come, or gone; while it is gone, nobody is believed."""
        self._world_there, self._odd = there, None

    def observation(self, observation: Observation, known: int) -> None:
        """The world is elsewhere, if it stays there: one of the two has lost its past, or comes too late.

        `known` is the latest tick in step. In real time it tells what lies between. Raises NoWorld.
        """
        tick = observation.tick
        if self._real_time and tick < known:
            return  # told once more of what was missed
        if self._real_time and tick > known and self._odd is None:
            self._appear()  # who appears is told what it has missed
        if not self.persists(observation, BEHIND_S):
            return
        if tick == known:
            raise NoWorld(
                f"the record is another run's: in this one, {self._robot} senses otherwise at tick {tick}"
            )
        late = "too late" if tick > known else "started again without its record"
        raise NoWorld(f"{late}: the world is at tick {tick}, {self._robot} knows it up to {known}")

    def persists(self, message: Observation | MissionEnd, bound_s: float) -> bool:
        """Whether the world has said `message`, and nothing in step, for `bound_s`; until then it is refused.

        In lockstep it would say the same over and over; in real time its Observations go on.
        """
        now = time.monotonic()
        goes_on = self._real_time and isinstance(message, Observation)
        if self._odd is None or not (message == self._odd[0] or goes_on):
            self._odd = message, now
        if self._world_there and now - self._odd[1] >= bound_s:
            return True
        if not goes_on:
            self._inbox.refused["observation"] += 1  # it is told once it is believed
        return False
