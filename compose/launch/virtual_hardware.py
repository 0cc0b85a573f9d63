"""A mission in hardware mode whose drivers and agents are threads of this process, in virtual time.

The robots are simulated: each moves for the true time of a manoeuvre, whatever its clock shows, and has the
world's sensors. Two robots measure their range if both are in the same tick: each waits for the others, as
long as `sense` may take if ranges may drop out, and otherwise as long as it takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, cast

from compose.hardware.driver_recording import recorded
from compose.launch.virtual_processes import (
    DRIVER,
    RUN,
    VIRTUAL_TIMEOUT_S,
    VirtualNetwork,
    VirtualProcess,
    agent_process,
)
from compose.recording.run import read
from compose.scenario.kills import Kill
from protocol.messages import Cause, Localised, MissionEnd
from protocol.motion import REST, Controls, Pose, step
from protocol.network.clock import ClockError
from world.hardware.bridge import Field
from world.hardware.driver import SENSING, THINKING, Reading
from world.referee import mistake
from world.scenario import Scenario
from world.sensors import Mutual, anchor_ranges, executed, in_contact, odometry
from world.tick import release
from world.truth import Truth


class HardwareEnd(NamedTuple):
    """The end of a mission in hardware mode."""

    ends: Mapping[str, MissionEnd]
    """The end of each robot whose driver has not failed with an error."""
    wrong: tuple[Cause, ...]
    """The wrong claims."""
    failures: tuple[str, ...]
    """The errors with which processes ended, in their order."""
    seconds: float
    """The duration in s of virtual time."""


def run_hardware(
    scenario: Scenario,
    folder: Path,
    clocks: Mapping[str, ClockError] = MappingProxyType({}),
    kills: Sequence[Kill] = (),
) -> HardwareEnd:
    """Run `scenario` in hardware mode, write its journals to `folder`, and return how it ended.

    `clocks` are the errors of the clocks of robots, by id; the driver and the agent of a robot have the same
    clock. Agents that are killed restart.
    """
    manoeuvre_s = scenario.mission.period
    network = VirtualNetwork(scenario, folder, kills, clocks, (1.0 + THINKING) * manoeuvre_s)
    ground, ends = _Ground(network, manoeuvre_s), dict[str, MissionEnd]()
    drivers = {DRIVER + one.id: partial(_driver_process, ground, ends) for one in scenario.robots}
    network.run({**drivers, **{one.id: agent_process for one in scenario.robots}})
    return HardwareEnd(ends, _wrong(ground, folder), tuple(network.failures), network.now)


def _driver_process(
    ground: _Ground, ends: dict[str, MissionEnd], network: VirtualNetwork, process: VirtualProcess
) -> None:
    """Run the driver of a robot to the end of the mission, as `tandem robot` does."""
    robot, arguments = process.name.removeprefix(DRIVER), process.arguments()
    config = network.scenario.config(robot, network.tick_s)
    driver = ground.bodies[robot]
    driver.process = process
    with recorded(network.folder, config, arguments["inbox"], fsync=False) as recording:
        field = Field(
            driver,
            config,
            RUN,
            arguments["inbox"],
            max_ticks=network.scenario.max_ticks,
            manoeuvre_s=ground.manoeuvre_s,
            timeout=VIRTUAL_TIMEOUT_S,
            journal=recording.journal,
        )
        field.attach(cast(Any, process.link))
        ends[robot] = field.run_mission(VIRTUAL_TIMEOUT_S, lambda: None)


def _wrong(ground: _Ground, folder: Path) -> tuple[Cause, ...]:
    """Return the wrong claims in the journals of the agents."""
    run, found = read(folder), list[Cause | None]()
    for robot, body in ground.bodies.items():
        before: Any = None
        for tick, pose in sorted(body.sensed.items()):
            command = run.command(robot, tick) if robot in run.robots and tick < run.length else None
            claim = command.verdict if command is not None else before
            if isinstance(claim, Localised) and claim != before:
                found.append(mistake(robot, claim, pose, ground.scenario.mission))
            before = claim
    return tuple([one for one in found if one is not None])


class _Ground:
    """The robots, and the ranges between them."""

    def __init__(self, network: VirtualNetwork, manoeuvre_s: float) -> None:
        self.network, self.scenario, self.manoeuvre_s = network, network.scenario, manoeuvre_s
        released = release(self.scenario)
        self.pairs, self.origins = released.pairs, released.truth.origins
        ids = [one.id for one in self.scenario.robots]
        self.bodies = {one: _Body(self, i, released.truth.local[i]) for i, one in enumerate(ids)}
        drop_outs = self.scenario.sensors.noise.drop_outs
        self.patience_s = SENSING * manoeuvre_s if drop_outs else VIRTUAL_TIMEOUT_S

    def truth(self, tick: int) -> Truth:
        """Return the poses now, for sensors that measure in `tick`."""
        return Truth(tick, tuple([one.pose for one in self.bodies.values()]), self.origins)

    def contacts(self, tick: int, place: int) -> dict[int, Mutual]:
        """Return the ranges to the robot at `place`, by the other's place, as if all were in `tick`."""
        found = in_contact(self.truth(tick), self.scenario, self.pairs)
        return {i + j - place: mutual for (i, j), mutual in found.items() if place in (i, j)}

    def wake_asking(self) -> None:
        """Let those go on that wait for others to measure ranges."""
        for body in self.bodies.values():
            if body.asks:
                self.network.at(self.network.now, body.process.wake)


