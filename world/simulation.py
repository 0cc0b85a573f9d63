"""The simulation of one run, with its journal. It does no other I/O."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import msgspec

from protocol.journal import environment
from protocol.journal.journal_file import CorruptJournal, Sink
from protocol.journal.resume import ReplayMismatch, Retrace
from protocol.messages import Command, DeadlineMissed, FinalReport, MissionEnd, Observation
from protocol.wire import encode
from world.scenario import Scenario
from world.tick import advance, observations, release
from world.world_journal import world_history


class Simulation:
    """The simulation of one run. All modes of execution use it, so they all write the same journal.

    The journal contains the environment, the scenario, the Commands of each tick in the scenario's order,
    MissionEnd and the FinalReports.
    """

    def __init__(
        self,
        scenario: Scenario,
        journal: Sink | None = None,
        encode: Callable[[msgspec.Struct], bytes] = encode,
    ) -> None:
        """`encode` returns the frame of a message."""
        self._encode = encode
        self.world = release(scenario)
        self.mission_end: MissionEnd | None = None
        """The end of the run; None while it is running."""
        self.last_answered: tuple[str, ...] = ()
        """The robots that answered in the last tick; empty unless their results ended the run."""
        self.final_reports: dict[str, FinalReport] = {}
        """The journaled FinalReports, by robot."""
        self.missed: dict[str, list[Observation]] = {}
        """The Observations of each robot since its last Command in time, which a restarted agent may lack."""
        self._journal = journal
        if journal is not None:
            journal.write(encode(environment.of_world()), encode(scenario))

    @property
    def tick(self) -> int:
        """The tick k."""
        return self.world.truth.tick

    def observations(self) -> list[Observation]:
        """Return the Observation of each robot, in the order of the scenario."""
        return observations(self.world)

    def append_to(self, journal: Sink) -> None:
        """Write all frames from now on to `journal`."""
        self._journal = journal

    def command(self, commands: Mapping[str, Command]) -> MissionEnd | None:
        """Journal and execute the Commands of this tick; return the MissionEnd, or None if the run continues.

        A robot that is not in `commands` rests for this tick. Raises CannotRecord.
        """
        self.journal_commands(commands)
        return self.advance(commands)

    def journal_commands(self, commands: Mapping[str, Command]) -> None:
        """Journal the Commands of this tick: the first half of `command`. Raises CannotRecord."""
        if self._journal is not None:
            self._journal.write(
                *[
                    self._encode(
                        commands[robot.id] if robot.id in commands else DeadlineMissed(self.tick, robot.id)
                    )
                    for robot in self.world.scenario.robots
                ]
            )

    def advance(self, commands: Mapping[str, Command]) -> MissionEnd | None:
        """Execute the Commands of this tick: the second half of `command`."""
        if self.missed or len(commands) < len(self.world.scenario.robots):
            self._note_missed(commands)
        onward = advance(self.world, commands)
        if isinstance(onward, MissionEnd):
            self.last_answered = tuple(commands)
            return self.end(onward)
        self.world = onward
        return None

    def _note_missed(self, commands: Mapping[str, Command]) -> None:
        for observation in self.observations():
            if observation.robot in commands:
                self.missed.pop(observation.robot, None)
            else:
                self.missed.setdefault(observation.robot, []).append(observation)

    def end(self, end: MissionEnd) -> MissionEnd:
        """End the run with `end`, and journal and return it. Raises CannotRecord."""
        self.mission_end = end
        if self._journal is not None:
            self._journal.write(self._encode(end))
        return end

    def journal_final_reports(self, final_reports: Iterable[FinalReport]) -> None:
        """Journal the FinalReports that are not in the journal yet, in the order of the scenario.

        To keep this order, the FinalReport of a robot is dropped if one of a later robot has been journaled.
        Raises CannotRecord.
        """
        received = {final_report.robot: final_report for final_report in final_reports}
        ids = [robot.id for robot in self.world.scenario.robots]
        latest = max([ids.index(robot) for robot in self.final_reports], default=-1)
        new = [received[robot] for robot in ids[latest + 1 :] if robot in received]
        self.final_reports |= {final_report.robot: final_report for final_report in new}
        if self._journal is not None and new:
            self._journal.write(*[self._encode(final_report) for final_report in new])


def resumed(scenario: Scenario, recording: Retrace) -> Simulation:
    """Return the simulation at the end of the journal `recording`; at tick 0 if the journal is empty.

    Raises CorruptJournal if the journal is damaged, has another scenario, or differs from this simulation.
    """
    simulation = Simulation(scenario)
    simulation.append_to(recording)
    if len(recording.frames) > 1:
        _retrace(simulation, recording)
    else:
        recording.write(*(recording.frames or [encode(environment.of_world())]), encode(scenario))
    return simulation


def _retrace(simulation: Simulation, recording: Retrace) -> None:
    recorded = world_history(recording.frames, recording.path)
    if recorded.unexpected is not None:
        raise CorruptJournal(f"{recording.path}: {recorded.unexpected.what}")
    if recorded.scenario != simulation.world.scenario:
        raise CorruptJournal(f"{recording.path}: a recording of another scenario, {recorded.scenario.name}")
    try:
        recording.write(encode(recorded.environment), encode(recorded.scenario))
        for tick in recorded.ticks:
            simulation.command(tick.commands)
        if recorded.end is not None and simulation.mission_end is None:
            simulation.end(recorded.end)
        simulation.journal_final_reports(recorded.final_reports.values())
    except ReplayMismatch:
        what = f"world differs from the recomputed one at tick {simulation.tick}"
        raise recording.differing(what, recorded.environment, environment.of_world()) from None
