"""Recordings in hardware mode: viewers show the robots' journals, and nothing that requires the truth."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import msgpack
import numpy as np
import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace

from compose.audit.rules import HARDWARE_RULES, audit_run
from compose.figures import encounter, over_time, phase_one, trajectory
from compose.figures.sheet import NO_PLACES, Absent
from compose.launch.in_process import run_mission
from compose.recording.run import of_frames, read
from compose.scenario.scenario_file import load, parse
from protocol.journal import journal_file
from protocol.messages import Command, Message, OfRobot, Report
from protocol.mission import Role
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import copied, several_pairs, tandem
from tests.replays import exported_frames
from tests.series import series
from tests.test_album import drawn, line, pair

KNOWN_TO_A_WORLD = ("x", "y", "heading")
MEASURED = ("tick", "robot", "anchor_range", "mutual_range", "phase", "state")


@pytest.fixture(scope="module", params=series(["paper-1", "noisy"]))
def folders(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a recording, and a folder with only the robots' journals of it."""
    whole = tmp_path_factory.mktemp("whole")
    run_mission(load(request.param), whole)
    return whole, copied(whole, tmp_path_factory.mktemp("alone"), "agent-a.journal", "agent-b.journal")


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "ticks.csv").open() as file:
        return list(csv.DictReader(file))


def test_an_export_of_hardware_mode_has_measurements_and_estimates_and_no_truth(
    folders: tuple[Path, Path],
) -> None:
    whole, alone = folders
    for folder in folders:
        ended = tandem("export", folder)
        assert (ended.status, ended.err) == (0, "")
    agents = {robot: read(alone).agent(robot) for robot in "ab"}
    for told, known in zip(table(alone), table(whole), strict=True):
        assert {told[name] for name in KNOWN_TO_A_WORLD} == {""}
        assert [told[name] for name in MEASURED] == [known[name] for name in MEASURED]
        agent, after = agents[told["robot"]], int(told["tick"]) + 1
        assert agent is not None
        driven = agent.steps[after].observation.executed if after < len(agent.steps) else None
        assert told["v"] == (
            "" if driven is None else repr(driven.v)
        )  # with a simulator, the executed motion is known
        assert told["omega"] == ("" if driven is None else repr(driven.omega))
    rows, truly = (pq.read_table(folder / "ticks.parquet").to_pylist() for folder in (alone, whole))
    for name in ("world", "local", "probability", "estimate_x", "cov_xx", "verdict", "time_s"):
        assert [row[name] for row in rows] == [row[name] for row in truly]
    assert {row["position_error_m"] for row in rows} == {None}
    assert any(row["position_error_m"] is not None for row in truly)
    assert set(exported_frames(alone)) == {"agent-a.journal", "agent-b.journal"}


@pytest.mark.long
def test_paths_are_the_odometry_laid_through_the_claim(folders: tuple[Path, Path]) -> None:
    whole, alone = folders
    known, told = pair(whole), pair(alone)
    for role in ("a", "b"):
        claim = known.robot(role).claim
        assert claim is not None
        there = told.robot(role).path[claim.tick]
        assert (there.x, there.y) == pytest.approx((claim.pose.x, claim.pose.y), abs=1e-9)
        if known.exact:
            for claimed, true in zip(told.robot(role).path, known.robot(role).path, strict=True):
                assert (claimed.x, claimed.y) == pytest.approx((true.x, true.y), abs=1e-9)
                assert claimed.heading == pytest.approx(true.heading, abs=1e-9)
    figure = drawn(trajectory.draw(told))
    assert line(figure, "path-a") == [(p.x, p.y) for p in told.a.path]


