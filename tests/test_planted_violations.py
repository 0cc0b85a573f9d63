"""The audit finds and locates each violation that is planted into a correct recording."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from agent.planning.paper import Paper
from agent.planning.state import RobotState
from compose.launch import in_process
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import read
from compose.scenario.scenario_file import load, parse
from protocol.attack import Attack
from protocol.messages import (
    Cause,
    Command,
    Contact,
    DeadlineMissed,
    Estimate,
    FinalReport,
    Localised,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
    Undecided,
)
from protocol.mission import Anchor
from protocol.motion import Covariance, Segment
from tests.commands import SECTION_IV, anchored, several_pairs
from tests.planted import LAST, A, B, Edit, audit, found, messages, nothing, of, plant, to, what, written
from world.scenario import Scenario


@pytest.fixture
def folder(paper_1: Path, tmp_path: Path) -> Path:
    """Return a copy of the recording of paper-1, which the test may change."""
    return Path(shutil.copytree(paper_1, tmp_path / "record"))


NOISE = f"""
name = "noise"
seed = SEED
{SECTION_IV}
noise.anchor_sigma = 0.01
noise.mutual_sigma = 0.01
noise.outliers = 0.05
noise.drop_outs = 0.1
noise.actuation = {{v = 0.01, omega = 0.01, v_floor = 1e-4, omega_floor = 1e-4}}
noise.odometry = {{v = 0.01, omega = 0.01, v_floor = 1e-4, omega_floor = 1e-4}}
[planner]
name = "VARIANT"
{anchored(a=(0.0, 0.0), b=(6.0, 0.0))}
"""


def noise(seed: int, planner_name: str, outliers: float = 0.05) -> Scenario:
    text = NOISE.replace("outliers = 0.05", f"outliers = {outliers}")
    return parse(text.replace("SEED", str(seed)).replace("VARIANT", planner_name), "noise")


def test_commands_in_another_order_are_found_and_later_frames_are_not_read(folder: Path) -> None:
    told = messages(folder / WORLD_JOURNAL)
    a, b = (i for i, one in enumerate(told) if isinstance(one, Command) and one.tick == 12)
    told[a], told[b] = told[b], told[a]
    written(folder / WORLD_JOURNAL, told)
    findings = audit(folder)
    assert [one.line for one in findings.violations] == [
        "tick 12, the world, order: a Command of b of tick 12 is out of order"
    ]
    assert findings.ticks == 11


def test_a_tick_that_an_agent_has_left_out_is_missed(folder: Path) -> None:
    told = [one for one in messages(folder / A) if getattr(one, "tick", None) != 12]
    written(folder / A, told)
    assert [one.line for one in audit(folder).violations] == [
        "tick 13, a, order: an Observation of a of tick 13 is out of order"
    ]


def test_a_command_that_the_world_has_changed_is_found(folder: Path) -> None:
    plant(folder / WORLD_JOURNAL, (of(Command, 40, "b"), to(v=0.5)))
    findings = audit(folder)
    assert found(findings)[:2] == [(40, "b", "order"), (41, "b", "observation")]
    assert {(robot, rule) for tick, robot, rule in found(findings)[1:]} <= {
        ("a", "observation"), ("b", "observation"), ("a", "contact"), ("b", "contact"),
        (None, "claim"), ("b", "claim"),
    }  # fmt: skip


def test_final_reports_in_another_order_are_found(folder: Path) -> None:
    told = messages(folder / WORLD_JOURNAL)
    written(folder / WORLD_JOURNAL, [*told[:-2], told[-1], told[-2]])
    assert found(audit(folder)) == [(None, None, "order"), (LAST, "a", "order")]


def test_an_agent_that_ended_before_the_world_did_is_found(folder: Path) -> None:
    told = [
        one
        for one in messages(folder / A)
        if getattr(one, "tick", None) != LAST or isinstance(one, MissionEnd)
    ]
    written(folder / A, told)
    findings = audit(folder)
    assert (LAST, "a", "order") in found(findings)
    assert what(findings, "order") == ["its journal has 48 ticks, expected 49"]
    assert {rule for _, _, rule in found(findings)} == {"order", "report", "decision"}


def plant_scenario(folder: Path, change: Callable[[Scenario], Scenario]) -> None:
    """Change the scenario, and each RobotConfig that follows from it."""
    plant(folder / WORLD_JOURNAL, (of(Scenario), change))
    (told,) = [one for one in messages(folder / WORLD_JOURNAL) if isinstance(one, Scenario)]
    for name in (A, B):
        plant(folder / name, (of(RobotConfig), lambda config: told.config(config.robot)))


def with_robots(**fields: Any) -> Callable[[Scenario], Scenario]:
    """Return a function that sets these fields of every robot."""
    return lambda told: replace(told, robots=tuple([replace(robot, **fields) for robot in told.robots]))


def with_meetings(**fields: Any) -> Callable[[Scenario], Scenario]:
    """Return a function that sets these fields of the meeting of every robot."""
    return lambda told: replace(
        told,
        robots=tuple([replace(one, encounter=replace(one.meeting, **fields)) for one in told.robots]),
    )


def test_an_orbit_that_does_not_follow_from_the_mission_is_found(folder: Path) -> None:
    plan = load("paper-1").robots[0].rendezvous
    other = replace(plan, a=replace(plan.a, radius=plan.a.radius * (1.0 + 2.0**-50)))
    plant_scenario(folder, with_meetings(rendezvous=other))
    findings = audit(folder)
    assert {(robot, rule) for _, robot, rule in found(findings)} >= {("a", "scenario"), ("b", "scenario")}
    assert what(findings, "scenario")[0].startswith("encounter.rendezvous.a.radius is 6.5")
    assert "config" not in {rule for _, _, rule in found(findings)}


def test_an_orbit_that_does_not_follow_from_the_mission_is_found_without_a_world(folder: Path) -> None:
    plan = load("paper-1").robots[0].rendezvous
    (folder / WORLD_JOURNAL).unlink()

    def later(config: RobotConfig) -> RobotConfig:
        meeting = replace(config.meeting, rendezvous=replace(plan, bound=plan.bound + 1.0))
        return replace(config, encounter=meeting)

    for name in (A, B):
        plant(folder / name, (of(RobotConfig), later))
    assert found(audit(folder)) == [(None, "a", "config"), (None, "b", "config")]


def test_a_robot_that_starts_outside_the_range_of_its_anchor_is_found(tmp_path: Path) -> None:
    scenario = load("paper-1")
    a, b = scenario.robots
    reach = scenario.mission.sensing_range
    outside = replace(a, start=replace(a.start, x=a.anchor.x + reach * (1.0 + 1e-9), y=a.anchor.y))
    in_process.run_mission(replace(scenario, robots=(outside, b), max_ticks=5), tmp_path)
    findings = audit(tmp_path)
    assert found(findings) == [(None, None, "scenario")]
    (said,) = what(findings, "scenario")
    assert said.startswith("robot[0].start: 'a' is 3 m from its anchor, outside mission.sensing_range")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda told: replace(told, mission=replace(told.mission, safety_distance=2.9)), "mission.safety"),
        (
            lambda told: replace(told, mission=replace(told.mission, max_speed=1e-5)),
            "mission: a robot moves at most",
        ),
        (with_robots(given_anchor=Anchor(0.0, 0.0)), "robot[1].anchor: less than 1e-06 m from"),
        (with_robots(attack=Attack("heading", 0.1, "orbit")), "an attack of kind heading changes the start"),
        (lambda told: replace(told, robots=told.robots[::-1]), 'role is "b", expected "a"'),
    ],
)
def test_a_scenario_that_no_run_accepts_is_found(
    change: Callable[[Scenario], Scenario], said: str, folder: Path
) -> None:
    plant_scenario(folder, change)
    assert any(one.startswith(said) or said in one for one in what(audit(folder), "scenario"))


def test_an_observation_that_differs_in_its_last_bit_is_found(folder: Path) -> None:
    (sensed,) = [one for one in messages(folder / A) if of(Observation, 47)(one)]
    measured = sensed.contacts[0].range
    off = math.nextafter(measured, 0.0)
    plant(folder / A, (of(Observation, 47), to(contacts=(Contact("b", off, (47,)),))))
    findings = audit(folder)
    assert found(findings) == [(47, "a", "observation")]
    assert what(findings, "observation") == [f"contacts[0].range is {off}, expected {measured}"]


def test_an_observation_of_another_manoeuvre_is_found(folder: Path) -> None:
    sensed = messages(folder / A)
    (before,) = [one for one in sensed if of(Observation, 30)(one)]
    plant(folder / A, (of(Observation, 30), to(executed=replace(before.executed, v=-0.0, omega=0.0))))
    findings = audit(folder)
    assert found(findings)[0] == (30, "a", "observation")
    assert len(what(findings, "observation")) == 1
    assert {(robot, rule) for _, robot, rule in found(findings)} == {
        ("a", "observation"), ("a", "decision"), ("a", "log")
    }  # fmt: skip


FAR = Report(20, "a", 2, "orbiting", None, 0, 0, (), 0, (), 0, 0)
"""A report of a tick without contact."""


def told_by_a(**fields: Any) -> list[Edit]:
    """Return the edit of a's last report."""
    return [(of(Report, LAST, "a"), to(**fields))]


