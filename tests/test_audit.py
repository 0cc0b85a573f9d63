"""The audit: a correct recording passes every rule, and each planted violation is found and located."""

from __future__ import annotations

import math
import os
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from signal import SIGCONT, SIGSTOP
from typing import Any

import msgpack
import pytest
from msgspec.structs import replace

from agent.planning.paper import Paper
from agent.planning.state import RobotState
from agent.process import agent_journal as reader_of_agent
from agent.process.robot import Robot
from compose.audit.findings import Findings, Violation
from compose.audit.rules import AUDIT_RULES, audit_run
from compose.launch import in_process
from compose.launch.planner_loader import planner_of
from compose.recording.recording_files import KINDS, WORLD_JOURNAL, agent_journal
from compose.recording.run import of_frames, read
from compose.scenario.scenario_file import load, parse
from compose.scenario.shipped_files import shipped
from protocol.attack import Attack
from protocol.journal import journal_file
from protocol.journal.journal_file import CorruptJournal, MemoryJournal
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
from protocol.wire import MAX_FRAME_BYTES, EncodedMessages, decode, encode
from tests.commands import (
    OVER,
    REAL_TIME,
    SECTION_IV,
    TandemProcess,
    process_of,
    refused,
    several_pairs,
    tandem,
)
from tests.missions import kept
from tests.series import series
from tests.test_real_time import missed
from world import world_journal as reader_of_world
from world.scenario import Scenario
from world.simulation import Simulation


def audit(folder: Path) -> Findings:
    """Return the findings in the recording in `folder`."""
    return audit_run(read(folder, audited=True))


Found = tuple[int | None, str | None, str]
"""The tick, robot and rule of a violation."""
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
[[robot]]
id = "a"
anchor = [0.0, 0.0]
[[robot]]
id = "b"
anchor = [6.0, 0.0]
"""
LAST = 48
"""The tick in which paper-1 ends."""
A, B = agent_journal("a"), agent_journal("b")


def noise(seed: int, planner_name: str, outliers: float = 0.05) -> Scenario:
    text = NOISE.replace("outliers = 0.05", f"outliers = {outliers}")
    return parse(text.replace("SEED", str(seed)).replace("VARIANT", planner_name), "noise")


def found(findings: Findings) -> list[Found]:
    return [(one.tick, one.robot, one.rule) for one in findings.violations]


def checks(findings: Findings) -> dict[str, int]:
    return {one.rule: one.checks for one in findings.counts}


# --- correct runs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scenario",
    [
        *[pytest.param(load(name), id=name) for name in ("paper-1", "paper-2", "noisy")],
        *[pytest.param(load("random", seed=seed), id=f"random-{seed}") for seed in range(40)],
        *series([noise(seed, name) for seed in range(3) for name in ("assured", "paper")], 1),
        *series([load("noisy", seed=seed) for seed in range(3)], 0),
        pytest.param(parse(several_pairs(3), "pairs"), id="three-pairs"),
    ],
)
def test_an_honest_run_violates_no_rule(scenario: Scenario) -> None:
    journals = kept(scenario)
    findings = audit_run(of_frames(journals))
    assert findings.violations == ()
    made, ticks, robots = checks(findings), findings.ticks + 1, len(scenario.robots)
    assert list(made) == [rule.__name__ for rule in AUDIT_RULES]
    assert made["config"] == robots
    assert made["observation"] == robots * ticks
    assert (
        made["decision"] == 2 * robots * ticks + made["log"] + robots
    )  # Commands, Estimates; Reports; FinalReports
    assert made["order"] == 1 + robots * (2 * ticks + 3)
    heard = [decode(frame, KINDS, MAX_FRAME_BYTES) for name in journals for frame in journals[name]]
    assert made["report"] == made["log"] == sum(isinstance(one, Report) for one in heard) / 2


def test_journals_in_memory_are_those_on_disk(tmp_path: Path) -> None:
    scenario = load("paper-1")
    in_process.run_mission(scenario, tmp_path)
    journals = kept(scenario)
    assert {path.name: list(journal_file.read(path)) for path in tmp_path.iterdir()} == journals
    assert audit(tmp_path) == audit_run(of_frames(journals))


@pytest.mark.parametrize("scenario", [load("paper-1"), parse(several_pairs(2), "pairs")])
def test_an_audit_of_a_run_in_this_process_decodes_none_of_its_ticks(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It finds the same as with decoded journals, and still decodes a frame that is not the run's own."""
    books, messages = {name: MemoryJournal() for name in in_process.journals(scenario)}, EncodedMessages()
    in_process.played(scenario, books, encode=messages.encode)
    journals = {name: book.frames for name, book in books.items()}
    expected = audit_run(of_frames(journals))
    decoded: list[bytes] = []

    def counted(frame: bytes, *kind: Any) -> Any:
        decoded.append(frame)
        return decode(frame, *kind)

    for module in (reader_of_agent, reader_of_world):
        monkeypatch.setattr(module, "decode", counted)
    assert audit_run(of_frames(journals, messages=EncodedMessages(messages))) == expected
    assert len(decoded) == 1 + len(scenario.robots)  # the world's MissionEnd and FinalReports
    journals[A][2] = journals[A][2][:-1] + b"\xff"
    with pytest.raises(CorruptJournal, match="the CRC does not match"):
        audit_run(of_frames(journals, messages=messages))


