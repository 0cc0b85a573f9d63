"""The process that serves the page of a mission from its growing journals, and its launcher's side.

It sends its address when it is ready. It ends on SIGTERM, and with its launcher.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from compose.errors import UserError
from compose.launch.forked import ChildProcess
from compose.launch.supervisor import Supervisor
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say

WHAT = "the page"
"""The name of the process in messages."""
OVER = b""
"""The message to it that the mission has ended."""
READY_S = 30.0
"""Time in s that it has to be ready."""


class PageProcess(NamedTuple):
    """A running page."""

    child: ChildProcess
    address: str

    def stay(self, inbox: Inbox) -> bool:
        """Wait, after the mission, for Ctrl-C or for the end of the page, which `inbox` receives.

        Return whether it has not failed; a failure is printed. Processes of the mission that end later are
        ignored.
        """
        self.child.send(OVER)
        say(f"{WHAT} remains at {self.address} until Ctrl-C")
        with suppress(Interrupted):
            while self.child.running:
                inbox.next(None)
        if self.child.running or self.child.status == 0:
            return True
        inbox.say(f"{WHAT} {self.child.how_ended.splitlines()[-1]}")
        return False


@contextmanager
def serving(folder: Path, port: int, inbox: Inbox, *, lockstep: bool) -> Iterator[PageProcess]:
    """Serve the page of the recording in `folder` in this context, and print its address.

    `lockstep` is true if the mission is in lockstep, and `inbox` receives the end of the page's process.
    Raises UserError, with the last line of its standard error, if it is not ready within READY_S.
    """
    children = Supervisor(inbox, __name__)  # its modules are few
    try:
        pace = ["--lockstep"] if lockstep else []
        child = children.start(WHAT, "watch", str(folder), "--launched", *pace, "--port", str(port))
        try:
            page = PageProcess(child, child.receive(READY_S).decode())
        except (TimeoutError, EOFError):
            child.end()
            errors = child.stderr_text.splitlines() or [f"{WHAT}: not ready within {READY_S:g} s"]
            raise UserError(errors[-1].removeprefix("tandem watch: ")) from None
        say(f"{WHAT} at {page.address}")
        yield page
    finally:
        children.stop()
