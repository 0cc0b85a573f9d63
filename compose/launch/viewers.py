"""Viewers of a mission: processes that read the growing journals, and their launcher's side.

A viewer writes its address to standard output when it is ready. It ends on SIGTERM, and with its launcher.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from compose.errors import UserError
from compose.launch.child import ChildProcess
from compose.launch.supervisor import COMMAND, Supervisor
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say

OVER = b"."
"""The message to a viewer that the mission has ended."""
READY_S = 30.0
"""Time in s that a viewer has to be ready."""


def warm_up() -> None:
    """Prepare a fork server for viewers, which share few modules. Importing this module does all of it."""


class ViewerCommand(NamedTuple):
    """The command line of a viewer."""

    what: str
    """Name of the viewer in messages."""
    main: str
    """Function that it calls, as module:function."""
    arguments: tuple[str, ...]


class Viewer:
    """A running viewer process."""

    def __init__(self, what: str, child: ChildProcess, address: str) -> None:
        """`what` is the name of the viewer in messages."""
        self.address = address
        self._what = what
        self._child = child

    @property
    def running(self) -> bool:
        """True if it has not ended yet."""
        return self._child.running

    def announce(self) -> None:
        """Print the address."""
        say(f"{self._what} at {self.address}")

    @property
    def failure(self) -> str | None:
        """A line about its failure; None if it is running, or has ended as it should."""
        if self.running or self._child.status == 0:
            return None
        return f"{self._what} {self._child.how_ended().splitlines()[-1]}"

    def conclude(self) -> None:
        """Tell the viewer that the mission has ended, and print that it keeps running."""
        self._child.send(OVER)
        say(f"{self._what} remains at {self.address} until Ctrl-C")


def stay(viewers: Sequence[Viewer], inbox: Inbox) -> bool:
    """Wait, after the mission, for Ctrl-C or for the end of all `viewers`, which `inbox` receives.

    Return whether none has failed; a failure is printed. Processes of the mission that end later are ignored.
    """
    for viewer in viewers:
        viewer.conclude()
    failed: set[Viewer] = set()
    with suppress(Interrupted):
        while True:
            for viewer in viewers:
                if viewer not in failed and (failure := viewer.failure) is not None:
                    failed.add(viewer)
                    inbox.say(failure)
            if not any(viewer.running for viewer in viewers):
                break
            inbox.next(None)
    return not failed


@contextmanager
def viewing(wanted: Sequence[ViewerCommand], inbox: Inbox) -> Iterator[list[Viewer]]:
    """Run the `wanted` viewers in this context; `inbox` receives their ends.

    Raises UserError, with the last line of its standard error, if one is not ready within READY_S.
    """
    children = Supervisor(inbox, "compose.launch.viewers:warm_up")
    try:
        yield [_started(children, command) for command in wanted]
    finally:
        children.stop()


def _started(children: Supervisor, command: ViewerCommand) -> Viewer:
    """Return a viewer that has become ready. Raises UserError."""
    child = children.start(command.what, *command.arguments, main=command.main, answers=True)
    address = _address(child)
    if address is None:
        child.end()
        errors = child.stderr_text().splitlines()
        late = f"{command.what}: not ready within {READY_S:g} s"
        raise UserError(errors[-1].removeprefix("tandem watch: ") if errors else late)
    return Viewer(command.what, child, address)


def page(folder: Path, port: int) -> ViewerCommand:
    """Return the viewer that serves the page of the recording in `folder`."""
    return ViewerCommand("the page", COMMAND, ("watch", str(folder), "--launched", "--port", str(port)))


def foxglove_server(folder: Path, port: int, origins: Sequence[str], robots: Sequence[str]) -> ViewerCommand:
    """Return the viewer that serves a run to Foxglove, and to web pages of `origins`."""
    arguments = (str(port), ",".join(origins), str(folder), *robots)
    return ViewerCommand("the Foxglove server", "compose.view.foxglove.live_server:main", arguments)


def _address(child: ChildProcess) -> str | None:
    """Return the address that the viewer writes when it is ready; None if it is not ready within READY_S."""
    line, give_up = b"", time.monotonic() + READY_S
    with suppress(TimeoutError):
        while not line.endswith(b"\n") and (news := child.receive(give_up - time.monotonic())):
            line += news
    if not line.endswith(b"\n"):
        return None
    return line.decode().strip() or None