def test_a_run_as_processes_violates_no_rule_and_the_command_reports_it(tmp_path: Path) -> None:
    assert tandem("run", "noisy", "--out", tmp_path / "out", "-q").status == 0
    ended = tandem("audit", tmp_path / "out")
    assert (ended.status, ended.err) == (0, "")
    lines = ended.out.splitlines()
    last = read(tmp_path / "out").ticks[-1].truth.tick
    assert lines[:3] == [f"noisy: no violations over {last} ticks", "", "rule        checks  violations"]
    assert [line.split()[0] for line in lines[3:]] == [rule.__name__ for rule in AUDIT_RULES]
    assert [line.split()[2] for line in lines[3:]] == ["0"] * len(AUDIT_RULES)
    assert lines[6].split() == ["observation", str(2 * (last + 1)), "0"]


@pytest.mark.long
def test_a_run_in_real_time_with_missed_commands_violates_no_rule(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (tmp_path / "assured.toml").write_text(REAL_TIME)
    with TandemProcess("run", tmp_path / "assured.toml", "--rate", "20", "--out", out, "-q") as run:
        run.until_written(out / WORLD_JOURNAL, 3000)
        stopped = process_of(out, "agent", "a")
        os.kill(stopped, SIGSTOP)
        run.until(lambda: missed(out / WORLD_JOURNAL, "a") >= 3, "three of a's Commands are missed")
        os.kill(stopped, SIGCONT)
        assert run.ended().status in OVER
    findings = audit(out)
    assert [one for one in findings.violations if not one.breaks_off] == []
    assert all(made for rule, made in checks(findings).items() if rule not in ("claim", "distance", "bound"))


def test_a_failed_run_violates_no_rule() -> None:
    """The world ends a run without answers; a robot that did answer also answers the MissionEnd."""
    scenario = load("paper-1")
    books = {name: MemoryJournal() for name in in_process.journals(scenario)}
    simulation = Simulation(scenario, books[WORLD_JOURNAL])
    robots = {
        config.robot: Robot(config, planner_of(config), books[agent_journal(config.robot)])
        for config in map(scenario.config, "ab")
    }
    for _ in range(5):
        commands = {}
        for observation in simulation.observations():
            robots[observation.robot].observation(observation)
            commands[observation.robot] = robots[observation.robot].decide()
            robots[observation.robot].estimate()
        assert simulation.command(commands) is None
    a, _ = simulation.observations()
    robots["a"].observation(a)
    robots["a"].decide()
    robots["a"].estimate()
    end = simulation.end(MissionEnd(5, "failed", (Cause("failed", text="no answer from b"),)))
    simulation.journal_final_reports([robots["a"].final_report(end)])
    findings = audit_run(of_frames({name: book.frames for name, book in books.items()}))
    assert found(findings) == [(4, "b", "order")]
    assert findings.violations[0].what == "its journal breaks off here, expected MissionEnd and FinalReport"


# --- truncated recordings ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def paper_1() -> dict[str, list[bytes]]:
    return kept(load("paper-1"))


@pytest.mark.parametrize("name", series([WORLD_JOURNAL, A, B]))
def test_a_journal_that_breaks_off_anywhere_breaks_no_other_rule(
    name: str, paper_1: dict[str, list[bytes]]
) -> None:
    whole = paper_1[name]
    for count in range(2 * (name == WORLD_JOURNAL), len(whole)):  # at least its scenario
        findings = audit_run(of_frames(paper_1 | {name: whole[:count]}))
        if name == WORLD_JOURNAL and count >= len(whole) - 2:  # a FinalReport is lacking, or both
            assert {one.what for one in findings.violations} == {"the world has no FinalReport from it"}
            continue
        (violation,) = findings.violations
        left = [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in whole[:count]]
        ticks = [one.tick for one in left if isinstance(one, Observation)]
        if name == WORLD_JOURNAL:
            ticks = [one.tick for one in left[:-1] if isinstance(one, Command) and one.robot == "b"]
            ticks += [one.tick for one in left[-1:] if isinstance(one, Command) and one.robot == "b"]
        robot = {A: "a", B: "b"}.get(name)
        assert (violation.rule, violation.robot, violation.tick) == (
            "order",
            robot,
            ticks[-1] if ticks else None,
        )
        assert "its journal breaks off here" in violation.what


def test_a_robot_that_has_left_no_journal_is_named(paper_1: dict[str, list[bytes]]) -> None:
    findings = audit_run(of_frames({name: frames for name, frames in paper_1.items() if name != B}))
    assert [one.line for one in findings.violations] == ["no tick, b, order: its journal is missing"]
    assert checks(findings)["decision"] == 2 * (LAST + 1) + 3 + 1


# --- planted violations -------------------------------------------------------------------------------------


def messages(path: Path) -> list[Any]:
    return [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in journal_file.read(path)]


def written(path: Path, told: Iterable[Any]) -> None:
    """Write a journal of these messages, each in a frame with a correct CRC."""
    path.write_bytes(b"".join([msgpack.packb(encode(message)) for message in told]))


@pytest.fixture(scope="session")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of paper-1."""
    folder = tmp_path_factory.mktemp("honest")
    in_process.run_mission(load("paper-1"), folder)
    return folder


@pytest.fixture
def folder(honest: Path, tmp_path: Path) -> Path:
    """A copy of the recording of paper-1."""
    return Path(shutil.copytree(honest, tmp_path / "record"))


def plant(path: Path, *edits: tuple[Callable[[Any], bool], Callable[[Any], Any]]) -> None:
    """Replace the single message that each of `edits` selects by another message, by several, or by none."""
    told = messages(path)
    for picks, change in edits:
        (place,) = [i for i, message in enumerate(told) if picks(message)]
        put = change(told[place])
        told[place : place + 1] = put if isinstance(put, list) else [put]
    written(path, told)


def of(kind: type, tick: int | None = None, robot: str | None = None) -> Callable[[Any], bool]:
    """Return a function that selects a message by kind, tick and robot."""
    return lambda message: (
        isinstance(message, kind)
        and (tick is None or getattr(message, "tick", None) == tick)
        and (robot is None or getattr(message, "robot", None) == robot)
    )


def to(**fields: Any) -> Callable[[Any], Any]:
    return lambda message: replace(message, **fields)


def nothing(_: Any) -> list[Any]:
    return []


def what(findings: Findings, rule: str) -> list[str]:
    return [one.what for one in findings.violations if one.rule == rule]


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


@pytest.mark.parametrize("kind", [Observation, Command, Estimate])
def test_a_frame_that_an_agent_has_not_journaled_is_missed(kind: type, folder: Path) -> None:
    plant(folder / A, (of(kind, 12), nothing))
    findings = audit(folder)
    assert found(findings) == [(12, "a", "order")]


def test_a_tick_that_an_agent_has_left_out_is_missed(folder: Path) -> None:
    told = [one for one in messages(folder / A) if getattr(one, "tick", None) != 12]
    written(folder / A, told)
    assert [one.line for one in audit(folder).violations] == [
        "tick 13, a, order: an Observation of tick 13 is out of order"
    ]


def test_a_command_that_the_world_did_not_receive_is_found(folder: Path) -> None:
    plant(folder / A, (of(Command, 12), to(omega=0.25)))
    findings = audit(folder)
    assert found(findings) == [(12, "a", "order"), (12, "a", "decision")]
    assert what(findings, "order") == [
        "the world's Command from it: omega is 0.15384615384615385, expected 0.25"
    ]
    assert what(findings, "decision") == ["in its Command, omega is 0.25, expected 0.15384615384615385"]


def test_a_command_that_the_world_has_changed_is_found(folder: Path) -> None:
    plant(folder / WORLD_JOURNAL, (of(Command, 40, "b"), to(v=0.5)))
    findings = audit(folder)
    assert found(findings)[:2] == [(40, "b", "order"), (41, "b", "observation")]
    assert {(robot, rule) for tick, robot, rule in found(findings)[1:]} <= {
        ("a", "observation"), ("b", "observation"), ("a", "contact"), ("b", "contact"),
        (None, "claim"), ("b", "claim"),
    }  # fmt: skip


def test_a_command_that_is_missing_in_lockstep_is_found(folder: Path) -> None:
    plant(folder / WORLD_JOURNAL, (of(Command, LAST, "a"), lambda _: DeadlineMissed(LAST, "a")))
    assert (LAST, "a", "order") in found(audit(folder))
    assert "the world continued without its Command, expected it to wait" in what(audit(folder), "order")


def test_a_report_that_is_missing_in_lockstep_is_found(folder: Path) -> None:
    plant(folder / A, (of(Report, LAST, "b"), lambda _: DeadlineMissed(LAST, "b")))
    findings = audit(folder)
    assert (LAST, "a", "order") in found(findings)
    # "claim", because it then rests on two ranges only
    assert {rule for _, _, rule in found(findings)} == {"order", "decision", "claim"}
    assert {(tick, robot) for tick, robot, _ in found(findings)} == {(LAST, "a")}


def test_a_changed_mission_end_or_final_report_is_found(folder: Path) -> None:
    plant(
        folder / A,
        (of(MissionEnd), to(causes=(Cause("failed", text="none"),))),
        (of(FinalReport), to(reports_heard=2)),
    )
    findings = audit(folder)
    assert found(findings) == [(LAST, "a", "order")] * 2 + [(LAST, "a", "decision")]
    assert what(findings, "order")[1] == "the world's FinalReport from it: reports_heard is 3, expected 2"
    assert what(findings, "decision") == ["in its FinalReport, reports_heard is 2, expected 3"]


@pytest.mark.parametrize("lacking", ["a", "b"])
def test_a_final_report_that_the_world_lacks_is_found(lacking: str, folder: Path) -> None:
    plant(folder / WORLD_JOURNAL, (of(FinalReport, robot=lacking), nothing))
    assert [one.line for one in audit(folder).violations] == [
        f"tick 48, {lacking}, order: the world has no FinalReport from it"
    ]


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


def test_a_robot_config_that_differs_from_the_scenario_is_found(folder: Path) -> None:
    plant(
        folder / B, (of(RobotConfig), lambda told: replace(told, mission=replace(told.mission, accuracy=0.2)))
    )
    findings = audit(folder)
    assert found(findings) == [(None, "b", "config")]
    assert findings.violations[0].line.startswith("no tick, b, config: mission.accuracy is ")


def test_the_duration_of_a_tick_is_not_part_of_the_scenario(folder: Path) -> None:
    for name in (A, B):
        plant(folder / name, (of(RobotConfig), to(tick_s=0.5)))
    assert found(audit(folder)) == []


def test_different_tick_durations_of_two_robots_are_found(folder: Path) -> None:
    plant(folder / B, (of(RobotConfig), to(tick_s=0.5)))
    assert found(audit(folder)) == [(None, "b", "config")]


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


def test_a_report_that_was_sent_out_of_contact_is_found(folder: Path) -> None:
    plant(folder / A, (of(Observation, 20), lambda observation: [observation, FAR]))
    findings = audit(folder)
    assert found(findings) == [(20, "a", "contact"), (20, "a", "decision")]
    assert what(findings, "contact") == ["it sent a report, expected none: out of contact"]


def test_a_report_that_was_received_out_of_contact_is_found(folder: Path) -> None:
    plant(folder / A, (of(Observation, 20), lambda observation: [observation, FAR]))
    plant(folder / B, (of(Observation, 20), lambda observation: [observation, FAR]))
    findings = audit(folder)
    heard = [one.what for one in findings.violations if one.robot == "b" and one.rule == "contact"]
    assert heard == ["it received the reports of ticks [20], expected []"]


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


def test_a_report_that_no_observation_lists_is_found(folder: Path) -> None:
    plant(folder / A, (of(Report, 47, "b"), lambda report: [report, report]))
    findings = audit(folder)
    assert found(findings)[0] == (47, "a", "contact")
    assert what(findings, "contact") == ["it received the reports of ticks [47,47], expected [47]"]
    assert {(robot, rule) for _, robot, rule in found(findings)[1:]} == {("a", "decision")}  # it counts them


def test_a_report_that_was_listed_but_not_received_is_found(folder: Path) -> None:
    plant(folder / B, (of(Report, LAST, "a"), nothing))
    findings = audit(folder)
    assert found(findings)[0] == (LAST, "b", "contact")
    assert what(findings, "contact") == ["it received the reports of ticks [], expected [48]"]
    assert set(found(findings)[1:]) == {(LAST, "b", "decision"), (LAST, "b", "claim")}  # by two ranges


def test_a_report_that_was_changed_on_its_way_is_found(folder: Path) -> None:
    plant(folder / B, (of(Report, LAST, "a"), to(state="radial")))
    findings = audit(folder)
    assert found(findings) == [(LAST, "b", "report")]
    assert what(findings, "report") == ['in the report of tick 48, state is "radial", expected "waiting"']


def test_a_report_that_was_never_sent_is_found(folder: Path) -> None:
    plant(folder / B, (of(Observation, 20), lambda observation: [observation, FAR]))
    findings = audit(folder)
    assert what(findings, "report") == ["it received a report of tick 20, which a never sent"]
    assert {(robot, rule) for _, robot, rule in found(findings)} == {
        ("b", "contact"), ("b", "report"), ("b", "decision")
    }  # fmt: skip


def test_an_estimate_that_does_not_follow_is_found(folder: Path) -> None:
    plant(folder / A, (of(Estimate, 12), to(localised=True)))
    findings = audit(folder)
    assert found(findings) == [(12, "a", "decision")]
    assert what(findings, "decision") == ["in its Estimate, localised is true, expected false"]


def test_a_report_that_does_not_follow_is_found_at_its_sender(folder: Path) -> None:
    for name in (A, B):
        plant(folder / name, (of(Report, LAST, "a"), to(state="radial")))
    assert found(audit(folder)) == [(LAST, "a", "decision")]


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


@pytest.mark.parametrize("beyond", [{"v": 1.5}, {"v": -1.5}, {"omega": 3.2}])
def test_a_command_beyond_the_limits_is_found(beyond: dict[str, float], folder: Path) -> None:
    for name in (A, WORLD_JOURNAL):
        plant(folder / name, (of(Command, LAST, "a"), to(**beyond)))
    findings = audit(folder)
    assert found(findings) == [(LAST, "a", "decision"), (LAST, "a", "limits")]
    ((quantity, value),) = beyond.items()
    most = {"v": "1", "omega": "3.14159"}[quantity]
    assert what(findings, "limits") == [f"it commanded {quantity} = {value:g}, expected at most {most}"]


def test_a_command_with_a_peer_that_the_robot_cannot_meet_is_found(folder: Path) -> None:
    for name in (A, WORLD_JOURNAL):
        plant(folder / name, (of(Command, LAST, "a"), to(peer="nobody")))
    assert what(audit(folder), "limits") == ["its peer is nobody, which it cannot meet"]


def test_a_manoeuvre_beyond_the_limits_is_found(folder: Path) -> None:
    (before,) = [one for one in messages(folder / B) if of(Observation, LAST)(one)]
    plant(folder / B, (of(Observation, LAST), to(executed=replace(before.executed, v=1.0 + 1e-9))))
    findings = audit(folder)
    assert what(findings, "limits") == ["it drove v = 1, expected at most 1"]
    assert {(tick, robot) for tick, robot, _ in found(findings)} == {(LAST, "b")}
    assert {rule for _, _, rule in found(findings)} == {"observation", "decision", "limits", "log"}


def lied(folder: Path, change: Callable[[Report], Report]) -> Findings:
    """Return the findings for a recording in which a's report of tick 48 to b is changed."""
    for name in (A, B):
        plant(folder / name, (of(Report, LAST, "a"), change))
    return audit(folder)


def test_a_manoeuvre_that_was_reported_falsely_is_found(folder: Path) -> None:
    findings = lied(folder, to(runs=(Segment(1, 0.9, 0.0), Segment(1, 0.0, 0.0))))
    assert (LAST, "a", "log") in found(findings)
    assert what(findings, "log") == ["it reported (0.9, 0) until tick 47, expected [1.0,0.0]"]
    assert {rule for _, _, rule in found(findings)} == {"log", "decision"}


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


def test_an_invalid_motion_log_is_found(folder: Path) -> None:
    findings = lied(folder, to(runs=(Segment(2**31, 0.0, 0.0),)))
    assert what(findings, "log") == ["it reported manoeuvres that do not fill [46, 48]"]


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


def test_a_mission_end_that_differs_from_the_referees_is_found(folder: Path) -> None:
    for name in (A, B, WORLD_JOURNAL):
        plant(
            folder / name,
            (of(MissionEnd), to(outcome="undecided", causes=(Cause("undecided", ("a",), text="tired"),))),
        )
    assert [one.line for one in audit(folder).violations] == [
        "tick 48, the world, claim: it ends undecided (a: tired), expected localised"
    ]


def test_a_run_that_ends_before_the_referee_decides_is_found(folder: Path) -> None:
    for robot, name in (("a", A), ("b", B)):
        plant(folder / name, (of(Command, LAST), to(verdict=None)))
        plant(folder / WORLD_JOURNAL, (of(Command, LAST, robot), to(verdict=None)))
    findings = audit(folder)
    # the MissionEnd of tick 48 is out of order after these Commands
    assert (LAST, None, "order") in found(findings)
    assert {rule for _, _, rule in found(findings)} == {"order", "decision"}


def test_a_localised_run_with_a_robot_that_gave_up_is_found(folder: Path) -> None:
    for name in (A, WORLD_JOURNAL):
        plant(folder / name, (of(Command, LAST, "a"), to(verdict=Undecided("tired"))))
    findings = audit(folder)
    assert found(findings) == [(LAST, "a", "decision"), (LAST, None, "claim")]
    assert what(findings, "claim") == ["it ends localised, expected undecided (a: tired)"]


def test_nothing_is_claimed_of_another_pair(tmp_path: Path) -> None:
    in_process.run_mission(parse(several_pairs(3), "pairs"), tmp_path)
    plant(tmp_path / agent_journal("d"), (of(Estimate, 3), to(localised=True)))
    assert found(audit(tmp_path)) == [(3, "d", "decision")]


# --- the command -----------------------------------------------------------------------------------------


def test_the_command_prints_the_first_twenty_violations_and_the_number_of_others(folder: Path) -> None:
    told = messages(folder / A)
    written(folder / A, [replace(one, localised=True) if isinstance(one, Estimate) else one for one in told])
    ended = tandem("audit", folder)
    assert (ended.status, ended.err) == (1, "")
    lines = ended.out.splitlines()
    assert lines[0] == "paper-1: 48 violations over 48 ticks"
    assert re.fullmatch(r"decision +204 +48", lines[9])
    assert lines[15:17] == ["", "tick 0, a, decision: in its Estimate, localised is true, expected false"]
    assert len(lines[16:]) == 21
    assert lines[-1] == "and 28 more"


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    file, empty = tmp_path / "file", tmp_path / "empty"
    file.write_text("")
    empty.mkdir()
    refused(tandem("audit", tmp_path / "nowhere"), "nowhere contains no recording: there is no world.journal")
    refused(tandem("audit", empty), "empty contains no recording: there is no world.journal")
    refused(tandem("audit", file), "file cannot be read: Not a directory")
    refused(tandem("audit", ""), "'' is not a path")


@pytest.mark.parametrize("name", [WORLD_JOURNAL, A])
def test_a_journal_that_cannot_be_understood_is_refused_and_named(name: str, folder: Path) -> None:
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / name).write_bytes(data)
    refused(tandem("audit", folder), f"{name}: ")


