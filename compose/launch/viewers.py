"""What shows a mission beside it: a process that reads the growing journals, and its launcher's part.

It says on standard output where it is to be found, once it is; and it ends with its standard input.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from compose.errors import UserError
from compose.launch.processes import STOP_S
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say

OVER = b"."
"""what it is told when the mission is over"""
READY_S = 30.0
"""how long it may take until it is there"""


class Beside:
    """A process that shows a mission."""

    def __init__(self, what: str, process: subprocess.Popen[bytes], address: str) -> None:
        self.address = address
        self._what = what
        self._process = process

    def announce(self) -> None:
        """Say where it is."""
        say(f"{self._what} at {self.address}")

    def conclude(self) -> None:
        """The mission is over; it stays."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(OVER)
            self._process.stdin.flush()
        say(f"{self._what} stays at {self.address} until Ctrl-C")

    def put_end(self, inbox: Inbox) -> None:
        """Put "ended" with its address into `inbox` once the process is gone."""

        def wait() -> None:
            self._process.wait()
            inbox.put("ended", self.address)

        threading.Thread(target=wait, daemon=True).start()


def stay(shows: Sequence[Beside], inbox: Inbox) -> None:
    """The mission is over: wait for Ctrl-C, or for the end of all of `shows`.

    A process of the mission may end after it, and is none of them.
    """
    for show in shows:
        show.conclude()
        show.put_end(inbox)
    left = {show.address for show in shows}
    with suppress(Interrupted):
        while left:
            arrival = inbox.next(None)
            if arrival.topic == "ended":
                left.discard(arrival.key)


@contextmanager
def beside(what: str, module: str, *arguments: str) -> Iterator[Beside]:
    """`python -m module arguments`, for as long as it takes. Raises UserError, by its own words."""
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            start_new_session=True,
        )
        try:
            address = _address(process)
            if address is None:
                process.kill()
                process.wait()
                errors.seek(0)
                said = errors.read().decode(errors="replace").strip().splitlines()
                raise UserError(
                    said[-1].removeprefix("tandem watch: ")
                    if said
                    else f"{what}: not there within {READY_S:g} s"
                )
            yield Beside(what, process, address)
        finally:
            _end(process)


def page(folder: Path, port: int) -> tuple[str, ...]:
    """What `beside` is to be told for the page on the record that is about to be written into `folder`."""
    return ("the page", "compose.cli", "watch", str(folder), "--launched", "--port", str(port))


def viewers(folder: Path, port: int, origins: Sequence[str], robots: Sequence[str]) -> tuple[str, ...]:
    """Return what `beside` is told to serve a run of `robots` to Foxglove, and to web pages of `origins`."""
    words = (str(port), ",".join(origins), str(folder), *robots)
    return ("what Foxglove's viewers show", "compose.view.foxglove.live_server", *words)


def _address(process: subprocess.Popen[bytes]) -> str | None:
    """What it says once it is there; none if it does not within READY_S."""
    said: list[bytes] = []
    out = process.stdout
    assert out is not None
    reader = threading.Thread(target=lambda: said.append(out.readline()), daemon=True)
    reader.start()
    reader.join(READY_S)
    return said[0].decode().strip() or None if said else None


def _end(process: subprocess.Popen[bytes]) -> None:
    """It ends with its standard input; else it is killed."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
