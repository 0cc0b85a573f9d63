"""Files of a user and of Tandem: regular, complete or absent; journals are read to a torn write."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compose.errors import UserError
from compose.launch import in_process
from compose.launch.in_process import run_mission
from compose.recording import summary_json
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.view.export import folder as export
from protocol import files
from protocol.journal import journal_file
from protocol.journal.environment import of_world
from protocol.journal.journal_file import CorruptJournal, Journal, RecordExists, Tail
from protocol.messages import Command, Environment, FinalReport, MissionEnd
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import PAPER_1, Ended, TandemProcess, copied, processes_of, tandem
from tests.examples import EXAMPLES
from tests.series import series
from tests.test_house import HOUSE
from world.scenario import Scenario


def fifo(path: Path) -> None:
    os.mkfifo(path)


def listening(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        here = Path.cwd()
        os.chdir(path.parent)  # the path of a socket must be short
        try:
            one.bind(path.name)
        finally:
            os.chdir(here)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


OTHERS: dict[str, Callable[[Path], None]] = {
    "fifo": fifo,
    "socket": listening,
    "device": device,
    "directory": Path.mkdir,
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    in_process.run_mission(load("paper-1"), folder)
    return folder


def one_line(ended: Ended, *words: str) -> None:
    assert ended.status == 2, ended
    assert ended.err.count("\n") == 1, ended.err
    assert all(word in ended.err for word in words), ended.err


@pytest.mark.parametrize("kind", OTHERS)
def test_only_a_regular_file_is_opened(kind: str, tmp_path: Path) -> None:
    OTHERS[kind](tmp_path / "it")
    with pytest.raises(files.NotRegular) as caught:
        files.open_file(tmp_path / "it")
    assert caught.value.strerror == (
        "it is a directory" if kind == "directory" else "it is not a regular file"
    )


@pytest.mark.parametrize("command", [["run"], ["sweep"], ["run", "paper-1", "--in-process", "--out"]])
def test_a_fifo_in_place_of_a_users_file_is_one_line(command: list[str], tmp_path: Path) -> None:
    fifo(tmp_path / "it")
    with TandemProcess(*command, "it", cwd=tmp_path) as tandem:
        one_line(tandem.ended(), "it")


@pytest.mark.parametrize("command", ["audit", "replay", "export", "figures"])
def test_a_fifo_in_place_of_a_journal_is_one_line(command: str, recording: Path, tmp_path: Path) -> None:
    copied(recording, tmp_path)
    (tmp_path / "world.journal").unlink()
    fifo(tmp_path / "world.journal")
    with TandemProcess(command, tmp_path) as tandem:
        one_line(tandem.ended(), "not a regular file")


def test_a_fifo_or_a_link_in_place_of_a_journal_is_not_resumed(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "agent-a.journal").symlink_to(recording / "agent-a.journal")
    fifo(tmp_path / "agent-b.journal")
    before = (recording / "agent-a.journal").read_bytes()
    for robot in "ab":
        with TandemProcess("agent", robot, "--connect", "tcp/127.0.0.1:9", "--out", tmp_path) as tandem:
            one_line(tandem.ended(), f"agent-{robot}.journal cannot be opened")
    assert (recording / "agent-a.journal").read_bytes() == before


def test_a_byte_order_mark_is_accepted_in_scenarios_and_sweeps(tmp_path: Path) -> None:
    (tmp_path / "it.toml").write_text(PAPER_1, encoding="utf-8-sig")
    spec = 'name = "small"\nscenario = "it.toml"\ntrials = 1\n[[axis]]\nfield = "v"\nvalues = [1]\n'
    (tmp_path / "small.toml").write_text(spec, encoding="utf-8-sig")
    with TandemProcess("run", "it.toml", "--in-process", "-q", cwd=tmp_path) as tandem:
        assert tandem.ended() == (0, "localised after 48 ticks\n", "")
    with TandemProcess("sweep", "small.toml", cwd=tmp_path) as tandem:
        one_line(tandem.ended(), "small.toml: axis[0].field: 'v'")


# --- written files ----------------------------------------------------------------------------------------


@pytest.fixture
def no_room() -> Iterator[Callable[[int], None]]:
    """Yield a function that limits the size in bytes of files of this process, like a full disk."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.getsignal(signal.SIGXFSZ)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda room: resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_file_without_room_is_as_it_was(tmp_path: Path, no_room: Callable[[int], None]) -> None:
    (tmp_path / "old").write_text("before")
    no_room(1000)
    for name in ("old", "new"):
        with pytest.raises(OSError, match="too large") as caught:
            files.write(tmp_path / name, "x" * 1001)
        assert caught.value.filename == str(tmp_path / name)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("old", "before")]


