"""All journaled frames are read back, up to a torn write."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compose.launch.in_process import run_mission
from compose.scenario.scenario_file import load
from protocol.journal import journal_file
from protocol.journal.environment import of_world
from protocol.journal.journal_file import CorruptJournal, Journal, RecordExists, Tail
from protocol.messages import Command, Environment, FinalReport, MissionEnd
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.examples import EXAMPLES
from world.scenario import Scenario

FRAMES = [encode(message) for message in EXAMPLES]


def written(path: Path, frames: list[bytes]) -> bytes:
    """Return the bytes of a journal of `frames` on disk."""
    with Journal(path) as book:
        for frame in frames:
            book.write(frame)
    return path.read_bytes()


def test_frames_come_back_in_order(tmp_path: Path) -> None:
    written(tmp_path / "deep" / "down" / "a.journal", FRAMES)
    assert list(journal_file.read(tmp_path / "deep" / "down" / "a.journal")) == FRAMES


def test_one_write_of_many_is_the_same_as_many_of_one(tmp_path: Path) -> None:
    with Journal(tmp_path / "at-once", fsync=True) as book:
        book.write(*FRAMES)
    assert (tmp_path / "at-once").read_bytes() == written(tmp_path / "one-by-one", FRAMES)


def test_any_msgpack_library_reads_a_journal(tmp_path: Path) -> None:
    run_mission(load("paper-1"), tmp_path)
    with (tmp_path / "world.journal").open("rb") as file:
        frames = list(msgpack.Unpacker(file))
    kinds = Environment | Scenario | Command | MissionEnd | FinalReport
    messages = [decode(frame, kinds) for frame in frames]
    assert messages[:2] == [of_world(), load("paper-1")]
    assert [type(message) for message in messages[-3:]] == [MissionEnd, FinalReport, FinalReport]
    assert len(messages) == 2 + 2 * 49 + 3
    assert msgpack.unpackb(frames[2][5:])[:3] == ["command", 0, "a"]


@pytest.mark.long
def test_a_journal_cut_anywhere_reads_back_every_whole_frame(tmp_path: Path) -> None:
    data = written(tmp_path / "whole", FRAMES)
    ends = [len(b"".join(msgpack.packb(frame) for frame in FRAMES[:i])) for i in range(len(FRAMES) + 1)]
    assert ends[-1] == len(data)
    cut = tmp_path / "cut"
    for length in range(len(data) + 1):
        cut.write_bytes(data[:length])
        assert list(journal_file.read(cut)) == FRAMES[: sum(end <= length for end in ends) - 1]


@settings(max_examples=50)
@given(st.lists(st.integers(0, 2000), max_size=12), st.none() | st.integers(1, 500))
def test_a_journal_read_as_it_grows_gives_each_frame_once(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int], most: int | None
) -> None:
    folder = tmp_path_factory.mktemp("grows")
    data = written(folder / "whole", FRAMES)
    growing = folder / "growing"
    growing.touch()
    tail, read = Tail(growing), []
    for length in [*sorted(min(cut, len(data)) for cut in cuts), len(data)]:
        growing.write_bytes(data[:length])
        read += tail.news(most)
        assert read == FRAMES[: len(read)]
    while tail.more:
        read += tail.news(most)
    assert read == FRAMES
    assert tail.news() == []


LIMITED = """
import resource, sys
from pathlib import Path
from protocol.journal.journal_file import CorruptJournal, read
resource.setrlimit(resource.RLIMIT_AS, (300 << 20, 300 << 20))
try:
    list(read(Path(sys.argv[1])))
except CorruptJournal as error:
    print(error)
"""


@pytest.mark.parametrize("frames", [0, 100])
def test_a_journal_of_any_size_is_read_in_pieces(frames: int, tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    data = written(path, FRAMES[:1] * frames)
    with path.open("ab") as file:
        file.truncate(10 << 30)
    ended = subprocess.run(
        [sys.executable, "-c", LIMITED, path], capture_output=True, text=True, check=False, timeout=60
    )
    assert (ended.stdout, ended.stderr) == (f"{path}: damaged at byte {len(data)}: not a frame\n", "")


def test_frames_in_several_pieces_are_all_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_file, "JOURNAL_PIECE_BYTES", 1000)
    few = [frame for frame in FRAMES if len(frame) < 900] * 3
    written(tmp_path / "it", few)
    assert list(journal_file.read(tmp_path / "it")) == few


def test_a_torn_frame_that_looks_like_many_takes_no_time(tmp_path: Path) -> None:
    head = b"\xc6" + MAX_FRAME_BYTES.to_bytes(4, "big")
    inner = b"\xc6" + (MAX_FRAME_BYTES // 2).to_bytes(4, "big")
    path = tmp_path / "a.journal"
    path.write_bytes(head + (inner * (MAX_FRAME_BYTES // 5))[: MAX_FRAME_BYTES - 1])
    began = time.process_time()
    with pytest.raises(CorruptJournal):
        list(journal_file.read(path))
    assert time.process_time() - began < 10.0


GARBAGE = {
    "reserved": b"\xc1",
    "a number": b"\x07",
    "nil": b"\xc0",
    "a map": b"\x81\x01\x02",
    "an array": b"\x92\x01\x02",
    "a text": b"\xa5hello",
    "an extension": b"\xd4\x05\x00",
    "zeros": b"\x00" * 64,
    "an oversized frame": msgpack.packb(b"x" * (MAX_FRAME_BYTES + 1)),
    "the head of a frame larger than any": b"\xc6\x7f\xff\xff\xff",
    "the head of an array larger than any": b"\xdd\xff\xff\xff\xff",
}


@pytest.mark.parametrize("garbage", GARBAGE)
@pytest.mark.parametrize("place", [0, 1, 5])
def test_garbage_in_the_middle_is_found_and_the_file_is_named(
    garbage: str, place: int, tmp_path: Path
) -> None:
    first = written(tmp_path / "first", FRAMES[:place])
    rest = written(tmp_path / "rest", FRAMES[place:])
    damaged = tmp_path / "damaged.journal"
    damaged.write_bytes(first + GARBAGE[garbage] + rest)
    with pytest.raises(CorruptJournal, match=r"damaged\.journal"):
        list(journal_file.read(damaged))


def test_an_existing_journal_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    data = written(path, FRAMES)
    with pytest.raises(RecordExists, match=r"a\.journal already exists"):
        Journal(path)
    assert path.read_bytes() == data


def test_a_journal_that_is_not_there_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        list(journal_file.read(tmp_path / "none"))


WRITER = """
import sys
from pathlib import Path
from protocol.journal.journal_file import Journal

book = Journal(Path(sys.argv[1]))
number = 0
while True:
    book.write(b"%d" % number, b"x" * 500)
    print(number, flush=True)
    number += 1
"""


def test_a_killed_process_has_lost_nothing_of_what_it_journaled(tmp_path: Path) -> None:
    path = tmp_path / "killed.journal"
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for _ in range(200):
            process.stdout.readline()
        process.kill()
        told = 200 + len(process.stdout.read().splitlines())
    assert process.returncode == -9
    frames = list(journal_file.read(path))
    numbers = [int(frame) for frame in frames[::2]]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= told - 1  # the last line may be torn
    assert frames[1::2] == [b"x" * 500] * (len(frames) // 2)
    assert len(frames) // 2 >= 200
