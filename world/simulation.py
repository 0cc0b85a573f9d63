"""The course of one run: the world's value, tick after tick, and its journal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from protocol.journal import environment
from protocol.journal.journal_file import CorruptJournal, Sink
from protocol.journal.resume import ReplayMismatch, Retrace
from protocol.messages import Command, DeadlineMissed, Environment, FinalReport, MissionEnd, Observation
from protocol.wire import encode
from world.referee import Judgement
from world.scenario import Scenario
from world.tick import advance, observations, release
from world.world_journal import history


class Course:
    """Whatever carries the frames, the world goes through here, so every mode journals the same bytes.

    The journal holds the scenario, every tick's Commands (in the scenario's order), MissionEnd and the FinalReports.
    """

    def __init__(self, scenario: Scenario, journal: Sink | None = None) -> None:
        self.world = release(scenario)
        self.over: MissionEnd | None = None
        """once the run is"""
        self.witnesses: tuple[str, ...] = ()
        """who answered in the tick that was the last, if they ended the run"""
        self.phase1_done_tick: dict[str, FinalReport] = {}
        """what they said to that, as far as it is on record"""
        self.missed: dict[str, list[Observation]] = {}
        """what robots have sensed since they last answered in time; a process that comes back may not know"""
        self._journal = journal
        if journal is not None:
            journal.write(encode(environment.of_world()), encode(scenario))

    @property
    def tick(self) -> int:
        """k"""
        return self.world.truth.tick

    def observations(self) -> list[Observation]:
        """What every robot senses now, in the order of the scenario."""
        return observations(self.world)

    def keep(self, journal: Sink) -> None:
        """Go on journaling there."""
        self._journal = journal

    def command(self, commands: Mapping[str, Command]) -> MissionEnd | None:
        """One tick on; or the end. A robot that is not in `commands` stands still."""
        self.recording(commands)
        return self.advance(commands)

    def recording(self, commands: Mapping[str, Command]) -> None:
        """First half of `command`: the tick is on record."""
        if self._journal is not None:
            self._journal.write(
                *[
                    encode(
                        commands[robot.id] if robot.id in commands else DeadlineMissed(self.tick, robot.id)
                    )
                    for robot in self.world.scenario.robots
                ]
            )

    def advance(self, commands: Mapping[str, Command]) -> MissionEnd | None:
        """Second half of `command`: everyone has moved."""
        if self.missed or len(commands) < len(self.world.scenario.robots):
            self._note_missed(commands)
        onward = advance(self.world, commands)
        if isinstance(onward, Judgement):
            self.witnesses = tuple(commands)
            return self.end(onward)
        self.world = onward
        return None

    def _note_missed(self, commands: Mapping[str, Command]) -> None:
        for observation in self.observations():
            if observation.robot in commands:
                self.missed.pop(observation.robot, None)
            else:
                self.missed.setdefault(observation.robot, []).append(observation)

    def end(self, judgement: Judgement) -> MissionEnd:
        """The run is over."""
        self.over = MissionEnd(self.tick, judgement.outcome, judgement.reason)
        if self._journal is not None:
            self._journal.write(encode(self.over))
        return self.over

    def final_reports(self, final_reports: Iterable[FinalReport]) -> None:
        """What the robots answered to the MissionEnd; those that answered."""
        said = {final_report.robot: final_report for final_report in final_reports}
        ids = [robot.id for robot in self.world.scenario.robots]
        latest = max([ids.index(robot) for robot in self.phase1_done_tick], default=-1)
        new = [said[robot] for robot in ids[latest + 1 :] if robot in said]
        self.phase1_done_tick |= {final_report.robot: final_report for final_report in new}
        if self._journal is not None and new:
            self._journal.write(*[encode(final_report) for final_report in new])


def again(scenario: Scenario, recording: Retrace) -> Course:
    """The course of the run that `recording` tells, as far as it has come; of none, if there is nothing in it.

    Raises CorruptJournal, also if it is that of another scenario, or if the world once went on otherwise.
    """
    course = Course(scenario)
    course.keep(recording)
    named = environment.named_in(recording.frames)
    if environment.is_blank(recording.frames):
        recording.write(encode(named or environment.of_world()), encode(scenario))
    else:
        _retrace(course, recording, named)
    return course


def _retrace(course: Course, recording: Retrace, named: Environment | None) -> None:
    lived = history(recording.frames, recording.path)
    if lived.disorder is not None:
        raise CorruptJournal(f"{recording.path}: {lived.disorder.what}")
    if lived.scenario != course.world.scenario:
        raise CorruptJournal(f"{recording.path}: the record of another scenario, {lived.scenario.name}")
    try:
        recording.write(*[encode(one) for one in (named, lived.scenario) if one is not None])
        for tick in lived.ticks:
            course.command(tick.commands)
        if lived.end is not None and course.over is None:
            course.end(Judgement(lived.end.outcome, lived.end.reason))
        course.final_reports(lived.final_reports.values())
    except ReplayMismatch:
        raise CorruptJournal(
            f"{recording.path}: on record the world went on otherwise at tick {course.tick}: "
            + (environment.otherwise(named, environment.of_world()) or "the journal is another version's")
        ) from None