def commanded_by_a(**fields: Any) -> list[Edit]:
    """Return the edit of a's last Command."""
    return [(of(Command, LAST, "a"), to(**fields))]


HEARD = [(of(Observation, 20), lambda observation: [observation, FAR])]
"""The edit that adds a report without contact."""
TIRED = Cause("undecided", ("a",), text="tired")
BY_TWO = "it claims with 2 relative placements with a mutual range, expected at least 3"
PLANTED: dict[str, tuple[str, Sequence[Edit], str]] = {
    "an agent has not journaled an Observation": (
        *("a", [(of(Observation, 12), nothing)]),
        "tick 12, a, order: a Command of a of tick 12 is out of order",
    ),
    "an agent has not journaled a Command": (
        *("a", [(of(Command, 12), nothing)]),
        "tick 12, a, order: an Estimate of a of tick 12 is out of order",
    ),
    "an agent has not journaled an Estimate": (
        *("a", [(of(Estimate, 12), nothing)]),
        "tick 12, a, order: no Estimate follows its Command",
    ),
    "the world did not receive a Command": (
        *("a", [(of(Command, 12), to(omega=0.25))]),
        "tick 12, a, order: the world's Command from it: omega is 0.15384615384615385, expected 0.25\n"
        "tick 12, a, decision: in its Command, omega is 0.25, expected 0.15384615384615385",
    ),
    "a Command is missing in lockstep": (
        *("w", [(of(Command, LAST, "a"), lambda _: DeadlineMissed(LAST, "a"))]),
        "tick 48, the world, order: a MissionEnd of tick 48 is out of order\n"
        "tick 48, a, order: the world continued without its Command, expected it to wait",
    ),
    "a report is missing in lockstep": (
        *("a", [(of(Report, LAST, "b"), lambda _: DeadlineMissed(LAST, "b"))]),
        "tick 48, a, order: it continued without a report, expected it to wait in lockstep\n"
        f"tick 48, a, claim: {BY_TWO}",
    ),
    "a MissionEnd is changed": (
        *("a", [(of(MissionEnd), to(causes=(Cause("failed", text="-"),)))]),
        'tick 48, a, order: the MissionEnd that it received: causes is [["failed",[],[],"-"]], expected []',
    ),
    "a FinalReport is changed": (
        *("a", [(of(FinalReport), to(reports_heard=2))]),
        "tick 48, a, order: the world's FinalReport from it: reports_heard is 3, expected 2\n"
        "tick 48, a, decision: in its FinalReport, reports_heard is 2, expected 3",
    ),
    "the world lacks a FinalReport": (
        *("w", [(of(FinalReport, robot="a"), nothing)]),
        "tick 48, a, order: the world has no FinalReport from it",
    ),
    "a RobotConfig differs from the scenario": (
        *("b", [(of(RobotConfig), lambda told: replace(told, mission=replace(told.mission, accuracy=0.2)))]),
        "no tick, b, config: mission.accuracy is 0.2, expected 0.1",
    ),
    "the duration of a tick is not part of the scenario": ("ab", [(of(RobotConfig), to(tick_s=0.5))], ""),
    "two robots have different durations of a tick": (
        *("b", [(of(RobotConfig), to(tick_s=0.5))]),
        "no tick, b, config: tick_s is 0.5, expected null",
    ),
    "a report was sent out of contact": (
        *("a", HEARD),
        "tick 20, a, contact: it sent a report, expected none: out of contact",
    ),
    "a report was never sent": (
        *("b", HEARD),
        "tick 20, b, contact: it received the reports of ticks [20], expected []\n"
        "tick 20, b, report: it received a report of tick 20, which a never sent",
    ),
    "no Observation lists a report": (
        *("a", [(of(Report, 47, "b"), lambda report: [report, report])]),
        "tick 47, a, contact: it received the reports of ticks [47,47], expected [47]",
    ),
    "a report was listed but not received": (
        *("b", [(of(Report, LAST, "a"), nothing)]),
        "tick 48, b, contact: it received the reports of ticks [], expected [48]\n"
        f"tick 48, b, claim: {BY_TWO}",
    ),
    "a report was changed on its way": (
        *("b", told_by_a(state="radial")),
        'tick 48, b, report: in the report of tick 48, state is "radial", expected "waiting"',
    ),
    "a report does not follow": (
        *("ab", told_by_a(state="radial")),
        'tick 48, a, decision: in its Report, state is "radial", expected "waiting"',
    ),
    "an Estimate does not follow": (
        *("a", [(of(Estimate, 12), to(localised=True))]),
        "tick 12, a, decision: in its Estimate, localised is true, expected false",
    ),
    **{
        f"{quantity} = {value} is beyond the limits": (
            *("aw", commanded_by_a(**{quantity: value})),
            f"tick 48, a, limits: it commanded {quantity} = {value}, expected at most {most}",
        )
        for quantity, value, most in (("v", 1.5, "1"), ("v", -1.5, "1"), ("omega", 3.2, "3.14159"))
    },
    "a robot cannot meet the peer of a Command": (
        *("aw", commanded_by_a(peer="nobody")),
        "tick 48, a, limits: its peer is nobody, which it cannot meet",
    ),
    "a manoeuvre was reported falsely": (
        *("ab", told_by_a(runs=(Segment(1, 0.9, 0.0), Segment(1, 0.0, 0.0)))),
        "tick 48, a, log: it reported (0.9, 0) until tick 47, expected [1.0,0.0]",
    ),
    "a motion log is invalid": (
        *("ab", told_by_a(runs=(Segment(2**31, 0.0, 0.0),))),
        "tick 48, a, log: it reported manoeuvres that do not fill [46, 48]",
    ),
    "the MissionEnd is not the referee's": (
        *("abw", [(of(MissionEnd), to(outcome="undecided", causes=(TIRED,)))]),
        "tick 48, the world, claim: it ends undecided (a: tired), expected localised",
    ),
    "a localised run has a robot that gave up": (
        *("aw", commanded_by_a(verdict=Undecided("tired"))),
        "tick 48, the world, claim: it ends localised, expected undecided (a: tired)",
    ),
    "a run ends before the referee decides": (
        *("aw", commanded_by_a(verdict=None)),
        "tick 48, the world, order: a MissionEnd of tick 48 is out of order",
    ),
}
"""Planted violations: the journals of a, b and the world (w), their edits, and what is found.

Other decisions of the two robots may then differ, too.
"""


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_violation_is_found_in_its_tick(name: str, folder: Path) -> None:
    journals, edits, expected = PLANTED[name]
    for journal in journals:
        plant(folder / {"a": A, "b": B, "w": WORLD_JOURNAL}[journal], *edits)
    violations = audit(folder).violations
    lines = [one.line for one in violations if one.rule != "decision" or one.line in expected]
    assert lines == expected.splitlines(), violations


