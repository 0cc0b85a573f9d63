"""Work that a request starts. Each runs in a process of its own, which is killed at its deadline.

So a request can neither delay the end of the server nor take its memory, and no request outlasts the server.
"""

from __future__ import annotations

import os
import resource
import threading
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import msgspec

from compose.errors import UserError
from compose.launch import class_loader, model_loader
from compose.launch.forked import KILL_S, ChildProcess, fork_server, launcher
from protocol.output import one_line
from world.world_models import OWN_MODELS

MOST_MEMORY_BYTES = 4 << 30
"""The largest size in bytes of the data of a process."""
MOST_FILE_BYTES = 1 << 30
"""The largest size in bytes of a file that it writes."""
FUNCTIONS = ("compose.view.web.reruns", "compose.view.web.site", "compose.view.web.costs")
"""The modules of the functions that are called."""
MISSION_MODULES = ("compose.launch.in_process", "compose.scenario.scenario_file")
"""The modules that run a mission. They import numpy, which the server itself does not need."""


class RequestedWork:
    """The processes of one server in which requests are computed, forked from one that is started once."""

    def __init__(self) -> None:
        self.over = False
        """True once the server is stopping."""
        self._children: set[ChildProcess] = set()
        self._lock = threading.Lock()

    def result(self, function: Callable[..., Any], *arguments: Any, within: float, late: str) -> Any:
        """Return what `function` returns in a process of its own, after at most `within` s.

        Arguments and result are values of msgpack. Raises UserError if the function raises one, with the text
        `late` after the deadline, or if the server has been stopped.
        """
        trusted = [*class_loader.trusted()], [*OWN_MODELS]
        request = msgspec.msgpack.encode((function.__module__, function.__name__, arguments, *trusted))
        with self._lock:
            self._check()
            child = fork_server(f"{__name__}:warm_up").start(
                f"{__name__}:main", f"tandem watch: requested work of {os.getpid()}"
            )
            self._children.add(child)
        try:
            child.send(request)
            result, error = msgspec.msgpack.decode(child.receive(within))
        except TimeoutError:
            self._check()
            raise UserError(late) from None
        except EOFError:
            child.end(KILL_S)
            self._check()
            raise UserError(f"it cannot be computed: its process {child.how_ended}") from None
        finally:
            child.end()
            self._children.discard(child)
        if error is not None:
            raise UserError(error)
        return result

    def stop(self) -> None:
        """Kill all processes; requests that wait for them, and later ones, end with a UserError."""
        with self._lock:
            self.over = True
            for child in tuple(self._children):
                child.kill()

    def _check(self) -> None:
        if self.over:
            raise UserError("the server has been stopped")


def warm_up() -> None:
    """Prepare a fork server for this work: import its functions, and what a mission needs by running one."""
    for module in FUNCTIONS:
        import_module(module)
    in_process, scenario_file = map(import_module, MISSION_MODULES)
    in_process.run_mission(scenario_file.load("paper-1"))


def main() -> None:
    """Call the function of the request that the launcher sends, and send its result."""
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (MOST_FILE_BYTES, MOST_FILE_BYTES))
    launcher().send_bytes(msgspec.msgpack.encode(_answer(*msgspec.msgpack.decode(launcher().recv_bytes()))))


def _answer(
    module: str, name: str, arguments: Sequence[Any], trusted: Sequence[str], models: Sequence[str]
) -> tuple[Any, str | None]:
    """Return what a function returns, and the reason why it does not; the latter is None if it does.

    The server chooses the function, never a request from a browser. The user of the server has named the
    classes that are `trusted`, of which `models` are range and radio models.
    """
    for one in trusted:
        class_loader.trust(one)
    try:
        for one in models:
            model_loader.trust(one)
        return getattr(import_module(module), name)(*arguments), None
    except UserError as error:
        return None, str(error)
    except MemoryError:
        return None, f"it takes more than {MOST_MEMORY_BYTES >> 30} GB of memory"
    except Exception as error:  # noqa: BLE001  # of whatever the files of a folder contain
        return None, one_line(f"it cannot be computed: {type(error).__name__}: {error}")
