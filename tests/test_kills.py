"""Kills: the file that lists those of a run, and sweeps over them, whose trials equal the mission without."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from signal import SIGINT, SIGKILL
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace

from compose.errors import BadScenario
from compose.launch import in_process
from compose.launch.supervisor import ChildFailed
from compose.recording.kills_file import KILLS, MOST_KILLS_BYTES, Killed
from compose.recording.recording_files import KINDS, WORLD_JOURNAL, agent_journal
from compose.recording.run import Run, of_frames, read
from compose.scenario.kills import KILL_POINTS, WORLD, KillTable, drawn
from compose.scenario.scenario_file import load, parse, validate
from compose.scenario.toml_file import table_in
from compose.sweep import spec
from compose.sweep.cells import cells
from compose.sweep.trial import Trial, run_trial
from compose.view.recorded import scenes, scenes_of
from compose.view.run_data import RunData, TickData
from compose.view.web.sources import Recorded
from protocol.journal import journal_file
from protocol.journal.journal_file import MemoryJournal
from protocol.messages import Command, DeadlineMissed
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import ENDLESS, PAPER_1, TandemProcess, journals, refused, tandem, temporary_in, until
from world.scenario import Scenario

SCHEDULE = ("b@20:command", "a@30", "world@30:journal", "b@47:journal", "a@48")


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of paper-1 whose processes were killed five times."""
    folder = tmp_path_factory.mktemp("disturbed") / "run"
    kills = [word for one in SCHEDULE for word in ("--kill", one)]
    ended = tandem("run", "paper-1", "-q", "--out", folder, *kills)
    assert ended.status == 0, ended.err
    return folder


def processes_shown(run: Run) -> list[tuple[int, str, str | None, str]]:
    """Return the ends and restarts of processes that viewers of `run` show: tick, kind, robot, text."""
    return [
        (event.tick, event.kind, event.robot, event.text)
        for one in scenes_of(run)
        for event in one.events
        if event.kind in ("down", "back")
    ]


def test_the_file_lists_the_kills_and_the_journals_do_not_differ(disturbed: Path, paper_1: Path) -> None:
    assert journals(disturbed) == journals(paper_1)
    assert sorted(read(disturbed).kills, key=lambda one: (one.tick, one.who)) == [
        Killed("b", 20, "command", 0.0, 21),
        Killed("a", 30, "observation", 0.0, 30),
        Killed("world", 30, "journal", 0.0, 31),
        Killed("b", 47, "journal", 0.0, 48),
        Killed("a", 48, "observation", 0.0, 48),
    ]
    assert not (paper_1 / KILLS).exists()
    assert read(paper_1).kills == ()


def test_a_killed_process_is_shown_as_gone_and_back_with_what_it_replayed(disturbed: Path) -> None:
    def shown(tick: int, robot: str | None, replayed: int) -> list[tuple[int, str, str | None, str]]:
        name = robot or "The world"
        back = f"{name} is back: its process replayed {replayed} ticks, identical"
        return [(tick, "down", robot, f"{name} is down: its process is gone"), (tick, "back", robot, back)]

    assert processes_shown(read(disturbed)) == [
        *shown(20, "b", 21),
        *shown(30, None, 31),
        *shown(30, "a", 30),
        *shown(47, "b", 48),
        *shown(48, "a", 48),
    ]


def test_a_viewer_that_reads_the_kills_later_shows_the_same(disturbed: Path, tmp_path: Path) -> None:
    growing = Recorded("", tmp_path)
    for path in (*disturbed.glob("*.journal"), disturbed / KILLS):
        shutil.copy(path, tmp_path)
        growing.read()
    growing.load()
    assert growing.setup is not None
    assert scenes(growing.setup, growing.known) == scenes_of(read(disturbed))


