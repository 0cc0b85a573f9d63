"""The file that lists the killed processes of a run: the journals are those of a run without a kill."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from msgspec.structs import replace

from compose.recording.kills_file import KILLS, MOST_KILLS_BYTES, Killed
from compose.recording.recording_files import KINDS, WORLD_JOURNAL
from compose.recording.run import Run, of_frames, read
from compose.view.recorded import scenes, scenes_of
from compose.view.run_data import RunData, TickData
from compose.view.web.sources import Recorded
from protocol.journal import journal_file
from protocol.messages import Command, DeadlineMissed
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import journals, refused, tandem

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
