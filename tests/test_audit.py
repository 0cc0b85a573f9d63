"""The audit: a correct recording passes every rule, and each planted violation is found and located."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgpack
import pytest
from msgspec.structs import replace

from agent.process.robot import Robot
from compose.audit.findings import Violation
from compose.audit.rules import AUDIT_RULES, audit_run
from compose.launch import in_process
from compose.launch.planner_loader import planner_of
from compose.recording.recording_files import KINDS, WORLD_JOURNAL, agent_journal
from compose.recording.run import of_frames, read
from compose.scenario.scenario_file import load, parse
from compose.scenario.shipped_files import shipped
from protocol.journal import journal_file
from protocol.journal.journal_file import CorruptJournal, MemoryJournal
from protocol.messages import Cause, Command, Estimate, MissionEnd, Observation, Report
from protocol.wire import MAX_FRAME_BYTES, EncodedMessages, decode, encode
from tests.commands import refused, several_pairs, tandem
from tests.missions import kept
from tests.planted import LAST, A, B, audit, checks, found, messages, of, plant, to, what, written
from tests.series import series
from tests.test_planted_violations import noise
from world.scenario import Scenario
from world.simulation import Simulation

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
def test_an_audit_of_a_run_in_this_process_decodes_none_of_its_frames(
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

    monkeypatch.setattr(journal_file, "decode", counted)
    assert audit_run(of_frames(journals, messages=EncodedMessages(messages))) == expected
    assert decoded == []
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
def frames_of_paper_1() -> dict[str, list[bytes]]:
    return kept(load("paper-1"))


@pytest.mark.parametrize("cuts", series([(WORLD_JOURNAL, 4), (WORLD_JOURNAL, 1), (A, 1), (B, 1)]))
def test_a_journal_that_breaks_off_anywhere_breaks_no_other_rule(
    cuts: tuple[str, int], frames_of_paper_1: dict[str, list[bytes]]
) -> None:
    name, each = cuts
    whole = frames_of_paper_1[name]
    begin, dense = 2 * (name == WORLD_JOURNAL), len(whole) - 9  # at least the scenario of the world
    for count in [*range(begin, dense, each), *range(dense, len(whole))]:
        findings = audit_run(of_frames(frames_of_paper_1 | {name: whole[:count]}))
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


def test_a_robot_that_has_left_no_journal_is_named(frames_of_paper_1: dict[str, list[bytes]]) -> None:
    findings = audit_run(of_frames({name: frames for name, frames in frames_of_paper_1.items() if name != B}))
    assert [one.line for one in findings.violations] == ["no tick, b, order: its journal is missing"]
    assert checks(findings)["decision"] == 2 * (LAST + 1) + 3 + 1


# --- planted violations -------------------------------------------------------------------------------------


@pytest.fixture
def folder(paper_1: Path, tmp_path: Path) -> Path:
    """Return a copy of the recording of paper-1, which the test may change."""
    return Path(shutil.copytree(paper_1, tmp_path / "record"))


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
    refused(tandem("audit", tmp_path / "nowhere"), "nowhere does not exist")
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


def test_journals_that_are_none_are_refused(paper_1: Path, folder: Path) -> None:
    world, a = list(journal_file.read(paper_1 / WORLD_JOURNAL)), list(journal_file.read(paper_1 / A))
    assert f"{A} is the journal of b" in spoilt(folder, A, list(journal_file.read(paper_1 / B)))
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