def test_a_robot_is_gone_until_it_meets_a_deadline_again(paper_1: Path) -> None:
    """As in real time, where the robot stands while its process is down."""
    missed, frames = {18, 19, 25}, []
    for frame in journal_file.read(paper_1 / WORLD_JOURNAL):
        match decode(frame, KINDS, MAX_FRAME_BYTES):
            case Command(31):
                break
            case Command(tick, "a") if tick in missed:
                frames.append(encode(DeadlineMissed(tick, "a")))
            case _:
                frames.append(frame)
    run = of_frames({WORLD_JOURNAL: frames})
    for after, back in ((0.5, [(19, "back", "a")]), (None, [])):
        killed = Killed("a", 17, "command", after, 18)
        found = processes_shown(replace(run, kills=(killed,)))
        assert [one[:3] for one in found] == [(17, "down", "a"), *back]


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b'{"who":"a"}\n', "line 1: Object missing required field `tick`"),
        (b'{"who":"a","tick":1,"point":"report","after":0,"replayed_ticks":1}\n\xff\n', "line 2: "),
        (
            b'{"who":"a","tick":1,"point":"nowhere","after":0,"replayed_ticks":1}\n',
            "line 1: Invalid enum value",
        ),
        (
            b'{"who":"a","tick":-5,"point":"report","after":0,"replayed_ticks":1}\n',
            "line 1: Expected `int` >= 0",
        ),
        (
            b'{"who":"a","tick":1,"point":"report","after":-1,"replayed_ticks":1}\n',
            "line 1: Expected `float` >= 0.0",
        ),
        (b" " * (MOST_KILLS_BYTES + 1), f"it is larger than {MOST_KILLS_BYTES} bytes"),
    ],
)
def test_a_damaged_file_is_one_note_and_the_recording_is_read_without_it(
    content: bytes, complaint: str, paper_1: Path, tmp_path: Path
) -> None:
    shutil.copytree(paper_1, tmp_path / "run")
    (tmp_path / "run" / KILLS).write_bytes(content)
    run = read(tmp_path / "run")
    assert run.kills == ()
    assert len(run.notes) == 1
    assert f"{KILLS}: {complaint}" in run.notes[0]
    viewer = Recorded("", tmp_path / "run")
    viewer.load()
    viewer.load()
    assert viewer.notes == [*run.notes]
    assert viewer.known.last == 48


@pytest.mark.parametrize(
    "words",
    [
        ["audit"],
        ["replay"],
        ["figures", "--only", "ranges", "--format", "svg"],
        ["export"],
        ["export", "--pyfg"],
        ["export", "--html"],
    ],
    ids=" ".join,
)
def test_every_command_says_once_that_the_file_is_damaged_and_goes_on(
    words: list[str], paper_1: Path, tmp_path: Path
) -> None:
    shutil.copytree(paper_1, tmp_path / "run")
    command, *flags = words
    expected = tandem(command, tmp_path / "run", *flags)
    (tmp_path / "run" / KILLS).write_text('{"who":"a"}\n')
    ended = tandem(command, tmp_path / "run", *flags)
    where = tmp_path / "run" / KILLS
    assert ended.err == (
        f"tandem {command}: {where}: line 1: Object missing required field `tick`; "
        "the recording is read without the processes that were killed\n"
    )
    assert (ended.status, ended.out) == (0, expected.out)


def test_a_list_that_is_a_folder_hides_no_journal(paper_1: Path, tmp_path: Path) -> None:
    shutil.copytree(paper_1, tmp_path / "run")
    (tmp_path / "run" / KILLS).mkdir()
    ended = tandem("replay", tmp_path / "run")
    assert (ended.status, ended.err.count("\n")) == (0, 1)
    viewer = Recorded("", tmp_path / "run")
    viewer.load()
    assert viewer.known.last == 48
    assert [KILLS in note for note in viewer.notes] == [True]


def test_kills_of_no_process_and_of_ticks_that_never_come_are_ignored(paper_1: Path) -> None:
    killed = [Killed("c", 5, "report", 0.0, 5), Killed("a", 10**30, "report", 0.0, 5)]
    assert processes_shown(replace(read(paper_1), kills=tuple(killed))) == []


@pytest.mark.parametrize(("replayed", "said"), [(22, "runs again"), (20, None), (21, None)])
def test_a_number_of_replayed_ticks_that_cannot_be_right_is_left_out(
    paper_1: Path, replayed: int, said: str | None
) -> None:
    """A process that is killed in tick 20 has 20 or 21 ticks in its journal."""
    killed = (Killed("b", 20, "command", 0.0, replayed),)
    *_, (tick, kind, robot, text) = processes_shown(replace(read(paper_1), kills=killed))
    assert (tick, kind, robot) == (20, "back", "b")
    assert text == f"b is back: its process {said or f'replayed {replayed} ticks, identical'}"


def test_thousands_of_kills_are_shown_in_time(paper_1: Path) -> None:
    """Each is looked at once, not once a tick."""
    looked_at = 0

    class Counted(RunData):
        def at(self, tick: int) -> TickData:
            nonlocal looked_at
            looked_at += 1
            return super().at(tick)

    known = Counted()
    world = read(paper_1).world
    assert world is not None
    for tick in world.ticks:
        known.add_tick(tick)
        known.ticks[tick.truth.tick].late.add("a")
    looked_at = 0
    known.add_kills([Killed("a", tick % 49, "report", None, tick) for tick in range(14_000)])
    assert looked_at == len(world.ticks)
    assert all("a" in known.ticks[tick].down for tick in range(48))


def test_a_run_does_not_add_to_the_kills_of_another(tmp_path: Path) -> None:
    (tmp_path / KILLS).touch()
    refused(tandem("run", "paper-1", "-q", "--out", tmp_path), "already contains a recording")


