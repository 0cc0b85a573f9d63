"""The launcher's side of a fork server, and of the processes forked from it.

A fork server (`compose/launch/fork_server.py`) imports what its processes need once, so that each of them
starts in milliseconds. Each process has its own session, process group, standard streams, signals and exit
status. It inherits the environment, working directory and limits that the launcher had when it started the
server.
"""

from __future__ import annotations

import errno
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import count

import msgspec

from compose.launch.child import KILL_S, ChildProcess, ending

REQUEST_BYTES = 1 << 18
"""The largest size of a request, which is more than a socket takes by default."""
STREAMS = 3
"""The number of descriptors sent with a request for a process: its standard input, output and error."""


class ForkRequest(msgspec.Struct, frozen=True, tag=True):
    """A request to fork a process."""

    number: int
    """Number by which the launcher identifies the process."""
    main: str
    """Function that the process calls, as module:function."""
    title: str
    """Name of the process in `ps`, before the arguments."""
    arguments: tuple[str, ...]


class Signal(msgspec.Struct, frozen=True, tag=True):
    """A request to send a signal to a process and its group, if the process has not ended."""

    number: int
    signal: int


TAKE_S = 60.0
"""Time in s for retries of a request to fork: the fork server may still import."""
FORKS_CHECK_S = 1.0
"""The interval in s at which processes are checked while the fork server reports nothing."""
TRY_AGAIN_S = 0.001
"""The interval in s between these retries."""


LETHAL = (signal.SIGTERM, signal.SIGKILL)
"""The signals that end a process that has not begun yet."""


class Imported(msgspec.Struct, frozen=True, tag=True):
    """The report to the launcher that the fork server has imported its modules, and forks from now on."""


class Ended(msgspec.Struct, frozen=True, tag=True):
    """The report to the launcher that a process has ended."""

    number: int
    status: int
    """Exit status; negative is the signal that killed it."""