def spoilt(folder: Path, name: str, frames: Sequence[bytes]) -> str:
    """Return why a recording with this journal cannot be audited."""
    (folder / name).write_bytes(b"".join([msgpack.packb(frame) for frame in frames]))
    with pytest.raises(CorruptJournal) as error:
        audit(folder)
    return str(error.value)


@pytest.mark.parametrize("command", ["audit", "replay", "figures", "export"])
@pytest.mark.parametrize(
    ("target", "why"),
    [("nowhere", "No such file or directory"), (WORLD_JOURNAL, "Too many levels of symbolic links")],
    ids=["to nothing", "to itself"],
)
def test_a_link_in_place_of_the_worlds_journal_is_not_taken_for_hardware_mode(
    target: str, why: str, command: str, folder: Path
) -> None:
    (folder / WORLD_JOURNAL).unlink()
    (folder / WORLD_JOURNAL).symlink_to(target)
    refused(tandem(command, folder), f"{WORLD_JOURNAL} cannot be read: {why}")


def test_journals_that_are_none_are_refused(honest: Path, folder: Path) -> None:
    world, a = list(journal_file.read(honest / WORLD_JOURNAL)), list(journal_file.read(honest / A))
    assert f"{A} is the journal of b" in spoilt(folder, A, list(journal_file.read(honest / B)))
    assert f"{A}: " in spoilt(folder, A, [*a[:5], encode(load("paper-1"))])
    begins = f"{A}: an agent's journal must begin with its environment and a RobotConfig"
    assert begins in spoilt(folder, A, [*a[:1], *a[2:]])
    assert begins in spoilt(folder, A, a[1:])
    assert f"{WORLD_JOURNAL}: " in spoilt(folder, WORLD_JOURNAL, [])
    assert f"{WORLD_JOURNAL}: " in spoilt(folder, WORLD_JOURNAL, [*world[:1], *world[2:]])
    assert f"{WORLD_JOURNAL}: " in spoilt(folder, WORLD_JOURNAL, world[1:])
    scenario = load("paper-1")
    first, second = scenario.robots
    for robots in (
        (first,),
        (first, first),
        (first, replace(second, encounter=replace(second.meeting, role="a"))),
        (),
    ):
        lone = encode(replace(scenario, robots=robots))
        assert f"{WORLD_JOURNAL}: " in spoilt(folder, WORLD_JOURNAL, [lone, *world[1:]])


