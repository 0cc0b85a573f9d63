"""Whether a robot did what follows from what it knew, kept within its limits, and told the truth."""

from __future__ import annotations

from collections.abc import Sequence

from agent.peer import peer_state
from agent.process.agent_journal import Step
from agent.process.robot import Robot
from compose.audit.evidence import Testified
from compose.audit.findings import Checks, Violation, between, difference, said
from protocol.messages import FinalReport, Message, MissionEnd, Report
from protocol.mission import Mission
from protocol.motion import Controls
from protocol.wire import decode, encode

ROUNDING = 1e-12
"""of a limit: how far rounding may put a quotient of lengths and periods beyond it"""


def decision(case: Testified) -> Checks:
    """Every Report, Command, Estimate and FinalReport is, to the bit, what the planner makes of what came in."""
    for robot, past in case.pasts.items():
        tick = None
        try:
            again = Robot(past.config)
            for step in past.steps:
                tick = step.observation.tick
                yield from _answers(again, robot, step, cut=step is past.steps[-1] and past.end is None)
            if past.end is not None and past.final_report is not None:
                yield _last_word(again, robot, past.end, past.final_report)
        except Exception as error:  # noqa: BLE001  # whatever the inputs on record do to it, is a finding
            what = f"the planner cannot go on from its inputs: {type(error).__name__}: {error}"
            yield Violation("decision", tick, robot, what)


def _answers(again: Robot, robot: str, step: Step, *, cut: bool) -> Checks:
    """What `again` does in that tick, held against the record, which lacks its end if it is `cut`."""
    tick = step.observation.tick
    told = again.observation(step.observation, step.frame)
    if told is not None and step.report is not None:
        yield _same(tick, robot, step.report.report, told.frame)
    elif told is not None and not (cut and step.command is None):
        yield Violation("decision", tick, robot, "it sent no Report, expected one")
    elif step.report is not None:
        yield Violation("decision", tick, robot, "it sent a Report, expected none: nobody is in contact")
    if step.command is not None:
        again.decide(step.heard, step.missed)
        yield _same(tick, robot, step.command, again.drive_frame)
    if step.estimate is not None:
        yield _same(tick, robot, step.estimate, again.estimate())


def _same(tick: int, robot: str, found: Message, expected: bytes) -> Violation | None:
    """What is on record is what the frame `expected` says."""
    if encode(found) == expected:
        return None
    wanted = decode(expected, type(found))
    what = f"in its {type(found).__name__}, {difference(found, wanted)}"
    return Violation("decision", tick, robot, what, between(found, wanted))


def _last_word(again: Robot, robot: str, end: MissionEnd, found: FinalReport) -> Violation | None:
    """The FinalReport; what the wire brought that was no use, only the process knows."""
    expected = again.final_report(
        end,
        reports_refused=found.reports_refused - again.damaged,
        reports_unheard=found.reports_unheard,
        frames_refused=found.frames_refused,
    )
    return _same(end.tick, robot, found, encode(expected))


def limits(case: Testified) -> Checks:
    """Nobody drove, or asked for, more than v_max and omega_max.

    With noise nobody knows what was driven but the world, whose wheels add it to what was asked.
    """
    for robot, past in case.pasts.items():
        mission = past.config.mission
        for step in past.steps:
            tick, command, driven = step.observation.tick, step.command, step.observation.executed
            if command is not None:
                yield _within(tick, robot, "asked for", Controls(command.v, command.omega), mission)
            if driven is not None and mission.noise.exact:
                yield _within(tick, robot, "drove", driven, mission)


def _within(tick: int, robot: str, how: str, controls: Controls, mission: Mission) -> Violation | None:
    for name, value, most in (
        ("v", controls.v, mission.max_speed),
        ("omega", controls.omega, mission.max_turn_rate),
    ):
        if abs(value) > most * (1.0 + ROUNDING):
            what = f"it {how} {name} = {value:g}, expected {most:g} at the most"
            return Violation("limits", tick, robot, what)
    return None


def log(case: Testified) -> Checks:
    """What a robot told of its manoeuvres and ranges is what its own Observations say.

    Who was told to lie tells, to the bit, what its lie makes of that; to which `decision` holds it.
    """
    for robot, past in case.pasts.items():
        if past.config.attack is not None:
            continue
        driven = [step.observation.executed for step in past.steps]
        ranged = [step.observation.anchor_range for step in past.steps]
        for step in past.steps:
            if step.report is not None:
                yield _as_it_was(step.observation.tick, robot, step.report.report, driven, ranged)


def _as_it_was(
    tick: int,
    robot: str,
    told: Report,
    driven: Sequence[Controls | None],
    ranged: Sequence[float | None],
) -> Violation | None:
    senseless = peer_state.contradiction(told)
    if senseless is not None:
        return Violation("log", tick, robot, f"it told {senseless}")
    k = told.since
    for run in told.runs:
        for _ in range(run.ticks):
            k += 1
            if driven[k] != Controls(run.v, run.omega):
                what = f"it told of ({run.v:g}, {run.omega:g}) until tick {k}, expected {said(driven[k])}"
                return Violation("log", tick, robot, what)
    for one in told.ranges:
        if ranged[one.tick] != one.range:
            what = f"it told of {one.range!r} m at tick {one.tick}, expected {said(ranged[one.tick])}"
            return Violation("log", tick, robot, what)
    return None