class ForkServer:
    """A fork server whose launcher is this process."""

    def __init__(self, warm_up: str) -> None:
        """Start the server; it first calls `warm_up`, a module:function."""
        self._socket, its = socket.socketpair(type=socket.SOCK_SEQPACKET)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the server
        # like `multiprocessing`, so that its modules are the launcher's: another folder may have a `world`
        path = [folder or os.getcwd() for folder in sys.path]
        code = f"import sys; sys.path[:] = {path!a}; from compose.launch.fork_server import main; main()"
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", code, warm_up],
            stdin=its.fileno(),
            stdout=subprocess.DEVNULL,
            stderr=self._errors.fileno(),
            start_new_session=True,
        )
        its.close()
        self.pid = self._process.pid
        self._numbers = count()
        self._running: dict[int, ChildProcess] = {}
        self._lock = threading.Lock()
        self._imports = True
        """True until the server has imported its modules. None of its processes has begun before."""
        self.gone = False
        """True once the server, and with it all its processes, has ended."""
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def start(
        self,
        main: str,
        title: str,
        *arguments: str,
        errors: int | None = None,
        answers: bool = False,
        on_end: Callable[[], None] = lambda: None,
    ) -> ChildProcess:
        """Fork a process that calls `main`, a module:function, with `arguments` in sys.argv.

        Its standard error goes to the descriptor `errors`, otherwise to a file that the result reads. Its
        standard output goes to a pipe if `answers` is set, otherwise to /dev/null. `on_end` is called in
        another thread when the process has ended.
        """
        its_input, our_input = os.pipe()
        our_output, its_output = os.pipe() if answers else (None, os.open(os.devnull, os.O_WRONLY))
        file = None
        if errors is None:
            file = tempfile.TemporaryFile()  # noqa: SIM115  # closed by the process
            errors = file.fileno()
        with self._lock:
            number = next(self._numbers)
            process = self._running[number] = ChildProcess(
                (our_input, our_output), file, partial(self.signal, number), self.kill, on_end
            )
            self._ask(ForkRequest(number, main, title, arguments), [its_input, its_output, errors])
        os.close(its_input)
        os.close(its_output)
        if self.gone:
            self._end_all()
        return process

    def signal(self, process: int, number: int) -> None:
        """Send signal `number` to the process numbered `process`, unless it has ended.

        A process that has not begun counts as ended at once by SIGTERM and SIGKILL: importing may take
        longer than a process is given to end. Once forked, it ends because its standard input is closed.
        """
        unborn = None
        with self._lock:
            if self._imports and number in LETHAL:
                unborn = self._running.pop(process, None)
            else:
                self._ask(Signal(process, number), [])
        if unborn is not None:
            unborn.ended(-number)

    def why_gone(self) -> str:
        """Return how the server ended, in a line; it is waited for, and then killed, if it has not ended."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(KILL_S)
        status = self.kill()
        self._errors.seek(0)
        errors = self._errors.read().decode(errors="replace").strip().splitlines()
        return f"the fork server {ending(status)}{f': {errors[-1]}' if errors else ''}"

    def kill(self) -> int:
        """Kill the server and all its processes, and return the server's exit status."""
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(KILL_S)
        status = self._process.poll()
        return -signal.SIGKILL if status is None else status

    def close(self) -> None:
        """Kill the server and its processes, and free its thread, socket and file in the launcher."""
        self.kill()
        self._listener.join(KILL_S)
        self._socket.close()
        self._errors.close()

    def _ask(self, request: ForkRequest | Signal, streams: list[int]) -> None:
        try:
            self._send(msgspec.msgpack.encode(request), streams)
        except OSError:  # a request must not be lost unnoticed: `_listen` sees that the server has ended
            self._process.kill()

    def _send(self, frame: bytes, streams: list[int]) -> None:
        """Send `frame` with `streams`.

        A server that is suspended, or still imports, takes few requests (EAGAIN), and the kernel limits the
        descriptors in flight of all processes of a user to the number that one process may have open
        (ETOOMANYREFS). Sending is therefore retried, for TAKE_S, and without `streams` for KILL_S.

        Raises OSError.
        """
        give_up = time.monotonic() + (TAKE_S if streams else KILL_S)
        while True:
            try:
                socket.send_fds(self._socket, [frame], streams, socket.MSG_DONTWAIT)
            except OSError as error:
                if error.errno not in (errno.EAGAIN, errno.ETOOMANYREFS) or time.monotonic() >= give_up:
                    raise
            else:
                return
            time.sleep(TRY_AGAIN_S)

    def _listen(self) -> None:
        decoder = msgspec.msgpack.Decoder(Ended | Imported)
        with suppress(OSError):
            while received := self._received():
                match decoder.decode(received):
                    case Imported():
                        self._imports = False
                    case Ended(number, status) if (process := self._running.pop(number, None)) is not None:
                        process.ended(status)
                    case Ended():  # it was ended before it began
                        pass
        self.gone = True
        self._end_all()

    def _received(self) -> bytes:
        """Return the next bytes from the server; none once it has ended.

        A suspended server would not report ended processes. It is continued, then killed.
        """
        overdue: float | None = None
        news = select.poll()
        news.register(self._socket, select.POLLIN)
        while not news.poll(1e3 * FORKS_CHECK_S):
            if not any(process.hung_up for process in tuple(self._running.values())):
                overdue = None
            elif overdue is None:
                overdue = time.monotonic()
            else:
                self._process.send_signal(signal.SIGCONT)
                if time.monotonic() > overdue + KILL_S:
                    self._process.kill()
        return self._socket.recv(4096)

    def _end_all(self) -> None:
        """Mark all processes as ended, because none outlasts the server."""
        with self._lock:
            ended, self._running = self._running, {}
        for process in ended.values():
            process.ended(-signal.SIGKILL, f"was killed: {self.why_gone()}")


_servers: dict[str, ForkServer] = {}
_lock = threading.Lock()


def fork_server(warm_up: str) -> ForkServer:
    """Return this process's fork server that has called `warm_up`; start it if none runs."""
    with _lock:
        if warm_up in _servers and _servers[warm_up].gone:
            _servers.pop(warm_up).close()
        if warm_up not in _servers:
            _servers[warm_up] = ForkServer(warm_up)
        return _servers[warm_up]


def close() -> None:
    """Kill the fork servers of this process, and their processes."""
    with _lock:
        while _servers:
            _servers.popitem()[1].close()
