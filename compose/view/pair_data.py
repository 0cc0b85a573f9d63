"""The data of robots that belong together, in a tick and in the one before."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import msgspec

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.deliveries import contact_of
from compose.view.events import Event
from compose.view.run_data import TickData
from protocol.messages import Command, Contact, Estimate
from protocol.motion import REST


class PairData(msgspec.Struct, frozen=True):
    """The robots of a pair, or one whose peer is unknown, or those of a group, with their data."""

    robots: Sequence[RobotSetup]
    """The robots, in a pair that of role a first."""
    setup: RunSetup
    before: TickData | None
    """The data of the tick before; None if it is unknown."""
    now: TickData
    events: Sequence[Event] = ()
    """The events of this tick."""
    gaps: Mapping[str, float] = {}
    """The distance in m between the true position of each attacker and the one that it reports."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of the robots."""
        return tuple([robot.id for robot in self.robots])

    @property
    def exact(self) -> bool:
        """True if sensors are exact."""
        return self.setup.mission.noise.exact

    @property
    def own_planner(self) -> bool:
        """True if phases and states are those of a planner of the user, and say nothing to others."""
        return any(robot.own_planner for robot in self.robots)

    def contact(self, data: TickData | None) -> Contact | None:
        """Return the contact of the pair in `data`, as one of its robots observes it."""
        found = [contact_of(data, robot.id, robot.peer) for robot in self.robots] if data is not None else []
        return next((one for one in found if one is not None), None)

    def held(self, robot: str) -> tuple[Estimate | None, Estimate | None]:
        """Return the robot's estimates of the tick before and of this one."""
        earlier = self.before.estimates.get(robot) if self.before is not None else None
        return earlier, self.now.estimates.get(robot)

    def estimates(self) -> Iterator[tuple[str, Estimate, Estimate]]:
        """Yield each robot with its estimates of the tick before and of this one, if both are known."""
        for robot in self.ids:
            earlier, held = self.held(robot)
            if earlier is not None and held is not None:
                yield robot, earlier, held

    def commands(self, robot: str) -> tuple[Command | None, Command | None]:
        """Return the robot's commands of the tick before and of this one."""
        earlier = self.before.commands.get(robot) if self.before is not None else None
        return earlier, self.now.commands.get(robot)

    def drove(self, robot: str) -> bool:
        """Return whether the robot has driven since the tick before."""
        observation = self.now.observations.get(robot)
        return observation is not None and observation.executed not in (None, REST)

    def begins(self, robot: str, state: str) -> bool:
        """Return whether the robot's command begins a manoeuvre of one tick with the name `state`.

        A robot that has not driven since its command of the tick before repeats it, and begins nothing.
        """
        earlier, command = self.commands(robot)
        begun = earlier is not None and earlier.task == state and not self.drove(robot)
        return command is not None and command.task == state and not begun

    def in_state(self, *states: str) -> list[str]:
        """Return the robots whose commands of this tick have one of `states`."""
        found = {robot: self.now.commands.get(robot) for robot in self.ids}
        return [robot for robot, command in found.items() if command is not None and command.task in states]
