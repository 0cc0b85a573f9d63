"""Audit rules for one robot: its decisions, its speed limits and the truth of its reports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from agent.planning.planner import Planner, body_of
from agent.process.agent_journal import Step
from agent.process.robot import PlannerReplay, Robot
from compose.audit.findings import Checks, Violation, unlike
from compose.launch.planner_guard import beyond_limits
from compose.launch.planner_loader import planner_of
from compose.recording.run import Run
from protocol.messages import Command, FinalReport, Message, MissionEnd, Observation, Report
from protocol.mission import Mission
from protocol.motion import Controls
from protocol.wire import MalformedFrame, decode, encode


def decision(run: Run) -> Checks:
    """Check that the planner makes each Report, Command, Estimate and FinalReport from the journaled inputs.

    The frames are compared to the bit.
    """
    for robot, agent in run.agents.items():
        replay = PlannerReplay(agent, planner_of(agent.config))
        try:
            for step in replay:
                yield from _answers(
                    replay.robot, robot, step, cut=step is agent.steps[-1] and agent.end is None
                )
            if agent.end is not None and agent.final_report is not None:
                yield _final_report(replay.robot, robot, agent.end, agent.final_report)
        except Exception as error:  # noqa: BLE001  # an exception of the planner is a violation
            what = f"the planner fails on its inputs: {type(error).__name__}: {error}"
            yield Violation("decision", replay.tick, robot, what)


def _answers(replayed: Robot, robot: str, step: Step, *, cut: bool) -> Checks:
    """Compare the messages of `replayed` in one tick with the journal.

    If `cut`, the journal ends in this tick, and messages may be missing.
    """
    tick, reports = step.observation.tick, tuple(replayed.reports.values())
    for found, expected in zip(step.reports, reports, strict=False):
        yield _same(tick, robot, found.report, found.frame, expected.frame)
    if len(step.reports) < len(reports) and not (cut and step.command is None):
        yield Violation("decision", tick, robot, "it sent no Report, expected one")
    if len(step.reports) > len(reports):
        yield Violation("decision", tick, robot, "it sent a Report, expected none: no peer is in contact")
    if step.command is not None:
        yield _same(tick, robot, step.command, step.command_frame, replayed.command_frame)
    if step.estimate is not None:
        yield _same(tick, robot, step.estimate, step.estimate_frame, replayed.estimate())


def _same(tick: int, robot: str, found: Message, frame: bytes | None, expected: bytes) -> Violation | None:
    """Return a violation if the journaled message `found`, from `frame`, does not encode to `expected`."""
    if frame == expected or encode(found) == expected:
        return None
    wanted = decode(expected, type(found))
    return unlike("decision", tick, robot, found, wanted, f"in its {type(found).__name__}, ")


def _final_report(replayed: Robot, robot: str, end: MissionEnd, found: FinalReport) -> Violation | None:
    """Compare the FinalReport.

    Its counts of refused and unused frames are taken from the journal: those frames are not journaled.
    """
    expected = replayed.final_report(
        end,
        reports_refused=found.reports_refused - replayed.damaged,
        reports_unheard=found.reports_unheard,
        frames_refused=found.frames_refused,
    )
    return _same(end.tick, robot, found, None, encode(expected))


def limits(run: Run) -> Checks:
    """Check that no robot commanded or drove more than v_max and omega_max, or named a peer that is none.

    With noise, only the commanded speeds are checked: the executed ones include wheel noise, and the
    Observation contains measurements of them.
    """
    for robot, agent in run.agents.items():
        mission, exact = agent.config.mission, agent.config.mission.noise.exact
        for step in agent.steps:
            tick, command, driven = step.observation.tick, step.command, step.observation.executed
            if command is not None:
                yield _within(tick, robot, "commanded", command, mission)
                if command.peer not in (None, *agent.config.others):
                    yield Violation(
                        "limits", tick, robot, f"its peer is {command.peer}, which it cannot meet"
                    )
            if driven is not None and exact:
                yield _within(tick, robot, "drove", driven, mission)


def _within(
    tick: int, robot: str, how: str, controls: Command | Controls, mission: Mission
) -> Violation | None:
    beyond = beyond_limits(controls.v, controls.omega, mission)
    return Violation("limits", tick, robot, f"it {how} {beyond}") if beyond is not None else None


def log(run: Run) -> Checks:
    """Check that each robot's Reports agree with its own Observations, as far as its planner defines it.

    In a `Report`, manoeuvres and ranges must be those of the Observations. Attackers are skipped. `decision`
    checks their Reports, because the attack is part of the configuration.
    """
    for robot, agent in run.agents.items():
        if agent.config.attack is not None:
            continue
        planner = planner_of(agent.config)
        observations = [step.observation for step in agent.steps]
        for step in agent.steps:
            for framed in step.reports:
                tick = step.observation.tick
                what = _misreport(planner, framed.report, observations)
                yield Violation("log", tick, robot, what) if what is not None else None


def _misreport(planner: Planner[Any, Any], report: Report, observations: Sequence[Observation]) -> str | None:
    try:
        return planner.misreport(body_of(report, planner), observations)
    except MalformedFrame as error:
        return f"it reported {error}"