def test_a_violation_is_one_line() -> None:
    assert Violation("order", None, None, "x").line == "no tick, the world, order: x"


# --- the radio -------------------------------------------------------------------------------------------


def test_deliveries_of_reports_are_listed_and_another_fault_plan_is_found(tmp_path: Path) -> None:
    text = shipped()["random"].read_text()
    in_process.run_mission(
        parse(text, "random", faults=["b->a: loss=0.5, delay=0..2, corrupt=0.2"]), tmp_path
    )
    findings = audit(tmp_path)
    assert found(findings) == []
    to_a, to_b = findings.links
    assert (to_a.link, to_b.link) == ("b->a", "a->b")
    assert to_b.heard == to_b.sent == to_a.sent
    assert to_b.late == to_b.twice == to_b.damaged == to_b.lost == 0
    assert to_a.lost > 0 < to_a.damaged
    assert to_a.heard + to_a.damaged + to_a.lost - to_a.twice == to_a.sent
    told = tandem("audit", tmp_path).out
    assert re.search(r"^ ?b->a +\d+ +\d+", told, re.MULTILINE)

    lost = next(
        one
        for one in messages(tmp_path / A)
        if isinstance(one, Observation) and one.contacts and not one.contacts[0].heard
    )
    heard = replace(lost, contacts=(replace(lost.contacts[0], heard=(lost.tick,)),))
    plant(tmp_path / A, (of(Observation, lost.tick), to(contacts=heard.contacts)))
    findings = audit(tmp_path)
    assert (lost.tick, "a", "observation") in found(findings)
    assert what(findings, "observation")[0].startswith("contacts[0].heard is ")


def test_an_attacker_that_follows_its_scenario_violates_no_rule(tmp_path: Path) -> None:
    text = (
        shipped()["random"].read_text().replace('id = "b"', 'id = "b"\nattack = {kind = "scale", size = 0.5}')
    )
    in_process.run_mission(parse(text, "random"), tmp_path)
    assert found(audit(tmp_path)) == []
