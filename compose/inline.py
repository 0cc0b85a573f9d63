"""A whole mission in one process, without a network: the same planner, radio and world."""

from __future__ import annotations

from pathlib import Path

from agent.robot import Robot, Told
from compose.record import WORLD_JOURNAL, Moment, Record
from protocol.journal import Journal
from protocol.messages import Drive, End, Farewell
from world.course import Course
from world.faults import LATEST
from world.scenario import Scenario


def play(scenario: Scenario, out: Path | None = None) -> Record:
    """The run of `scenario`. Journals go to `out`, byte for byte those of the run as processes.

    Raises journal.CannotRecord if `out` holds a record, or cannot be written.
    """
    ids = [robot.id for robot in scenario.robots]
    journals: dict[str, Journal] = {}
    if out is not None:
        journals = {robot: Journal(out / f"agent-{robot}.journal") for robot in ids}
    world_journal = Journal(out / WORLD_JOURNAL) if out is not None else None
    course = Course(scenario, world_journal)
    robots = {robot: Robot(scenario.briefing(robot), journals.get(robot)) for robot in ids}
    moments: list[Moment] = []
    end: End | None = None
    told: dict[tuple[str, int], Told] = {}
    while end is None:
        senses = course.senses()
        for sense in senses:
            report = robots[sense.robot].sense(sense)
            if report is not None:
                told[sense.robot, sense.tick] = report
        drives: dict[str, Drive] = {}
        for sense in senses:
            heard = [told[contact.peer, tick] for contact in sense.contacts for tick in contact.heard]
            drives[sense.robot] = robots[sense.robot].decide(heard)
            if out is not None:
                robots[sense.robot].estimate()
        if len(told) > LATEST * len(ids):
            told = {key: one for key, one in told.items() if key[1] > course.tick - LATEST}
        moments.append(Moment(course.world.truth, drives))
        end = course.drive(drives)
    farewells: dict[str, Farewell] = {robot: robots[robot].farewell(end) for robot in ids}
    course.farewells(farewells.values())
    for journal in [*journals.values(), world_journal]:
        if journal is not None:
            journal.close()
    return Record(scenario, tuple(moments), end, farewells)
