"""Messages of the world that do not fit the tick of the agent, and the rule for accepting them."""

from __future__ import annotations

from collections.abc import Callable

from agent.process.discovery import NoWorld
from protocol.messages import MissionEnd, Observation
from protocol.network.inbox import Inbox

BEHIND_S = 3.0
"""The seconds for which the world must send only messages that are out of step, before they are accepted.

An unknown process may send anything, and in real time the ticks in between may still be on the way.
"""


class OutOfStep:
    """The messages received out of step since the last message in step."""

    def __init__(self, robot: str, inbox: Inbox, appear: Callable[[], None], *, real_time: bool) -> None:
        """Start with no message out of step. `appear` makes the world send missed ticks again."""
        self._robot = robot
        self._inbox = inbox
        self._appear = appear
        self._real_time = real_time
        self._latest: tuple[Observation | MissionEnd, float] | None = None
        """The latest message, and the time of the first in the series."""
        self._world_there = True

    def over(self) -> None:
        """Forget the series, because a message in step has arrived."""
        self._latest = None

    def world(self, *, there: bool) -> None:
        """Note that the world has appeared or gone. While it is gone, no message out of step is accepted."""
        self._world_there, self._latest = there, None

    def observation(self, observation: Observation, latest: int) -> None:
        """Handle an Observation out of step. Raises NoWorld if the world keeps sending such Observations.

        In that case the agent or the world has lost its recording, or the agent is too late. `latest` is the
        latest tick in step. In real time the world can still send the ticks in between.
        """
        tick = observation.tick
        if self._real_time and tick < latest:
            return  # a repetition of a tick that was already processed
        if self._real_time and tick > latest and self._latest is None:
            self._appear()  # the world sends the missed ticks to a robot that appears
        if not self.persists(observation, BEHIND_S):
            return
        if tick == latest:
            raise NoWorld(
                f"the recording belongs to another run: "
                f"its Observation of {self._robot} at tick {tick} differs"
            )
        late = "too late" if tick > latest else "the world was restarted without its recording"
        raise NoWorld(f"{late}: the world is at tick {tick}, {self._robot} at tick {latest}")

    def persists(self, message: Observation | MissionEnd, bound_s: float) -> bool:
        """Return whether only messages like `message` have arrived for `bound_s` seconds.

        Until then, the message is refused. In lockstep the world repeats one message. In real time its
        Observations advance.
        """
        now = self._inbox.clock()
        advances = self._real_time and isinstance(message, Observation)
        if self._latest is None or not (message == self._latest[0] or advances):
            self._latest = message, now
        if self._world_there and now - self._latest[1] >= bound_s:
            return True
        if not advances:
            self._inbox.refused["observation"] += 1  # counted only: the error is reported once it is accepted
        return False
