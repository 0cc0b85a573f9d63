"""The command `tandem` as a user starts it: real processes, bounded waits, no process left running."""

from __future__ import annotations

import fcntl
import os
import pty
import re
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

from compose.launch.processes import free_endpoint
from protocol.journal import journal_file
from tests import warm

BOUND_S = 60.0
"""The time in s after which a wait fails; longer than any successful wait, even on a busy machine."""
POLL_S = 0.002
"""The time in s between two checks of a condition."""

SECTION_IV = """
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.141592653589793
"""
PAIR = """
[[robot]]
id = "a"
anchor = [0.0, 0.0]
[[robot]]
id = "b"
anchor = [10.0, 0.0]
"""
"""The robots of a pair with drawn starts."""
BENT = 249
"""A seed of `noisy` with which both positions lie along arcs for a tick."""

PAPER_1 = f"""
name = "paper-1"
seed = 1
{SECTION_IV}
[planner]
name = "paper"
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
name = "paper"
[[robot]]
id = "a"
anchor = [0.0, 0.0]
[[robot]]
id = "b"
anchor = [60.0, 0.0]
"""
"""A scenario of LONG_TICKS ticks: long enough for a test to interfere with the run."""
LONG_TICKS = 1874
ASSURED = "max_ticks = 1_000_000\n" + PAPER_1.replace('"paper"', '"assured"').replace(
    "10.0, 0.0", "60.0, 0.0"
).replace("11.3", "61.3")
"""A scenario of the planner that tolerates any number of missed deadlines, as on a busy machine."""
REAL_TIME = ASSURED.replace("1_000_000", "600")
"""ASSURED for `--rate 20`, with fewer ticks. It ends after half a minute, with any outcome."""
OVER = (0, 1)
"""The exit statuses of a mission that has ended; in real time, either is possible."""
LONGER = LONG.replace("60.0", "120.0")
"""A scenario of 4794 ticks: long enough for other commands to start and end meanwhile."""
ENDLESS = (
    LONG.replace("60.0", "400.0").replace("max_speed = 1.0", "max_speed = 0.1").replace('"long"', '"endless"')
)
"""A scenario so long that it does not end during a test."""
LONG_JOURNAL_BYTES = 185_000
"""The size in bytes that the world's journal of LONG exceeds during the run."""


def several_pairs(pairs: int) -> str:
    """Return a scenario of `pairs` pairs on lines 40 m apart: a and b are peers, c and d, ..."""
    ids = "abcdefgh" if pairs <= 4 else [f"r{i}" for i in range(2 * pairs)]
    robots = [
        f'[[robot]]\nid = "{ids[i]}"\npeer = "{ids[i ^ 1]}"\nanchor = [{10.0 * (i % 2)}, {40.0 * (i // 2)}]\n'
        for i in range(2 * pairs)
    ]
    return f'name = "pairs"\nseed = 5\n{SECTION_IV}' + "".join(robots)


def anchored(**anchors: tuple[float, float]) -> str:
    """Return the tables of robots that start by these anchors."""
    return "".join(f'[[robot]]\nid = "{robot}"\nanchor = {list(at)}\n' for robot, at in anchors.items())


class Ended(NamedTuple):
    """The result of a command that has ended."""

    status: int
    """exit status; if negative, the number of the signal that killed the process"""
    out: str
    """standard output"""
    err: str
    """standard error"""


class TandemProcess:
    """A process of `tandem` in its own session. When its `with` ends, it is terminated, then killed."""

    def __init__(
        self,
        *arguments: str | Path,
        cwd: Path | None = None,
        terminal: int | None = None,
        errors: int | None = None,
        through: Sequence[str] = (),
    ) -> None:
        """Start the command. `through` is a command that execs it.

        `terminal` receives its standard output, and `errors` its standard error.

        `run` gets `--no-export` unless the arguments say otherwise, because an export takes longer.
        """
        words = _words(arguments)
        self._out = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the command
        self._err = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [*through, sys.executable, "-P", "-m", "compose.cli", *words],
            stdin=subprocess.DEVNULL,
            stdout=self._out if terminal is None else terminal,
            stderr=self._err if errors is None else errors,
            start_new_session=True,
            cwd=cwd,
            # Of Python, without the width that pytest's import of readline adds to that of the C library.
            env={name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")},
        )
        self.pid = self._process.pid

    @property
    def out(self) -> str:
        """The standard output so far."""
        return _read(self._out)

    @property
    def err(self) -> str:
        """The standard error so far."""
        return _read(self._err)

    @property
    def running(self) -> bool:
        """True while the process has not ended."""
        return self._process.poll() is None

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait until `condition` holds, which must be before the command ends."""

        holds = False

        def check() -> bool:
            nonlocal holds
            holds = bool(condition())
            return holds or not self.running

        until(check, lambda: f"{what}\n{self.out}{self.err}")
        status = self._process.poll()
        assert holds or condition(), f"ended with status {status} before {what}: {self.out}{self.err}"

    def until_prints(self, words: str) -> None:
        """Wait until the command has printed `words` on either stream."""
        self.until(lambda: words in self.out + self.err, f"it prints '{words}'")

    def until_written(self, path: Path, amount: int) -> None:
        """Wait until the file at `path` has at least `amount` bytes."""
        self.until(lambda: size(path) >= amount, f"{path.name} has {amount} bytes")

    def until_answered(self, robot: str, recording: Path) -> None:
        """Wait until `robot` has answered tick 0: its Observation, Command and Estimate are recorded."""
        path = recording / f"agent-{robot}.journal"
        self.until(
            lambda: path.exists() and len(list(journal_file.read(path))) >= 5, f"{robot} answers tick 0"
        )

    def ended(self, within: float = BOUND_S) -> Ended:
        """Return the result of the command, which must end `within` seconds."""
        try:
            status = self._process.wait(within)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {within:g} s: {self.out}{self.err}") from None
        return Ended(status, self.out, self.err)

    def tell(self, number: Signals) -> bool:
        """Send a signal to the process group, as Ctrl-C does, and return whether the process still ran."""
        if self.running:
            os.killpg(self.pid, number)
            return True
        return False

    def catches(self, number: Signals) -> bool:
        """Return true if the process has installed a handler for the signal."""
        return bool(_signals_caught(self.pid) >> (number - 1) & 1)

    def __enter__(self) -> TandemProcess:
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
    """Run the command to its end in a forked process, and return its result."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        status = warm.run(_words(arguments), cwd, out, err, BOUND_S)
        return Ended(status, _read(out), _read(err))


