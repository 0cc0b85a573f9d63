"""Processes that are forked from a fork server, and the server, as their launcher sees them.

A fork server (`compose/launch/fork_server.py`) imports what its processes need once, so that each of them
starts in milliseconds. Each process has its own session, process group, standard error, signals and exit
status. It inherits the environment, working directory and limits that the launcher had when it started the
server. Its standard input is a connection to the launcher, for messages in both directions.
"""

from __future__ import annotations

import atexit
import errno
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from itertools import count
from multiprocessing.connection import Connection
from typing import IO

import msgspec

from compose.errors import UserError

REQUEST_BYTES = 1 << 18
"""The largest size of a request, which is more than a socket takes by default."""
MOST_ARGUMENTS_BYTES = 1 << 17
"""The largest size of the arguments of a process, as of one of Linux: kills are among them."""
STREAMS = (0, 2)
"""The descriptors sent with a request for a process: its standard input and error."""
KILL_S = 5.0
"""Time in s that a killed process has to end; then its fork server is considered hung, and is killed."""
SEND_S = 60.0
"""Time in s that a process has to read what is sent to it; then it is considered hung, and is killed."""
ERROR_BYTES = 1 << 20
"""The number of bytes of standard error, counted from its end, that are kept."""
TAKE_S = 60.0
"""Time in s for retries of a request to fork: the fork server may still import."""
FORKS_CHECK_S = 1.0
"""The interval in s at which a fork server that reports nothing is continued, in case it is suspended."""
TRY_AGAIN_S = 0.001
"""The interval in s between retries of a request."""
LETHAL = (signal.SIGTERM, signal.SIGKILL)
"""The signals that end a process that has not begun yet."""


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


class Imported(msgspec.Struct, frozen=True, tag=True):
    """The report to the launcher that the fork server has imported its modules, and forks from now on."""


class Ended(msgspec.Struct, frozen=True, tag=True):
    """The report to the launcher that a process has ended."""

    number: int
    status: int
    """Exit status; negative is the signal that killed it."""


@cache
def launcher() -> Connection:
    """Return the connection of this forked process to its launcher."""
    return Connection(os.dup(0))  # a duplicate, since two threads that call this at once make two