class _Body:
    """The driver of a simulated robot."""

    process: VirtualProcess

    def __init__(self, ground: _Ground, place: int, start: Pose) -> None:
        self._ground, self._place, self._start = ground, place, start
        self._id = ground.scenario.robots[place].id
        self._controls, self._began, self._done = REST, 0.0, 1.0
        """The manoeuvre, the time in s of its beginning, and the fraction of it that is in `_start`."""
        self._driven = self._before = REST
        """The motion since the last reading, and that before it."""
        self._ranges: dict[str, float | None] = {}
        """The ranges of the latest tick."""
        self._is_parked = False
        self.asks = False
        """True while it waits for others to measure ranges."""
        self.tick = -1
        """The tick of the latest reading."""
        self.sensed: dict[int, Pose] = {}
        """The true pose in <W> in each tick."""

    @property
    def pose(self) -> Pose:
        """The pose now, relative to the origin of the robot's pair."""
        share, period = self._share(), self._ground.scenario.mission.period
        return step(self._start, self._controls.v * share, self._controls.omega * share, period)

    def _share(self) -> float:
        """Return the fraction of the manoeuvre that has been driven and is not in `_start`."""
        driven = min(1.0, (self._ground.network.now - self._began) / self._ground.manoeuvre_s + 1e-9)
        return max(0.0, driven - self._done)

    def _settle(self) -> None:
        """Move what has been driven of the manoeuvre into `_start` and `_driven`."""
        share, self._start = self._share(), self.pose
        self._done += share
        driven = self._driven
        self._driven = Controls(
            driven.v + self._controls.v * share, driven.omega + self._controls.omega * share
        )

    def sense(self, tick: int) -> Reading:
        """Return the odometry, and the ranges at the pose now and of those who come to the tick."""
        ground, scenario, i = self._ground, self._ground.scenario, self._place
        self._settle()
        self.tick, self._ranges = tick, {}
        moved, origin = self._driven, ground.origins[i]
        if not scenario.sensors.exact:
            moved = odometry(moved, scenario, self._id, tick, self._before)
        self._before, self._driven = self._driven, REST
        pose = self.pose
        self.sensed[tick] = Pose(origin.x + pose.x, origin.y + pose.y, pose.heading)
        anchors = {one.anchor: one.range for one in anchor_ranges(ground.truth(tick), scenario)[i]}
        self._measure()
        own = next(iter(anchors.values()), None)
        if scenario.team is None:
            return Reading(moved, own, mutual_ranges=self._ranges)
        return Reading(moved, None, mutual_ranges=self._ranges, anchors=anchors)

    def _measure(self) -> None:
        """Measure the ranges to those that wait for it; wait for the others, and say which are near."""
        ground, tick, others = self._ground, self.tick, [*self._ground.bodies.values()]
        others.remove(self)
        mutual = ground.contacts(tick, self._place)
        for other in others:
            if other._place in mutual and (other._is_parked or (other.asks and other.tick == tick)):
                self._ranges[other._id] = other._ranges[self._id] = mutual[other._place].range
        ground.wake_asking()
        self.asks, until = True, ground.network.now + ground.patience_s
        while any(one.tick < tick and not one._is_parked for one in others) and ground.network.now < until:
            self.process.wait(until)
        self.asks = False
        mutual = ground.contacts(tick, self._place)
        for other in others:
            if other._place in mutual:
                self._ranges.setdefault(other._id, None)

    def drive(self, v: float, omega: float) -> None:
        """Hold `v` and `omega` for a manoeuvre of true time. The rest of the one before is not driven."""
        self._settle()
        scenario, controls = self._ground.scenario, Controls(v, omega)
        if not scenario.sensors.exact:
            controls = executed(controls, scenario, self._id, self.tick)
        self._controls, self._began, self._done = controls, self._ground.network.now, 0.0

    def stop(self) -> None:
        """Stop, and stay available for the ranges of others."""
        self._settle()
        self._controls, self._is_parked = REST, True
        self._ground.wake_asking()

    def close(self) -> None:
        """Do nothing."""