def test_a_late_report_from_out_of_contact_is_found(folder: Path) -> None:
    """The report is received in contact and listed, but was not sent in contact."""
    late = replace(FAR, tick=45)
    plant(folder / A, (of(Observation, 45), lambda observation: [observation, late]))
    plant(
        folder / B,
        (
            of(Observation, 46),
            lambda observation: replace(
                observation, contacts=(Contact("a", observation.contacts[0].range, (46, 45)),)
            ),
        ),
        (of(Report, 46, "a"), lambda report: [report, late]),
    )
    findings = audit(folder)
    assert (46, "b", "observation") in found(findings)


def test_a_planner_that_fails_on_its_inputs_is_a_violation_and_no_crash(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(planner: Paper, state: RobotState) -> Command:
        if state.tick == 12 and state.config.robot == "a":
            raise ZeroDivisionError("12")
        return command(planner, state)

    command = Paper.command
    monkeypatch.setattr(Paper, "command", fails)
    assert [one.line for one in audit(folder).violations] == [
        "tick 12, a, decision: the planner fails on its inputs: ZeroDivisionError: 12"
    ]


def test_a_manoeuvre_beyond_the_limits_is_found(folder: Path) -> None:
    (before,) = [one for one in messages(folder / B) if of(Observation, LAST)(one)]
    plant(folder / B, (of(Observation, LAST), to(executed=replace(before.executed, v=1.0 + 1e-9))))
    findings = audit(folder)
    assert what(findings, "limits") == ["it drove v = 1.000000001, expected at most 1"]
    assert {(tick, robot) for tick, robot, _ in found(findings)} == {(LAST, "b")}
    assert {rule for _, _, rule in found(findings)} == {"observation", "decision", "limits", "log"}


@pytest.mark.parametrize("tick", [5, 7])
def test_a_range_that_was_reported_falsely_is_found(tick: int, folder: Path) -> None:
    """One range differs from the measured one, or belongs to a tick without a measurement."""

    def change(report: Report) -> Report:
        first, second, third = report.ranges
        ranges = {5: (first, replace(second, range=2.5), third), 7: (first, second, replace(third, tick=7))}
        return replace(report, ranges=ranges[tick])

    for name in (A, B):
        plant(folder / name, (of(Report, 46, "a"), change))
    findings = audit(folder)
    assert (46, "a", "log") in found(findings)
    measured = {
        5: "2.5 m at tick 5, expected 2.462210793129148",
        7: "2.462210793129148 m at tick 7, expected null",
    }
    assert what(findings, "log") == [f"it reported {measured[tick]}"]
    assert {rule for _, _, rule in found(findings)} == {"log", "decision"}


def claims(pose: Any, covariance: Covariance | None = None) -> Callable[[Any], Any]:
    return to(verdict=Localised(pose, covariance))


def test_a_claim_that_is_wrong_is_found_and_so_is_an_end_that_hides_it(folder: Path) -> None:
    pose = read(folder).ticks[LAST].truth.poses[0]
    for name in (A, WORLD_JOURNAL):
        plant(folder / name, (of(Command, LAST, "a"), claims(replace(pose, x=pose.x + 2e-6))))
    findings = audit(folder)
    assert found(findings) == [(LAST, "a", "decision"), (LAST, "a", "claim"), (LAST, None, "claim")]
    assert what(findings, "claim") == [
        "it claims a pose that is 2e-06 m and 0 rad off",
        "it ends localised, expected wrong (a claims a pose that is 2e-06 m and 0 rad off)",
    ]


def test_a_claim_below_the_required_accuracy_is_found(folder: Path) -> None:
    pose = read(folder).ticks[LAST].truth.poses[0]
    vague = Covariance(1e15, 0.0, 0.0, 1e15, 0.0, 1e-4)
    for name in (A, WORLD_JOURNAL):
        plant(folder / name, (of(Command, LAST, "a"), claims(pose, vague)))
    assert what(audit(folder), "claim") == [
        "it claims a position known to 4.47e+07 m, required 0.1",
        "it ends localised, expected undecided (a claims a position known to 4.47e+07 m, required 0.1)",
    ]


def test_a_claim_without_a_redundant_range_is_found(folder: Path) -> None:
    pose = read(folder).ticks[47].truth.poses[0]
    for name in (A, WORLD_JOURNAL):
        plant(folder / name, (of(Command, 47, "a"), claims(pose)))
    findings = audit(folder)
    assert found(findings) == [(47, "a", "decision"), (47, "a", "claim")]
    assert what(findings, "claim") == [
        "it claims with 2 relative placements with a mutual range, expected at least 3"
    ]


def test_ranges_taken_twice_in_the_same_place_are_not_redundant(folder: Path) -> None:
    """In real time, no robot moved before the third range."""
    pose = read(folder).ticks[47].truth.poses[0]
    for name in (A, WORLD_JOURNAL):
        plant(folder / name, (of(Command, LAST, "a"), claims(pose)))
    plant(folder / B, (of(Command, 47), to(v=0.0, omega=0.0)))
    plant(folder / WORLD_JOURNAL, (of(Command, 47, "b"), to(v=0.0, omega=0.0)))
    findings = audit(folder)
    assert "it claims with 2 relative placements with a mutual range, expected at least 3" in what(
        findings, "claim"
    )


@pytest.mark.parametrize(
    ("planner_name", "outliers", "expected"),
    [("assured", 0.05, 12), ("paper", 0.05, 12), ("assured", 0.0, 3), ("paper", 0.0, 3)],
)
def test_a_claim_by_too_few_noisy_ranges_is_found(
    planner_name: str, outliers: float, expected: int, tmp_path: Path
) -> None:
    in_process.run_mission(noise(1, planner_name, outliers), tmp_path)
    recording = read(tmp_path)
    first = next(one.tick for one in messages(tmp_path / A) if isinstance(one, Observation) and one.contacts)
    pose = recording.ticks[first].truth.poses[0]
    sure = Covariance(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
    for name in (A, WORLD_JOURNAL):
        plant(tmp_path / name, (of(Command, first, "a"), claims(pose, sure)))
    findings = audit(tmp_path)
    assert (first, "a", "claim") in found(findings)
    assert what(findings, "claim")[0].startswith("it claims with ")
    assert what(findings, "claim")[0].endswith(f"mutual ranges, expected at least {expected}")


def test_nothing_is_claimed_of_another_pair(tmp_path: Path) -> None:
    in_process.run_mission(parse(several_pairs(3), "pairs"), tmp_path)
    plant(tmp_path / agent_journal("d"), (of(Estimate, 3), to(localised=True)))
    assert found(audit(tmp_path)) == [(3, "d", "decision")]
