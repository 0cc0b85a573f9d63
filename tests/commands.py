"""The command `tandem` as people start it: real processes, a bound on every wait, nobody left behind."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from signal import Signals
from types import TracebackType
from typing import IO, NamedTuple

import pytest

from compose.local import free_endpoint
from protocol import journal
from tests import warm

BOUND_S = 60.0
"""longer than anything takes that comes at all, on a busy machine too"""
LOOK_AGAIN_S = 0.002

SECTION_IV = """
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.141592653589793
"""
PAPER_1 = f"""
name = "paper-1"
seed = 1
{SECTION_IV}
[planner]
variant = "paper"
[[robot]]
id = "a"
anchor = [0.0, 0.0]
start = [2.4, -1.2, 4.8]
[[robot]]
id = "b"
anchor = [10.0, 0.0]
start = [11.3, -0.4, 3.6]
"""
LONG = f"""
name = "long"
seed = 1
{SECTION_IV}
[planner]
variant = "paper"
[[robot]]
id = "a"
anchor = [0.0, 0.0]
[[robot]]
id = "b"
anchor = [60.0, 0.0]
"""
"""1874 ticks: time enough to interfere with it"""
LONG_TICKS = 1874
ASSURED = "max_ticks = 1_000_000\n" + PAPER_1.replace('"paper"', '"assured"').replace(
    "10.0, 0.0", "60.0, 0.0"
).replace("11.3", "61.3")
"""of the variant for which standing still is no harm, however long a busy machine makes robots stand"""
REAL_TIME = ASSURED.replace("1_000_000", "600")
"""the same for `--rate 20`: it is over after half a minute, whatever the robots come to by then"""
OVER = (0, 1)
"""statuses of a mission that has come to its end; in real time nobody promises which"""
ENDLESS = (
    LONG.replace("60.0", "400.0").replace("max_speed = 1.0", "max_speed = 0.1").replace('"long"', '"endless"')
)
"""so long that it does not end while a test runs"""
LONG_JOURNAL_BYTES = 180_000


def several_pairs(pairs: int) -> str:
    """A scenario of as many pairs, each on a line of its own; robots a and b are peers, c and d, ..."""
    ids = "abcdefgh" if pairs <= 4 else [f"r{i}" for i in range(2 * pairs)]
    robots = [
        f'[[robot]]\nid = "{ids[i]}"\npeer = "{ids[i ^ 1]}"\nanchor = [{10.0 * (i % 2)}, {40.0 * (i // 2)}]\n'
        for i in range(2 * pairs)
    ]
    return f'name = "pairs"\nseed = 5\n{SECTION_IV}' + "".join(robots)


class Ended(NamedTuple):
    """A command that has come to its end."""

    status: int
    """negative is the signal that killed it"""
    out: str
    err: str


class Command:
    """A process of `tandem`, in a session of its own; told to stop, then killed, where its `with` ends."""

    def __init__(
        self,
        *arguments: str | Path,
        cwd: Path | None = None,
        terminal: int | None = None,
        through: Sequence[str] = (),
    ) -> None:
        """`terminal` takes its standard output, if given; `through` is a command that becomes it.

        A run leaves its record without an export of it, where nothing is said of that: it takes longer.
        """
        words = _words(arguments)
        self._out = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the command
        self._err = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [*through, sys.executable, "-P", "-m", "compose", *words],
            stdin=subprocess.DEVNULL,
            stdout=self._out if terminal is None else terminal,
            stderr=self._err,
            start_new_session=True,
            cwd=cwd,
        )
        self.pid = self._process.pid

    @property
    def out(self) -> str:
        """Its standard output so far."""
        return _read(self._out)

    @property
    def err(self) -> str:
        """Its standard error so far."""
        return _read(self._err)

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait for `condition`, which the command must bring about before it ends."""

        met = False

        def come() -> bool:
            nonlocal met
            met = bool(condition())
            return met or not self.running

        until(come, f"{what}\n{self.err}")
        assert met or condition(), f"ended before {what}: {self.out}{self.err}"

    def until_says(self, words: str) -> None:
        """Wait until it has said `words`, on either stream."""
        self.until(lambda: words in self.out + self.err, f"it says '{words}'")

    def until_written(self, path: Path, amount: int) -> None:
        """Wait until `path` holds so many bytes."""
        self.until(lambda: size(path) >= amount, f"{path.name} holds {amount} bytes")

    def until_answered(self, robot: str, record: Path) -> None:
        """Wait until `robot` has answered tick 0: its Sense, Drive and Estimate are on record."""
        path = record / f"agent-{robot}.journal"
        self.until(lambda: path.exists() and len(list(journal.read(path))) >= 5, f"{robot} answers tick 0")

    def ended(self, within: float = BOUND_S) -> Ended:
        """Its end, which must come `within` seconds."""
        try:
            status = self._process.wait(within)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {within:g} s: {self.out}{self.err}") from None
        return Ended(status, self.out, self.err)

    def tell(self, number: Signals) -> bool:
        """Send a signal to its process group, as a terminal does on Ctrl-C; whether it was still there."""
        if self.running:
            os.killpg(self.pid, number)
            return True
        return False

    def catches(self, number: Signals) -> bool:
        """Whether it handles that signal by now."""
        return bool(_signals_caught(self.pid) >> (number - 1) & 1)

    def __enter__(self) -> Command:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.running:
            self._process.terminate()
            try:
                self._process.wait(10.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._out.close()
        self._err.close()


def tandem(*arguments: str | Path, cwd: Path | None = None) -> Ended:
    """The command, to its end."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        status = warm.run(_words(arguments), cwd, out, err, BOUND_S)
        return Ended(status, _read(out), _read(err))


def _words(arguments: Sequence[str | Path]) -> list[str]:
    words = list(map(str, arguments))
    if words[:1] == ["run"] and "--out" in words and not {"--export", "--no-export"} & {*words}:
        words.append("--no-export")
    return words


def on_a_terminal(*arguments: str | Path) -> tuple[int, str]:
    """The command, to its end, on a terminal of 80 columns: its status, and all that was written there."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))  # the last two are pixels
    shown = b""
    with Command(*arguments, terminal=theirs) as command:
        os.close(theirs)
        while True:
            try:
                shown += os.read(ours, 65536)
            except OSError:  # the terminal's other end is closed: the command has ended
                break
        os.close(ours)
        return command.ended().status, shown.decode(errors="replace")


@contextmanager
def world(scenario: str | Path, *arguments: str | Path) -> Iterator[tuple[Command, str]]:
    """A world that waits for its robots, and the endpoint where it does."""
    endpoint = free_endpoint()
    with Command("world", scenario, "--listen", endpoint, *arguments) as command:
        command.until_says("waiting for")
        yield command, endpoint


def until(condition: Callable[[], object], what: str, bound: float = BOUND_S) -> None:
    """Wait until `condition` holds."""
    give_up = time.monotonic() + bound
    while not condition():
        assert time.monotonic() < give_up, f"not within {bound:g} s: {what}"
        time.sleep(LOOK_AGAIN_S)


def processes_of(mark: str | Path) -> dict[int, list[str]]:
    """The processes whose command line names `mark`: their words, by process id.

    A forked process shows its command line as one text.
    """
    found = {}
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            try:
                words = (process / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ").split()
            except OSError:  # ended meanwhile
                continue
            if str(mark) in words:
                found[int(process.name)] = words
    return found


def process_of(mark: str | Path, *words: str) -> int:
    """The one process whose command line names `mark` and has `words` in a row."""
    wanted = " ".join(words)
    found = [pid for pid, said in processes_of(mark).items() if f" {wanted} " in f" {' '.join(said)} "]
    assert len(found) == 1, f"{wanted}: {found}"
    return found[0]


def temporary_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder there in which all temporary ones are from now on, so that what is left of them is known."""
    found = folder / "tmp"
    found.mkdir()
    monkeypatch.setenv("TMPDIR", str(found))
    monkeypatch.setattr(tempfile, "tempdir", str(found))
    return found


def size(path: Path) -> int:
    """In bytes; 0 where there is no such file."""
    return path.stat().st_size if path.exists() else 0


def journals(folder: Path) -> dict[str, bytes]:
    """Every journal in `folder`, by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.journal"))}


def _read(file: IO[bytes]) -> str:
    """All of it. Not through its position, which the process that writes it shares."""
    return os.pread(file.fileno(), 1 << 24, 0).decode(errors="replace")


def _signals_caught(pid: int) -> int:
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt"))
