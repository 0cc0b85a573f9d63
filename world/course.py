"""The course of one run: the world's value, tick after tick, and its journal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from protocol.journal import Sink
from protocol.messages import Drive, End, Farewell, Missed, Sense
from protocol.wire import encode
from world.referee import Judgement
from world.scenario import Scenario
from world.tick import advance, release, senses


class Course:
    """Whatever carries the frames, the world goes through here, so every mode journals the same bytes.

    The journal holds the scenario, every tick's Drives (in the scenario's order), End and the Farewells.
    """

    def __init__(self, scenario: Scenario, journal: Sink | None = None) -> None:
        self.world = release(scenario)
        self._journal = journal
        if journal is not None:
            journal.write(encode(scenario))

    @property
    def tick(self) -> int:
        """k"""
        return self.world.truth.tick

    def senses(self) -> list[Sense]:
        """What every robot senses now, in the order of the scenario."""
        return senses(self.world)

    def drive(self, drives: Mapping[str, Drive]) -> End | None:
        """One tick on; or the end. A robot that is not in `drives` stands still."""
        world = self.world
        if self._journal is not None:
            tick = world.truth.tick
            ids = [robot.id for robot in world.scenario.robots]
            self._journal.write(
                *[encode(drives[robot] if robot in drives else Missed(tick, robot)) for robot in ids]
            )
        onward = advance(world, drives)
        if isinstance(onward, Judgement):
            return self.end(onward)
        self.world = onward
        return None

    def end(self, judgement: Judgement) -> End:
        """The run is over."""
        end = End(self.tick, judgement.outcome, judgement.reason)
        if self._journal is not None:
            self._journal.write(encode(end))
        return end

    def farewells(self, farewells: Iterable[Farewell]) -> None:
        """What the robots answered to the End; those that answered."""
        if self._journal is not None:
            said = {farewell.robot: farewell for farewell in farewells}
            ids = [robot.id for robot in self.world.scenario.robots if robot.id in said]
            self._journal.write(*[encode(said[robot]) for robot in ids])