class ChildProcess:
    """A forked process. It ends when its connection is closed, which its launcher holds open.

    It has its own session, so Ctrl-C reaches only the launcher.
    """

    def __init__(
        self,
        server: ForkServer,
        number: int,
        link: socket.socket,
        errors: IO[bytes],
        on_end: Callable[[], None],
    ) -> None:
        """`link` is the launcher's end of its connection, `errors` its standard error.

        `on_end` is called in another thread when it has ended.
        """
        self.started = time.monotonic()
        """Monotonic time of its start in s."""
        self.status: int | None = None
        """Exit status; negative is the signal that killed the process, and None that it has not ended."""
        self._server, self._number, self._on_end = server, number, on_end
        limit = struct.pack("ll", int(SEND_S), int(SEND_S % 1.0 * 1e6))
        for bounded in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            link.setsockopt(socket.SOL_SOCKET, bounded, limit)
        self._link = Connection(link.detach())
        self._errors = errors
        self.stderr_text = ""
        """The end of its standard error, at most ERROR_BYTES, once the process has ended."""
        self.how_ended = ""
        """The way in which it has ended, as part of an error message."""
        self._over = threading.Event()

    @property
    def running(self) -> bool:
        """True if the process has not ended yet."""
        return not self._over.is_set()

    def wait(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds, and return whether the process has ended."""
        return self._over.wait(max(timeout, 0.0))

    def signal(self, number: int) -> None:
        """Send a signal to the process and its group, unless it has ended."""
        if self.running:
            self._server.signal(self._number, number)

    def terminate(self) -> None:
        """Send SIGTERM, and SIGCONT in case the process is suspended."""
        self.signal(signal.SIGTERM)
        self.signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the process and its group."""
        self.signal(signal.SIGKILL)

    def end(self, timeout: float = 0.0) -> int:
        """Wait `timeout` seconds, then kill the process; free its streams, and return its exit status."""
        if not self.wait(timeout):
            self.kill()
            if not self.wait(KILL_S):
                self._server.kill()
                self.wait(KILL_S)
        self.hang_up()
        return -signal.SIGKILL if self.status is None else self.status

    def hang_up(self) -> None:
        """Close the connection, which ends the process."""
        self._link.close()

    def send(self, message: bytes) -> None:
        """Send a message to the process, unless it has ended; kill it if it does not read it for SEND_S."""
        try:
            self._link.send_bytes(message)
        except BlockingIOError:
            self.kill()
        except ConnectionError:
            pass

    def receive(self, timeout: float) -> bytes:
        """Return the next message of the process. Raises TimeoutError, and EOFError if there is none."""
        try:
            if self._link.poll(max(timeout, 0.0)):
                return self._link.recv_bytes()
        except BlockingIOError:  # the rest of a message
            pass
        except OSError:
            raise EOFError from None
        raise TimeoutError

    def ended(self, status: int, why: str = "") -> None:
        """Note that the process has ended, and why it was killed if its fork server has ended."""
        with self._errors as file:
            begin = max(0, os.fstat(file.fileno()).st_size - ERROR_BYTES)
            self.stderr_text = os.pread(file.fileno(), ERROR_BYTES, begin).decode(errors="replace").strip()
        self.status, self.how_ended = status, why or ending(status, self.stderr_text.splitlines())
        with (
            suppress(OSError),
            socket.fromfd(self._link.fileno(), socket.AF_UNIX, socket.SOCK_STREAM) as link,
        ):
            link.shutdown(socket.SHUT_RDWR)  # if it has not begun, the fork server still has the other end
        self._over.set()
        self._on_end()


def ending(status: int, errors: Sequence[str]) -> str:
    """Return how a process ended; a negative `status` is the signal that killed it."""
    how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
    return f"{how}: {'; '.join(errors)}" if errors else how


class ForkServer:
    """A fork server whose launcher is this process."""

    def __init__(self, warm_up: str) -> None:
        """Start the server; it first imports `warm_up`, a module, or calls it, a module:function."""
        self._socket, its = socket.socketpair(type=socket.SOCK_SEQPACKET)
        self._socket.settimeout(FORKS_CHECK_S)
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
        self, main: str, title: str, *arguments: str, on_end: Callable[[], None] = lambda: None
    ) -> ChildProcess:
        """Fork a process that calls `main`, a module:function, with `arguments` in sys.argv.

        Its standard error goes to a file that the result reads, its standard output to /dev/null. `on_end` is
        called in another thread when the process has ended. Raises UserError if `arguments` are too long.
        """
        if (size := sum([len(one.encode()) for one in arguments])) > MOST_ARGUMENTS_BYTES:
            who = " ".join(arguments[:2])
            raise UserError(
                f"{who}: its arguments have {size} bytes; at most {MOST_ARGUMENTS_BYTES} are passed"
            )
        ours, its = socket.socketpair()
        errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed by the process
        with its, self._lock:
            number = next(self._numbers)
            process = self._running[number] = ChildProcess(self, number, ours, errors, on_end)
            self._ask(ForkRequest(number, main, title, arguments), [its.fileno(), errors.fileno()])
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
        return f"the fork server {ending(status, errors[-1:])}"

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
        """Send a request with `streams`, or kill the server: a request must not be lost unnoticed.

        A server that is suspended, or still imports, takes few requests, and the kernel limits the
        descriptors in flight of all processes of a user to the number that one process may have open
        (ETOOMANYREFS). Sending is therefore retried, for TAKE_S, and without `streams` for KILL_S.
        """
        frame = msgspec.msgpack.encode(request)
        give_up = time.monotonic() + (TAKE_S if streams else KILL_S)
        while True:
            try:
                socket.send_fds(self._socket, [frame], streams)
            except OSError as error:
                again = isinstance(error, TimeoutError) or error.errno == errno.ETOOMANYREFS
                if not again or time.monotonic() >= give_up:
                    self._process.kill()
                    return
            else:
                return
            time.sleep(TRY_AGAIN_S)

    def _listen(self) -> None:
        """Note the ends of processes until the server has ended. A suspended server would not report them."""
        decoder = msgspec.msgpack.Decoder(Ended | Imported)
        while True:
            try:
                received = self._socket.recv(4096)
            except TimeoutError:
                self._process.send_signal(signal.SIGCONT)
                continue
            except OSError:
                break
            if not received:
                break
            match decoder.decode(received):
                case Imported():
                    self._imports = False
                case Ended(number, status) if (process := self._running.pop(number, None)) is not None:
                    process.ended(status)
                case Ended():  # it was ended before it began
                    pass
        self.gone = True
        self._end_all()

    def _end_all(self) -> None:
        """Mark all processes as ended, because none outlasts the server."""
        with self._lock:
            ended, self._running = self._running, {}
        for process in ended.values():
            process.ended(-signal.SIGKILL, f"was killed: {self.why_gone()}")


_servers: dict[str, ForkServer] = {}
_lock = threading.Lock()


def fork_server(warm_up: str) -> ForkServer:
    """Return this process's fork server that has begun with `warm_up`; start it if none runs."""
    with _lock:
        if warm_up in _servers and _servers[warm_up].gone:
            _servers.pop(warm_up).close()
        if warm_up not in _servers:
            atexit.register(close)  # else they end some time after this process
            _servers[warm_up] = ForkServer(warm_up)
        return _servers[warm_up]


def close() -> None:
    """Kill the fork servers of this process, and their processes."""
    with _lock:
        while _servers:
            _servers.popitem()[1].close()
