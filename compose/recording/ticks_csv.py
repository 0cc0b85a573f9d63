"""`ticks.csv`: a row per tick and robot."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import astuple

from compose.recording.run import Recording
from protocol.motion import Pose, wrap
from world.scenario import Scenario
from world.sensors import anchor_ranges, executed, mutual_ranges
from world.truth import Truth, asked

if TYPE_CHECKING:
    from agent.process.agent_journal import Past


class TickRow(msgspec.Struct, frozen=True):
    """One robot in one tick, as `ticks.csv` has it; what is none is an empty field there."""

    tick: int
    robot: str
    x: float | None
    """true; none where there was no world to know it"""
    y: float | None
    heading: float | None
    """in (-pi, pi]"""
    v: float | None
    """driven until the next tick, without a world as measured; none in the last"""
    omega: float | None
    anchor_range: float | None
    mutual_range: float | None
    phase: int | None
    state: str | None

    @property
    def pose(self) -> Pose | None:
        """The true one, where it is known."""
        if self.x is None or self.y is None or self.heading is None:
            return None
        return Pose(self.x, self.y, self.heading)


def rows(recording: Recording) -> Iterator[TickRow]:
    """One per tick and robot, tick 0 included."""
    scenario = recording.scenario
    last = recording.moments[-1].truth.tick if recording.moments else 0
    for moment in recording.moments:
        tick = moment.truth.tick
        anchor = anchor_ranges(moment.truth, scenario)
        mutual = _mutual(scenario, moment.truth)
        for i, (robot, pose) in enumerate(zip(scenario.robots, moment.truth.poses, strict=True)):
            command = moment.commands.get(robot.id)
            v = omega = None
            if tick != last:
                done = executed(asked(command, scenario.mission), scenario, robot.id, tick)
                v, omega = done.v, done.omega
            yield TickRow(
                *(tick, robot.id, pose.x, pose.y, wrap(pose.heading), v, omega),
                *(anchor[i], mutual.get(robot.id)),
                *((command.phase, command.state) if command is not None else (None, None)),
            )


def rows_of(told: Mapping[str, Past]) -> Iterator[TickRow]:
    """The same of robots without a world: speeds as measured, and nothing of their true poses."""
    for tick in range(max([len(past.steps) for past in told.values()], default=0)):
        for robot, past in told.items():
            if tick >= len(past.steps):
                continue
            observation, command = past.steps[tick].observation, past.steps[tick].command
            after = past.steps[tick + 1].observation.executed if tick + 1 < len(past.steps) else None
            contact = past.contact(tick)
            yield TickRow(
                tick,
                robot,
                x=None,
                y=None,
                heading=None,
                v=after.v if after is not None else None,
                omega=after.omega if after is not None else None,
                anchor_range=observation.anchor_range,
                mutual_range=contact.range if contact is not None else None,
                phase=command.phase if command is not None else None,
                state=command.state if command is not None else None,
            )


def ticks_csv(recording: Recording) -> str:
    """One row per tick and robot."""
    return table(rows(recording))


def table(rows: Iterable[TickRow]) -> str:
    """`rows` as `ticks.csv` has them: floats in their shortest exact form."""
    out = io.StringIO()
    written = csv.writer(out, lineterminator="\n")
    written.writerow(TickRow.__struct_fields__)
    written.writerows([["" if one is None else one for one in astuple(row)] for row in rows])
    return out.getvalue()


def _mutual(scenario: Scenario, truth: Truth) -> dict[str, float]:
    """Everyone's range to its peer, if there is one."""
    pairs = scenario.pairs()
    return {
        scenario.robots[i].id: mutual.range
        for pair, mutual in zip(pairs, mutual_ranges(truth, scenario, pairs), strict=True)
        if mutual is not None and mutual.range is not None
        for i in pair
    }
