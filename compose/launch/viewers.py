"""Viewers of a mission: processes that read the growing journals, and their launcher's side.

A viewer writes its address to standard output when it is ready. It ends when its standard input is closed.
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
"""The message to a viewer that the mission has ended."""
READY_S = 30.0
"""Time in s that a viewer has to be ready."""


class Beside:
    """A running viewer process."""

    def __init__(self, what: str, process: subprocess.Popen[bytes], address: str) -> None:
        """`what` is the name of the viewer in messages."""
        self.address = address
        self._what = what
        self._process = process

    def announce(self) -> None:
        """Print the address."""
        say(f"{self._what} at {self.address}")

    def conclude(self) -> None:
        """Tell the viewer that the mission has ended, and print that it keeps running."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(OVER)
            self._process.stdin.flush()
        say(f"{self._what} remains at {self.address} until Ctrl-C")

    def put_end(self, inbox: Inbox) -> None:
        """Put "ended" with the address into `inbox` once the process has ended."""

        def wait() -> None:
            self._process.wait()
            inbox.put("ended", self.address)

        threading.Thread(target=wait, daemon=True).start()


def stay(shows: Sequence[Beside], inbox: Inbox) -> None:
    """Wait, after the mission, for Ctrl-C or for the end of all viewers in `shows`.

    Processes of the mission that end later are ignored.
    """
    for show in shows:
        show.conclude()
        show.put_end(inbox)
    running = {show.address for show in shows}
    with suppress(Interrupted):
        while running:
            arrival = inbox.next(None)
            if arrival.topic == "ended":
                running.discard(arrival.key)


@contextmanager
def beside(what: str, module: str, *arguments: str) -> Iterator[Beside]:
    """Run the viewer `python -m module arguments` in this context.

    Raises UserError, with the last line of its standard error, if it is not ready within READY_S.
    """
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
                output = errors.read().decode(errors="replace").strip().splitlines()
                raise UserError(
                    output[-1].removeprefix("tandem watch: ")
                    if output
                    else f"{what}: not ready within {READY_S:g} s"
                )
            yield Beside(what, process, address)
        finally:
            _end(process)


def page(folder: Path, port: int) -> tuple[str, ...]:
    """Return the arguments of `beside` for the page of the recording in `folder`."""
    return ("the page", "compose.cli", "watch", str(folder), "--launched", "--port", str(port))


def viewers(folder: Path, port: int, origins: Sequence[str], robots: Sequence[str]) -> tuple[str, ...]:
    """Return the arguments of `beside` to serve a run to Foxglove, and to web pages of `origins`."""
    words = (str(port), ",".join(origins), str(folder), *robots)
    return ("the Foxglove server", "compose.view.foxglove.live_server", *words)


def _address(process: subprocess.Popen[bytes]) -> str | None:
    """Return the address that the viewer writes when it is ready; None if it is not ready within READY_S."""
    lines: list[bytes] = []
    out = process.stdout
    assert out is not None
    reader = threading.Thread(target=lambda: lines.append(out.readline()), daemon=True)
    reader.start()
    reader.join(READY_S)
    return lines[0].decode().strip() or None if lines else None


def _end(process: subprocess.Popen[bytes]) -> None:
    """Close the streams of the viewer, which ends it; kill it if it has not ended after STOP_S."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