@pytest.mark.long
def test_figures_without_the_truth_are_drawn_as_in_simulation(folders: tuple[Path, Path]) -> None:
    whole, alone = folders
    known, told = pair(whole), pair(alone)
    assert told.mutual == known.mutual
    assert told.contacts == known.contacts
    assert told.encounter_tick == known.encounter_tick
    roles: tuple[Role, Role] = ("a", "b")
    for role in roles:
        assert told.robot(role).anchor_ranges == known.robot(role).anchor_ranges
        assert told.robot(role).commands == known.robot(role).commands
        assert told.states(role) == known.states(role)
        drawn_alone, drawn_whole = drawn(phase_one.draw(told, role)), drawn(phase_one.draw(known, role))
        lines = [
            [np.asarray(one.get_xydata()).tolist() for one in f.axes[0].lines]
            for f in (drawn_alone, drawn_whole)
        ]
        assert lines[0] == lines[1] != []
    figure = drawn(over_time.ranges(told))
    assert line(figure, "mutual-range") == line(drawn(over_time.ranges(known)), "mutual-range")
    (key,) = [key for axes in figure.axes if (key := axes.get_legend()) is not None]
    labels = [text.get_text() for text in key.get_texts()]
    assert "separation, from claims" in labels
    assert "true separation" not in labels


@pytest.mark.long
def test_the_command_draws_what_it_can_and_reports_the_rest(folders: tuple[Path, Path]) -> None:
    _, alone = folders
    ended = tandem("figures", alone, "--format", "png")
    assert ended.status == 0, ended.err
    there = {path.stem for path in (alone / "figures").iterdir()}
    assert {"trajectory-a-b", "encounter-a-b", "ranges-a-b"} <= there
    assert not {name for name in there if name.startswith(("errors", "robot"))}
    lines = ended.err.splitlines()
    assert [
        text for text in lines if "no errors-a-b: a recording in hardware mode has no ground truth" in text
    ]
    assert [text for text in lines if "no robot-b: a recording in hardware mode has no ground truth" in text]