def _words(arguments: Sequence[str | Path]) -> list[str]:
    words = list(map(str, arguments))
    if words[:1] == ["run"] and "--out" in words and not {"--export", "--no-export"} & {*words}:
        words.append("--no-export")
    if words[:1] == ["run"] and "--kill" in words and "--timeout" not in words:
        words += ["--timeout", str(BOUND_S)]  # what ends the wait is that the killed process is back
    return words


def on_a_terminal(*arguments: str | Path, columns: int = 80, cwd: Path | None = None) -> tuple[int, str]:
    """Run the command on a terminal, and return its exit status and all of its output there."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))  # the last two are pixels
    shown = b""
    with TandemProcess(*arguments, cwd=cwd, terminal=theirs, errors=theirs) as command:
        os.close(theirs)
        while True:
            try:
                shown += os.read(ours, 65536)
            except OSError:  # the terminal's other end is closed: the command has ended
                break
        os.close(ours)
        return command.ended().status, shown.decode(errors="replace")


def refused(ended: Ended, *words: str) -> None:
    """Assert that a command has reported a mistake of its user in one line that contains `words`."""
    assert ended.status == 2, ended
    assert ended.out == ""
    assert re.fullmatch(r"tandem[^\n]*: [^\n]+\n", ended.err), ended.err
    for word in words:
        assert word in ended.err, ended.err


@contextmanager
def world(scenario: str | Path, *arguments: str | Path) -> Iterator[tuple[TandemProcess, str]]:
    """Yield a simulator process that waits for its robots, longer than any test, and its endpoint."""
    endpoint = free_endpoint()
    patient = ("--timeout", "600", *arguments)
    with TandemProcess("world", scenario, "--listen", endpoint, *patient) as command:
        command.until_prints("waiting for")
        yield command, endpoint


def until(condition: Callable[[], object], what: str | Callable[[], str], bound: float = BOUND_S) -> None:
    """Wait until `condition` holds; `what` is the message if it does not, or returns it then."""
    give_up = time.monotonic() + bound
    while not condition():
        if time.monotonic() >= give_up:
            raise AssertionError(f"not within {bound:g} s: {what if isinstance(what, str) else what()}")
        time.sleep(POLL_S)


def processes_of(mark: str | Path) -> dict[int, list[str]]:
    """Return the words of all command lines that contain the word `mark`, by process id.

    The command line of a forked process is one string, so words are split at spaces, too.
    """
    found = {}
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            try:
                words = (process / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ").split()
            except OSError:  # it has ended meanwhile
                continue
            if str(mark) in words:
                found[int(process.name)] = words
    return found


def process_of(mark: str | Path, *words: str) -> int:
    """Return the id of the one process whose command line contains `mark`, and `words` in a row."""
    wanted = " ".join(words)
    found = [pid for pid, line in processes_of(mark).items() if f" {wanted} " in f" {' '.join(line)} "]
    assert len(found) == 1, f"{wanted}: {found}"
    return found[0]


def temporary_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a new folder in `folder` for all temporary files, so that a test can check which remain."""
    found = folder / "tmp"
    found.mkdir()
    monkeypatch.setenv("TMPDIR", str(found))
    monkeypatch.setattr(tempfile, "tempdir", str(found))
    return found


def size(path: Path) -> int:
    """Return the size of a file in bytes; 0 if there is none."""
    return path.stat().st_size if path.exists() else 0


def copied(recording: Path, folder: Path, *names: str) -> Path:
    """Copy the journals of a recording, or those of these names, and return the folder, which may be new."""
    folder.mkdir(exist_ok=True)
    for path in [recording / name for name in names] or recording.glob("*.journal"):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def in_one_process(scenario: str | Path, out: Path) -> Path:
    """Run a mission in one process, and return `out`, which is then its recording."""
    ended = tandem("run", scenario, "--in-process", "-q", "--out", out)
    assert ended.status == 0, ended
    return out


def decided(folder: Path) -> dict[str, bytes]:
    """Return all files of a recording that are the same however the mission is run, by name."""
    return journals(folder) | {"ticks.csv": (folder / "ticks.csv").read_bytes()}


def journals(folder: Path) -> dict[str, bytes]:
    """Return the content of every journal in `folder`, by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.journal"))}


def _read(file: IO[bytes]) -> str:
    """Return the content of `file`, without moving the file position that the writing process shares."""
    return os.pread(file.fileno(), 1 << 24, 0).decode(errors="replace")


def _signals_caught(pid: int) -> int:
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt"))