def test_every_file_of_a_run_and_an_export_is_whole_or_absent_however_little_room_there_is(
    recording: Path, tmp_path: Path, no_room: Callable[[int], None]
) -> None:
    pytest.importorskip("foxglove")
    played = in_process.run_mission(load("paper-1"))
    told = summary_json.summary(played, "in-process", None)
    whole = tmp_path / "whole"
    whole.mkdir()
    summary_json.leave(played, told, whole)
    export.export(read(recording), whole)
    wanted = {path.name: path.read_bytes() for path in whole.iterdir()}
    for room in (0, 5_000, 12_000):
        out = tmp_path / str(room)
        out.mkdir()
        no_room(room)
        with suppress(OSError):
            summary_json.leave(played, told, out)
        with pytest.raises(UserError, match="too large"):
            export.export(read(recording), out)
        left = {path.name: path.read_bytes() for path in out.iterdir()}
        assert left == {name: wanted[name] for name in left}
        assert len(left) < len(wanted)


FILLED = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_100, resource.RLIM_INFINITY))
from compose.cli.main import main
main(sys.argv[1:])
"""
"""A scenario whose journals fit the limit, and whose ticks.csv does not."""
NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}
"""Python does not notice that the limit cuts off the bytecode that it caches."""


@pytest.mark.parametrize("how", [["--in-process"], []])
def test_the_outcome_is_printed_where_a_full_disk_takes_no_summary(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "it.toml").write_text(PAPER_1)
    ended = subprocess.run(
        [sys.executable, "-c", FILLED, "run", "it.toml", "-q", *how, "--out", "full", "--no-export"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), **NO_BYTECODE},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.stdout == "localised after 48 ticks\n"
    assert ended.stderr == "tandem run: full cannot be written: File too large\n"
    assert ended.returncode == 3
    assert not (tmp_path / "full" / "ticks.csv").exists()


WRITING = (
    "run paper-1 --in-process --out OUT --no-export",
    "run paper-1 --out OUT --export",
    "sweep ../few.toml --out OUT --workers 1",
    "figures RECORDING --only ranges --format svg",
    "export RECORDING --out OUT",
    "export RECORDING --pyfg --out OUT",
    "estimate tests/data/uwb/tiers-a-b-30-s.pyfg --noise uwb-calibrated --out OUT",
    "calibrate tests/data/uwb/tiers-a-b-30-s.pyfg --out out.toml",
    "keys OUT --robots a,b",
    "init OUT",
    "containers group-8 out.yaml",
)
"""Commands that write files and print."""


@pytest.mark.parametrize("command", series(WRITING))
def test_what_a_command_writes_is_complete_where_the_reader_of_its_output_has_gone(
    command: str, recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "few.toml").write_text('name = "few"\nscenario = "random"\ntrials = 4\n')
    files_of = {}
    for reader in ("gone", "there"):
        folder = tmp_path / reader
        folder.mkdir()
        shutil.copytree(recording, folder / "recording")
        (folder / "tests").symlink_to(HOUSE / "tests")
        words = command.replace("OUT", "out").replace("RECORDING", "recording").split()
        if reader == "there":
            assert tandem(*words, cwd=folder).status in (0, 1)
        else:
            end, output = os.pipe()
            os.close(end)
            with TandemProcess(*words, terminal=output, cwd=folder) as run:
                os.close(output)
                ended = run.ended()
            assert (ended.status, ended.err) == (141, "")
        files_of[reader] = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    assert files_of["gone"].keys() == files_of["there"].keys()


def test_what_is_written_replaces_a_link_and_leaves_what_it_led_to(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    kept = tmp_path / "kept"
    kept.write_text("kept")
    out = tmp_path / "out"
    out.mkdir()
    names = ("summary.json", *export.FILES)
    for name in names:
        (out / name).symlink_to(kept)
    played = in_process.run_mission(load("paper-1"))
    summary_json.leave(played, summary_json.summary(played, "in-process", None), out)
    export.export(read(recording), out)
    assert kept.read_text() == "kept"
    assert not [name for name in names if (out / name).is_symlink()]


def test_the_draft_of_a_process_that_was_killed_is_removed_and_that_of_a_live_one_is_not(
    tmp_path: Path,
) -> None:
    begun = "import sys, time; from pathlib import Path; from protocol import files\n" + (
        "with files.draft(Path(sys.argv[1])): print('begun', flush=True); time.sleep(600)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", begun, tmp_path / "it"],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), **NO_BYTECODE},
    ) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == b"begun\n"
            (draft,) = tmp_path.iterdir()
            files.write(tmp_path / "it", "mine")
            assert draft.exists()
        finally:
            other.kill()
    files.write(tmp_path / "it", "mine")
    assert [path.name for path in tmp_path.iterdir()] == ["it"]


# --- limits -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("-n 12", "a run as processes takes .* open files, and the limit is 12"),
        ("-n 20", "takes .* open files, and the limit is 20"),
        ("-v 100000", "Tandem takes .* MB of memory, and the limit is 97"),
        ("-v 500000", "a Zenoh session takes .* MB of memory, and the limit is 488"),
    ],
)
def test_too_few_descriptors_or_too_little_memory_is_one_line(limit: str, words: str, tmp_path: Path) -> None:
    through = ("sh", "-c", f'ulimit {limit} && exec "$@"', "sh")
    with TandemProcess("run", "paper-1", "-q", "--out", tmp_path / "out", through=through) as tandem:
        status, out, err = tandem.ended()
    assert (status, out, err.count("\n")) == (3, "", 1), err
    assert re.search(words, err), err
    assert not processes_of(tmp_path)


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
