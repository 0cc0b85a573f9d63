"""Work that a request starts. Each runs in a process of its own, which is killed at its deadline.

So a request can neither delay the end of the server nor take its memory, and no request outlasts the server.
"""

from __future__ import annotations

import os
import resource
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any

import msgspec

from compose.errors import UserError
from compose.launch import class_loader, model_loader
from compose.launch.child import END_CHECK_S, ChildProcess
from compose.launch.forked import ForkServer
from protocol.output import one_line
from world.world_models import OWN_MODELS

REQUEST_LENGTH_BYTES = 4
"""The number of bytes of the length before a request."""
MOST_MEMORY_BYTES = 4 << 30
"""The largest size in bytes of the data of a process."""
MOST_FILE_BYTES = 1 << 30
"""The largest size in bytes of a file that it writes."""
FUNCTIONS = ("compose.view.web.changed_missions", "compose.view.web.trials", "compose.view.web.site")
"""The modules of the functions that are called."""
MISSION_MODULES = ("compose.launch.in_process", "compose.scenario.scenario_file")
"""The modules that run a mission. They import numpy, which the server itself does not need."""


class _Request(msgspec.Struct, frozen=True):
    """A call of a function in another process."""

    function: str
    """The function, as module:function. The server chooses it, never a request from a browser."""
    arguments: tuple[Any, ...]
    trusted: frozenset[str]
    """The classes that the user of the server has named."""
    models: tuple[str, ...]
    """The names among them of range and radio models."""


class _Answer(msgspec.Struct, frozen=True):
    """The result of such a call."""

    result: Any = None
    error: str | None = None
    """The reason why there is no result; None if there is one."""


class RequestedWork:
    """The processes of one server in which requests are computed, forked from one that is started once."""

    def __init__(self) -> None:
        self.over = False
        """True once the server is stopping."""
        self._server: ForkServer | None = None
        self._lock = threading.Lock()

    def result(self, function: Callable[..., Any], *arguments: Any, within: float, late: str) -> Any:
        """Return what `function` returns in a process of its own, after at most `within` s.

        Arguments and result are values of msgpack. Raises UserError if the function raises one, with the text
        `late` after the deadline, or if the server has been stopped.
        """
        request = _Request(
            f"{function.__module__}:{function.__name__}", arguments, class_loader.trusted(), tuple(OWN_MODELS)
        )
        body = msgspec.msgpack.encode(request)
        child = self._forked()
        try:
            child.send(len(body).to_bytes(REQUEST_LENGTH_BYTES, "big") + body)
            answer = self._received(child, within, late)
        finally:
            child.end()
        if not answer:
            raise UserError(f"it cannot be computed: its process {child.how_ended()}")
        found = msgspec.msgpack.decode(answer, type=_Answer)
        if found.error is not None:
            raise UserError(found.error)
        return found.result

    def stop(self) -> None:
        """Kill all processes; requests that wait for them, and later ones, end with a UserError."""
        self.over = True
        with self._lock:
            if self._server is not None:
                self._server.kill()

    def close(self) -> None:
        """Free what is left of the processes, once no request waits any more."""
        self.stop()
        if self._server is not None:
            self._server.close()

    def _forked(self) -> ChildProcess:
        with self._lock:
            self._check()
            if self._server is not None and self._server.gone:
                self._server.close()
                self._server = None
            if self._server is None:
                self._server = ForkServer(f"{__name__}:warm_up")
            return self._server.start(
                f"{__name__}:main", f"tandem watch: requested work of {os.getpid()}", answers=True
            )

    def _received(self, child: ChildProcess, within: float, late: str) -> bytes:
        """Return all that `child` writes. `stop` ends it by killing it."""
        give_up, answer = time.monotonic() + within, b""
        while (left := give_up - time.monotonic()) > 0.0:
            with suppress(TimeoutError):
                if not (part := child.receive(left)):
                    child.wait(END_CHECK_S)
                    self._check()
                    return answer
                answer += part
        self._check()
        raise UserError(late)

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
    """Call the function of the request on standard input, and write its result to standard output."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever else is printed must not mix with the answer
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (MOST_FILE_BYTES, MOST_FILE_BYTES))
    size = int.from_bytes(sys.stdin.buffer.read(REQUEST_LENGTH_BYTES), "big")
    request = msgspec.msgpack.decode(sys.stdin.buffer.read(size), type=_Request)
    answers.write(msgspec.msgpack.encode(_answer(request)))
    answers.close()


def _answer(request: _Request) -> _Answer:
    for name in request.trusted:
        class_loader.trust(name)
    module, _, name = request.function.partition(":")
    try:
        for model in request.models:
            model_loader.trust(model)
        return _Answer(getattr(import_module(module), name)(*request.arguments))
    except UserError as error:
        return _Answer(error=str(error))
    except MemoryError:
        return _Answer(error=f"it takes more than {MOST_MEMORY_BYTES >> 30} GB of memory")
    except Exception as error:  # noqa: BLE001  # of whatever the files of a folder contain
        return _Answer(error=one_line(f"it cannot be computed: {type(error).__name__}: {error}"))