def test_a_single_journal_shows_the_estimates_of_one_robot(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    _, alone = folders
    (tmp_path / "agent-b.journal").write_bytes((alone / "agent-b.journal").read_bytes())
    told = pair(tmp_path)
    assert trajectory.draw(told) == Absent(NO_PLACES)
    assert told.a.id == "a"
    assert told.readable == ["b"]
    ended = tandem("figures", tmp_path, "--only", "ranges", "--only", "trajectory", "--format", "png")
    assert ended.status == 3
    assert ended.err.splitlines() == [
        "tandem figures: no figure of a: agent-a.journal is missing",
        f"tandem figures: no trajectory-a-b: {NO_PLACES}",
    ]
    assert [path.name for path in (tmp_path / "figures").iterdir()] == ["ranges-a-b.png"]
    ended = tandem("export", tmp_path)
    assert (ended.status, ended.err) == (3, "tandem export: agent-a.journal is missing\n")
    assert {row["robot"] for row in table(tmp_path)} == {"b"}


def test_a_robot_without_a_configuration_is_skipped(folders: tuple[Path, Path], tmp_path: Path) -> None:
    _, alone = folders
    (tmp_path / "agent-a.journal").write_bytes((alone / "agent-a.journal").read_bytes())
    (tmp_path / "agent-b.journal").touch()
    ended = tandem("figures", tmp_path, "--only", "ranges", "--format", "png")
    assert (ended.status, ended.err) == (0, "")
    assert (tmp_path / "figures" / "ranges-a-b.png").exists()
    assert tandem("export", tmp_path).status == 0
    (tmp_path / "agent-a.journal").write_bytes(b"")
    ended = tandem("figures", tmp_path, "--only", "ranges", "--format", "png")
    nothing = [f"tandem figures: no figure of {robot}: the recording has no data" for robot in "ab"]
    assert ended.err.splitlines() == nothing
    ended = tandem("export", tmp_path)
    assert (ended.status, ended.out) == (2, "")
    assert ended.err.endswith("there is no world.journal, and no robot's journal has a configuration\n")


@pytest.mark.long
def test_a_shorter_journal_does_not_shorten_that_of_the_peer(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    whole, alone = folders
    (tmp_path / "agent-a.journal").write_bytes((alone / "agent-a.journal").read_bytes())
    frames = list(journal_file.read(alone / "agent-b.journal"))[:20]
    (tmp_path / "agent-b.journal").write_bytes(b"".join([msgpack.packb(frame) for frame in frames]))
    known, told = pair(whole), pair(tmp_path)
    assert told.a.anchor_ranges == known.a.anchor_ranges
    assert told.states("a") == known.states("a")
    assert len(told.a.path) == len(known.a.path)
    assert len(told.b.commands) < len(known.b.commands)
    assert trajectory.draw(told) == encounter.draw(told) == Absent(NO_PLACES)
    mutual = line(drawn(over_time.ranges(told)), "mutual-range")
    assert mutual == line(drawn(over_time.ranges(known)), "mutual-range")
    assert "; b: the recording breaks off after" in told.title


def test_paths_of_two_lengths_are_drawn(folders: tuple[Path, Path]) -> None:
    _, alone = folders
    told = pair(alone)
    shorter = replace(told, b=replace(told.b, path=told.b.path[: told.contacts[0][0]]))
    figure = drawn(trajectory.draw(shorter))
    assert line(figure, "path-b") == [(p.x, p.y) for p in shorter.b.path]
    assert isinstance(encounter.draw(shorter), Absent)  # there is no tick with known poses of both
    drawn(over_time.ranges(shorter))


def test_each_pair_has_pictures_of_its_own(tmp_path: Path) -> None:
    run_mission(parse(several_pairs(2), "two pairs"), tmp_path)
    (tmp_path / "world.journal").unlink()
    ended = tandem("figures", tmp_path, "--only", "trajectory", "--format", "png")
    assert (ended.status, ended.err) == (0, "")
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {"trajectory-a-b", "trajectory-c-d"}


@pytest.mark.parametrize("command", ["figures", "export", "audit", "replay"])
def test_journals_of_two_runs_are_refused(command: str, folders: tuple[Path, Path], tmp_path: Path) -> None:
    _, alone = folders
    (tmp_path / "agent-b.journal").write_bytes((alone / "agent-b.journal").read_bytes())
    (tmp_path / "other").mkdir()
    run_mission(parse(several_pairs(1), "another"), tmp_path / "other")
    (tmp_path / "agent-a.journal").write_bytes((tmp_path / "other" / "agent-a.journal").read_bytes())
    ended = tandem(command, tmp_path)
    assert (ended.status, ended.out) == (2, "")
    assert ended.err.endswith(
        "agent-b.journal: belongs to another run: its configuration does not match a's\n"
    )


def test_a_journal_without_one_of_its_ticks_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    _, alone = folders
    frames = [
        frame
        for frame in journal_file.read(alone / "agent-a.journal")
        if getattr(decode(frame, OfRobot, MAX_FRAME_BYTES), "tick", None) != 5
    ]
    (tmp_path / "agent-a.journal").write_bytes(b"".join([msgpack.packb(frame) for frame in frames]))
    ended = tandem("export", tmp_path)
    assert (ended.status, ended.out) == (2, "")
    assert ended.err.endswith("agent-a.journal: an Observation of a of tick 6 is out of order\n")


def test_the_audit_checks_the_limits_of_robots_and_their_observations(folders: tuple[Path, Path]) -> None:
    _, alone = folders
    ended = tandem("audit", alone)
    assert ended.status == 0, ended.out
    assert "a and b, hardware mode: no violations" in ended.out
    assert [line.split()[0] for line in ended.out.splitlines()[3:]] == [
        rule.__name__ for rule in HARDWARE_RULES
    ]


def too_fast(message: Message) -> Message:
    return replace(message, v=2.0) if isinstance(message, Command) else message


def another_range(message: Message) -> Message:
    if isinstance(message, Report) and message.robot == "a" and message.ranges:
        first, *rest = message.ranges
        return replace(message, ranges=(replace(first, range=first.range + 1.0), *rest))
    return message


@pytest.mark.parametrize(
    ("spoilt", "rules"), [(too_fast, {"limits", "decision"}), (another_range, {"log", "report", "decision"})]
)
def test_the_audit_finds_violations_in_hardware_mode(
    spoilt: Callable[[Message], Message], rules: set[str], folders: tuple[Path, Path]
) -> None:
    _, alone = folders
    found = {path.name: list(journal_file.read(path)) for path in sorted(alone.glob("*.journal"))}
    frames = found["agent-a.journal"]
    for place, frame in enumerate(frames):
        message = decode(frame, OfRobot, MAX_FRAME_BYTES)
        other = spoilt(message)
        if other is not message:
            frames[place] = encode(other)
            break
    findings = audit_run(of_frames(found, alone))
    assert {one.rule for one in findings.violations} == rules
