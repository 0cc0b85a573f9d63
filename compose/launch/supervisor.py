"""The supervisor of child processes: it starts and restarts them, reports their ends, and ends them."""

from __future__ import annotations

import time
from collections.abc import Callable

from compose.errors import ENDED
from compose.launch import forked
from compose.launch.forked import ChildProcess, ForkServer
from protocol.network.inbox import Inbox
from protocol.output import say

STOP_S = 3.0
"""Time in s that a process has to end after SIGTERM; then it is killed."""
COMMAND = "compose.cli.main:main"
"""The function that runs a `tandem` command."""
PREPARE_MISSIONS = "compose.cli.warm_up:missions"
"""The function that prepares a fork server for worlds and agents."""


class ChildFailed(RuntimeError):
    """A process ended before the run did; the text says which one, and how."""


def fork_server() -> ForkServer:
    """Return the fork server of this process's worlds and agents."""
    return forked.fork_server(PREPARE_MISSIONS)


class Supervisor:
    """Child processes, by name. No process is left running after `stop`.

    A signal such as Ctrl-C reaches only this process, and its children by `stop`.
    """

    def __init__(self, inbox: Inbox, warm_up: str = PREPARE_MISSIONS) -> None:
        """Put "ended", with the name of the child, into `inbox` whenever a child ends.

        `warm_up` is the module or function that prepares the fork server of the children.
        """
        self._inbox = inbox
        self._warm_up = warm_up
        self._children: dict[str, ChildProcess] = {}
        self._due: list[tuple[float, Callable[[], object]]] = []
        """Monotonic times in s of later starts, and the functions that start."""

    def __getitem__(self, name: str) -> ChildProcess:
        return self._children[name]

    def start(self, name: str, *arguments: str, main: str = COMMAND) -> ChildProcess:
        """Start the child `name` with `arguments` in sys.argv; end an earlier child of that name.

        It calls `main`, a module:function.
        """
        if name in self._children:
            self._children[name].end()
        child = forked.fork_server(self._warm_up).start(
            main, "tandem", *arguments, on_end=lambda: self._inbox.put("ended", name)
        )
        self._children[name] = child
        return child

    def start_later(self, delay_s: float, start: Callable[[], object]) -> None:
        """Call `start` in `delay_s` seconds, during `next_end`."""
        self._due.append((time.monotonic() + delay_s, start))

    def cancel_starts(self) -> None:
        """Forget the starts that are not due yet."""
        self._due.clear()

    def next_end(self, timeout: float | None) -> str | None:
        """Return the name of the next child that ends; None if none does for `timeout` s, and none is due.

        Raises Interrupted if the inbox receives a signal.
        """
        while True:
            now = time.monotonic()
            due = [start for when, start in self._due if when <= now]
            self._due = [one for one in self._due if one[0] > now]
            for start in due:
                start()
            arrival = self._inbox.next(min([when - now for when, _ in self._due], default=timeout))
            if arrival.topic == "ended" and arrival.key in self._children:
                return arrival.key
            if arrival.topic == "nothing" and not self._due:
                return None

    def failure(self, name: str) -> ChildFailed:
        """Return the error that the child `name` has ended, and how."""
        return ChildFailed(f"{name} {self[name].how_ended}")

    def wait(self, timeout: float) -> None:
        """Wait at most `timeout` seconds until all children have ended."""
        give_up = time.monotonic() + timeout
        for child in self._children.values():
            child.wait(give_up - time.monotonic())

    def stop(self) -> None:
        """Terminate all children, and kill those that have not ended STOP_S later."""
        for child in self._children.values():
            child.terminate()
        self.wait(STOP_S)
        for child in self._children.values():
            child.end()

    def say_errors(self) -> None:
        """Print what the children that ended well wrote to standard error."""
        for child in self._children.values():
            if child.status == ENDED and (errors := child.stderr_text):
                say(*errors.splitlines(), error=True)