def test_a_torn_last_line_is_ignored(disturbed: Path, tmp_path: Path) -> None:
    shutil.copytree(disturbed, tmp_path / "run")
    whole = (disturbed / KILLS).read_bytes()
    (tmp_path / "run" / KILLS).write_bytes(whole[:-5])
    assert read(tmp_path / "run").kills == read(disturbed).kills[:-1]


SMALL = """
name = "small"
scenario = "paper-1"
trials = 1
[[axis]]
field = "kill[0].tick"
values = [46, 49]                # of 48
[[axis]]
name = "where"
fields = ["kill[0].who", "kill[0].point"]
labels = ["nobody", "everyone"]
values = [[[], "observation"], [["a", "b", "world"], "report"]]
"""
DRAWN = '[[kill]]\ntick = [3, 40]\npoint = "?"\n[[kill]]\nwho = ["a", "b"]\ntick = [0, 48]\nafter = 0.25\n'
HUNG = 'name = "hung"\nscenario = "endless.toml"\ntrials = 2\ntrial_timeout = '


@pytest.fixture(autouse=True)
def nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Assert that no process of a test remains.

    All temporary folders are in tmp_path, which identifies the processes by their arguments.
    """
    temporary_in(tmp_path, monkeypatch)
    yield
    until(lambda: not left(tmp_path), "no process is left")


def left(tmp_path: Path) -> list[int]:
    """Return the processes with a path in `tmp_path` in their command line."""
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().replace("\0", " ").split()
        except OSError:  # the process has ended
            continue
        if any(word.startswith(f"{tmp_path}/") for word in words):
            found.append(int(pid))
    return found


# --- trials -------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_run_with_kills_has_the_recording_of_the_run_without_kills(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    ended = tandem("sweep", "small.toml", "--out", "out", cwd=tmp_path)
    assert ended.status == 0, ended
    assert "audited: 4 of 4 trials, 4 clean" in ended.out
    rows = pq.read_table(tmp_path / "out" / "trials.parquet").to_pylist()
    assert [row["kills"] for row in rows] == [0, 3, 0, 0]
    assert all(row["same_record"] is True and row["ticks"] == 48 for row in rows)
    assert "<!-- wall time [s]" in (tmp_path / "out" / "figures" / "wall-kill-0-tick.svg").read_text()


@pytest.mark.parametrize("name", [WORLD_JOURNAL, agent_journal("a"), agent_journal("b"), "ticks.csv"])
def test_a_trial_with_a_different_recording_fails_and_names_the_difference(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = in_process.played

    def otherwise(scenario: Scenario, sinks: dict[str, MemoryJournal]) -> Run:
        recording = real(scenario, sinks)
        if name == "ticks.csv":
            return Run(replace(recording.history, ticks=recording.ticks[:-1]))
        sinks[name].frames[-1] += b"!"
        return recording

    monkeypatch.setattr(in_process, "played", otherwise)
    found = run_trial(Trial(0, 0, load("paper-1"), processes=False, kills=()))
    assert (found.outcome, found.ticks, found.same_record) == ("failed", 48, False)
    assert found.reason == f"the recording differs from the run in one process: {name}"


def test_a_process_that_is_never_started_again_ends_its_trial() -> None:
    kills = drawn([KillTable("b", 2, after="never")], 1, ("a", "b"))
    with pytest.raises(ChildFailed, match=r"agent b was killed at tick 2 \(--kill b@2:observation\+never\)"):
        run_trial(Trial(0, 0, load("paper-1"), processes=False, kills=kills))


@pytest.mark.long
@pytest.mark.parametrize("how", ["killed, then hung", "sweep stopped", "sweep killed"])
def test_however_a_trial_ends_its_processes_end_with_it(how: str, tmp_path: Path) -> None:
    (tmp_path / "endless.toml").write_text(ENDLESS + '[[kill]]\nwho = "a"\ntick = 1\n')
    (tmp_path / "hung.toml").write_text(HUNG + ("10.0" if "hung" in how else "600.0"))
    with TandemProcess("sweep", "hung.toml", "--out", "out", "--workers", "1", cwd=tmp_path) as command:
        command.until(lambda: list(tmp_path.glob("tmp/*/*/agent-b.journal")), "they play")
        command.until(lambda: len(left(tmp_path)) == 4, "a worker, a world and two agents are there")
        if "hung" in how:
            os.kill(min(left(tmp_path)), SIGKILL)
        else:
            command.tell(SIGINT if "stopped" in how else SIGKILL)
        assert command.ended().status == {"sweep stopped": 130, "sweep killed": -SIGKILL}.get(how, 3)
    until(lambda: not left(tmp_path), "no process is left")
    if "hung" in how:
        rows = pq.read_table(tmp_path / "out" / "trials.parquet").to_pylist()
        killed, hung = [row["error"] for row in rows]
        assert killed.startswith(
            "died: its process was killed by signal 9"
        )  # and its last line of output, if there was one
        assert hung == "hung: no answer within 10 s"


# --- scenarios with kills -----------------------------------------------------------------------------


def test_open_fields_of_a_kill_follow_from_the_seed() -> None:
    setting = validate(table_in(PAPER_1 + DRAWN, "mine"), "mine")
    assert setting.kills(7) == setting.kills(7)
    found = [setting.kills(seed) for seed in range(200)]
    assert {one.tick for one, _, _ in found} == set(range(3, 41))
    assert set(product(("a", "b", WORLD), KILL_POINTS)) == {(one.who, one.point) for one, _, _ in found}
    assert all([(a.who, b.who), a.tick] == [("a", "b"), b.tick] for _, a, b in found)
    assert {(a.point, a.after, a.text) for _, a, _ in found} == {
        ("observation", 0.25, f"a@{tick}:observation+0.250000s") for tick in range(49)
    }


def test_kills_are_not_part_of_the_worlds_scenario() -> None:
    assert parse(PAPER_1 + DRAWN, "mine") == parse(PAPER_1, "mine")


@pytest.mark.long
def test_a_run_takes_the_kills_of_its_file_and_those_of_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(PAPER_1 + '[[kill]]\nwho = "world"\ntick = 5\npoint = "report"\n')
    ended = tandem("run", "mine.toml", "-q", "--kill", "b@900", cwd=tmp_path)
    assert ended.status == 0, ended
    assert [line for line in ended.err.splitlines() if line.startswith("tandem run")] == [
        "tandem run: world was killed at tick 5, and is restarted",
        "tandem run: --kill b@900: not reached",
    ]


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ('who = "z"', "kill[0].who: there is no 'z'; there are a, b, world"),
        ('who = ["a", "z"]', "kill[0].who: there is no 'z'"),
        ("who = 1", "kill[0].who: "),
        ("tick = -1", "kill[0].tick: "),
        ("tick = [5, 2]", "kill[0].tick: the lower bound 5 is above the upper bound 2"),
        ("tick = [5]", "kill[0].tick: "),
        ('tick = "?"', "kill[0].tick: "),
        ('point = "commands"', "kill[0].point: "),
        ("after = -1.0", "kill[0].after: "),
        ('after = "later"', "kill[0].after: "),
        ('where = "observation"', "kill[0]: unknown field 'where'"),
        ("tick = 5\n[[kill]]\ntick = [2, 1]", "kill[1].tick: the lower bound 2 is above the upper bound 1"),
    ],
)
def test_a_kill_that_cannot_be_is_named_with_its_place(table: str, says: str) -> None:
    with pytest.raises(BadScenario) as bad:
        parse(PAPER_1 + f"[[kill]]\n{table}\n", "mine.toml")
    assert str(bad.value).startswith(f"mine.toml: {says}")
    assert "\n" not in str(bad.value)


def test_a_command_that_restarts_no_process_refuses_a_scenario_with_kills(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(PAPER_1 + "[[kill]]\n")
    says = "mine.toml: kill: --in-process has no processes to kill"
    refused(tandem("run", "mine.toml", "--in-process", cwd=tmp_path), says)
    world = tandem("world", "mine.toml", "--listen", "tcp/127.0.0.1:7447", cwd=tmp_path)
    refused(world, "mine.toml: kill: `tandem world` starts no robots; use `tandem run`")


# --- shipped sweeps --------------------------------------------------------------------------------


def killed(name: str, seed: int) -> list[tuple[Any, ...]]:
    """Return the kills of each cell of the sweep: process, tick and point."""
    tables = [msgspec.convert(cell.table["kill"], list[KillTable]) for cell in cells(spec.load(name))]
    return [
        tuple((kill.who, kill.tick, kill.point) for kill in drawn(table, seed, ("a", "b")))
        for table in tables
    ]


def test_the_sweep_of_crashes_kills_everyone_in_every_tick_at_every_point() -> None:
    end = in_process.run_mission(load("paper-1")).end
    assert end is not None
    ticks = range(end.tick + 1)
    everything = {
        ((who, tick, point),) for who in ("a", "b", WORLD) for tick in ticks for point in KILL_POINTS
    }
    assert Counter(killed("crash", 1)) == Counter(everything) + Counter({(): len(ticks)})


def test_the_sweep_of_two_kills_kills_any_two_or_both_robots_in_one_tick() -> None:
    end = in_process.run_mission(load("paper-2")).end
    assert end is not None
    for seed in range(50):
        two, one = killed("crash-twice", seed)
        assert len(two) == 2
        assert all(0 <= tick <= end.tick for _, tick, _ in (*two, *one))
        assert {who for who, _, _ in one} == {"a", "b"}
        assert len({tick for _, tick, _ in one}) == 1
