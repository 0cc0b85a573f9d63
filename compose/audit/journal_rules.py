"""Whether the journals are whole, in order and agree with each other, and everyone was briefed alike."""

from __future__ import annotations

from agent.process.agent_journal import Past, Step
from compose.audit.evidence import AgentLog, Evidence
from compose.audit.findings import Checks, Violation, between, difference
from protocol.wire import encode


def order(case: Evidence) -> Checks:
    """Every journal is whole and in its order; what is in two of them is the same in both.

    Of a journal that breaks off, or is out of order somewhere, only that is said: what there is counts.
    """
    yield _of_the_world(case)
    for robot, testimony in case.testimonies.items():
        yield _of_the_robot(case, robot, testimony)
        past = testimony.past
        if past is None:
            continue
        for step in past.steps:
            yield whole(robot, past, step, excused=case.forced)
            yield _same_drive(case, robot, past, step)
        if past.end is not None and case.history.end is not None:
            yield _same_end(case, robot, past)
            yield _same_farewell(case, robot, past)


def _of_the_world(case: Evidence) -> Violation | None:
    told = case.history
    if told.disorder is not None:
        return Violation("order", told.disorder.tick, None, told.disorder.what)
    if told.end is None:
        last = told.ticks[-1].world.truth.tick if told.ticks else None
        what = "its journal breaks off here, expected an MissionEnd"
        return Violation("order", last, None, what, breaks_off=True)
    return None


def _of_the_robot(case: Evidence, robot: str, testimony: AgentLog) -> Violation | None:
    past, end = testimony.past, case.history.end
    if testimony.missing:
        return Violation("order", None, robot, "it has left no journal", breaks_off=True)
    off = broken_off(robot, testimony)
    if past is None or off is not None:
        return off
    if end is not None and len(past.steps) != end.tick + 1 and not case.forced:
        return Violation(
            "order", end.tick, robot, f"it went through {len(past.steps)} ticks, expected {end.tick + 1}"
        )
    return None


def broken_off(robot: str, testimony: AgentLog) -> Violation | None:
    """Where its journal is out of order, or breaks off."""
    past = testimony.past
    if testimony.disorder is not None:
        return Violation("order", testimony.disorder_tick, robot, testimony.disorder)
    if past is None or past.final_report is None:
        last = past.steps[-1].observation.tick if past is not None and past.steps else None
        what = "its journal breaks off here, expected MissionEnd and Farewell"
        return Violation("order", last, robot, what, breaks_off=True)
    return None


def whole(robot: str, past: Past, step: Step, *, excused: bool) -> Violation | None:
    """Every Observation was answered, but for the last: that may have come too late, or been the last of all."""
    tick, last = step.observation.tick, step is past.steps[-1]
    if last and (past.end is None or (excused and step.command is None)):
        return None
    if step.command is None:
        return Violation("order", tick, robot, "no Command follows its Sense")
    if step.estimate is None:
        return Violation("order", tick, robot, "no Estimate follows its Drive")
    if step.missed and past.config.tick_s is None:
        return Violation("order", tick, robot, "it went without a report, expected it to wait: no real time")
    return None


def _same_drive(case: Evidence, robot: str, past: Past, step: Step) -> Violation | None:
    """The world had the Command that the robot gave."""
    tick = step.observation.tick
    if tick >= len(case.history.ticks):
        return None
    had, gave = case.command(robot, tick), step.command
    if had is None and past.config.tick_s is None:
        return Violation("order", tick, robot, "the world went without its Command, expected it to wait")
    if had is None or (gave is None and past.end is None):
        return None
    if gave is None:
        return Violation("order", tick, robot, "the world has a Command of it, expected none: it gave none")
    if encode(had) == encode(gave):
        return None
    what = f"the world's Command of it: {difference(had, gave)}"
    return Violation("order", tick, robot, what, between(had, gave))


def _same_end(case: Evidence, robot: str, past: Past) -> Violation | None:
    """The robot was told how it ended, as the world put it down."""
    assert past.end is not None
    assert case.history.end is not None
    if encode(past.end) == encode(case.history.end):
        return None
    what = f"the MissionEnd that it was told: {difference(past.end, case.history.end)}"
    return Violation("order", past.end.tick, robot, what, between(past.end, case.history.end))


def _same_farewell(case: Evidence, robot: str, past: Past) -> Violation | None:
    """The world has heard the robot's last word."""
    assert past.end is not None
    said, heard = past.final_report, case.history.final_reports.get(robot)
    if said is None:
        return None
    if heard is None:
        return Violation("order", past.end.tick, robot, "the world has no FinalReport of it", breaks_off=True)
    if encode(heard) == encode(said):
        return None
    what = f"the world's FinalReport of it: {difference(heard, said)}"
    return Violation("order", past.end.tick, robot, what, between(heard, said))


def config(case: Evidence) -> Checks:
    """Every robot was told what the scenario says, and all of them the same duration of a tick."""
    tick_s = next((past.config.tick_s for past in case.pasts.values()), None)
    for robot, past in case.pasts.items():
        expected = case.history.scenario.config(robot, tick_s)
        if encode(past.config) == encode(expected):
            yield None
        else:
            what = difference(past.config, expected)
            yield Violation("config", None, robot, what, between(past.config, expected))
