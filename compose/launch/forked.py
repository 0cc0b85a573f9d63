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
from itertools import count
from typing import NamedTuple

import msgspec

LENGTH_BYTES = 4
"""The size of the length that precedes each request."""
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


KILL_S = 5.0
"""Time in s that a killed process has to end; then its fork server is considered hung, and is killed."""
TAKE_S = 60.0
"""Time in s for retries while too many descriptors are in flight: the fork server may still import."""
LOOK_S = 1.0
"""The interval in s at which processes are checked while the fork server reports nothing."""
TRY_AGAIN_S = 0.01
"""The interval in s between these retries."""
ENDED_BYTES = 8
"""The size of a report that a process has ended."""


class Ended(NamedTuple):
    """The report to the launcher that a process has ended."""

    number: int
    status: int
    """Exit status; negative is the signal that killed it."""

    def frame(self) -> bytes:
        """Return the report as ENDED_BYTES bytes."""
        return self.number.to_bytes(4, "big") + self.status.to_bytes(4, "big", signed=True)

    @classmethod
    def read(cls, frame: bytes) -> Ended:
        """Return the report that `frame` encodes."""
        return cls(int.from_bytes(frame[:4], "big"), int.from_bytes(frame[4:], "big", signed=True))


class Process:
    """A forked process. It ends when its standard input is closed, which its launcher holds open."""

    def __init__(
        self, server: ForkServer, number: int, stdin: int, stdout: int | None, on_end: Callable[[], None]
    ) -> None:
        self._stdin = stdin
        self.stdout = stdout
        """Descriptor from which its standard output is read; None if it is discarded."""
        self._streams = [stream for stream in (stdin, stdout) if stream is not None]
        """Descriptors of the launcher, closed once the process has ended."""
        self._server = server
        self._number = number
        self._on_end = on_end
        self._over = threading.Event()
        self._status = 0

    @property
    def running(self) -> bool:
        """True if the process has not ended yet."""
        return not self._over.is_set()

    @property
    def status(self) -> int:
        """Wait for the process to end, and return its exit status; negative is the signal that killed it."""
        self._over.wait()
        return self._status

    @property
    def hung_up(self) -> bool:
        """True if it has closed its standard input, as it does by ending."""
        poll = select.poll()
        poll.register(self._stdin, 0)
        return not self.running or bool(poll.poll(0))

    def wait(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds, and return whether the process has ended."""
        return self._over.wait(max(timeout, 0.0))

    def signal(self, number: int) -> None:
        """Send a signal to the process and its group, unless it has ended."""
        if self.running:
            self._server.signal(self._number, number)

    def end(self, timeout: float = 0.0) -> int:
        """Wait `timeout` seconds, then kill the process; return its exit status."""
        if not self.wait(timeout):
            self.signal(signal.SIGKILL)
            if not self.wait(KILL_S):
                self._server.kill()
        status = self.status
        self.hang_up()
        return status

    def hang_up(self) -> None:
        """Close the launcher's ends of the process's streams."""
        streams, self._streams = self._streams, []
        for stream in streams:
            os.close(stream)

    def send(self, data: bytes) -> None:
        """Write `data` to the standard input of the process, unless it has ended."""
        rest = memoryview(data)
        with suppress(BrokenPipeError):
            while rest:
                rest = rest[os.write(self._stdin, rest) :]

    def ended(self, status: int) -> None:
        """Store the exit status; called by the server when the process has ended."""
        self._status = status
        self._over.set()
        self._on_end()


class ForkServer:
    """A fork server whose launcher is this process."""

    def __init__(self, warm_up: str) -> None:
        """Start the server; it first calls `warm_up`, a module:function."""
        self._socket, its = socket.socketpair()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the server
        # -P: the working directory may contain a folder named world or agent
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "compose.launch.fork_server", warm_up],
            stdin=its.fileno(),
            stdout=subprocess.DEVNULL,
            stderr=self._errors.fileno(),
            start_new_session=True,
        )
        its.close()
        self.pid = self._process.pid
        self._numbers = count()
        self._running: dict[int, Process] = {}
        self._lock = threading.Lock()
        self.gone = False
        """True once the server, and with it all its processes, has ended."""
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def start(
        self,
        main: str,
        title: str,
        *arguments: str,
        errors: int,
        answers: bool = False,
        on_end: Callable[[], None] = lambda: None,
    ) -> Process:
        """Fork a process that calls `main`, a module:function, with `arguments` in sys.argv.

        Its standard error goes to the descriptor `errors`. Its standard output goes to a pipe if `answers`
        is set, otherwise to /dev/null. `on_end` is called in another thread when the process has ended.
        """
        its_input, our_input = os.pipe()
        our_output, its_output = os.pipe() if answers else (None, os.open(os.devnull, os.O_WRONLY))
        with self._lock:
            number = next(self._numbers)
            process = self._running[number] = Process(self, number, our_input, our_output, on_end)
            self._ask(ForkRequest(number, main, title, arguments), [its_input, its_output, errors])
        os.close(its_input)
        os.close(its_output)
        if self.gone:
            self._end_all()
        return process

    def signal(self, process: int, number: int) -> None:
        """Send signal `number` to the process numbered `process`, unless it has ended."""
        with self._lock:
            self._ask(Signal(process, number), [])

    def why_gone(self) -> str:
        """Wait for the server to end, and return how it did, in a line."""
        status = self._process.wait()
        self._errors.seek(0)
        errors = self._errors.read().decode(errors="replace").strip().splitlines()
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return f"the fork server {how}{f': {errors[-1]}' if errors else ''}"

    def kill(self) -> None:
        """Kill the server and all its processes."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """Kill the server and its processes, and free its thread, socket and file in the launcher."""
        self.kill()
        self._listener.join()
        self._socket.close()
        self._errors.close()

    def _ask(self, request: ForkRequest | Signal, streams: list[int]) -> None:
        body = msgspec.msgpack.encode(request)
        frame = len(body).to_bytes(LENGTH_BYTES, "big") + body
        try:
            sent = self._send_streams(frame, streams) if streams else 0
            self._socket.sendall(frame[sent:])
        except OSError:  # a request must not be lost unnoticed: `_listen` sees that the server has ended
            self._process.kill()

    def _send_streams(self, frame: bytes, streams: list[int]) -> int:
        """Send `streams` with the beginning of `frame`, and return how many bytes of it were sent.

        The kernel limits the descriptors in flight of all processes of a user to the number that one process
        may have open (ETOOMANYREFS). Sending is therefore retried for TAKE_S, until the server has received
        those of earlier requests. Raises OSError.
        """
        give_up = time.monotonic() + TAKE_S
        while True:
            try:
                return socket.send_fds(self._socket, [frame], streams)
            except OSError as error:
                if error.errno != errno.ETOOMANYREFS or time.monotonic() >= give_up:
                    raise
            time.sleep(TRY_AGAIN_S)

    def _listen(self) -> None:
        news = b""
        with suppress(OSError):
            while received := self._received():
                news += received
                while len(news) >= ENDED_BYTES:
                    one, news = Ended.read(news[:ENDED_BYTES]), news[ENDED_BYTES:]
                    self._running.pop(one.number).ended(one.status)
        self.gone = True
        self._end_all()

    def _received(self) -> bytes:
        """Return the next bytes from the server; none once it has ended.

        A suspended server would not report ended processes. It is continued, then killed.
        """
        overdue: float | None = None
        news = select.poll()
        news.register(self._socket, select.POLLIN)
        while not news.poll(1e3 * LOOK_S):
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
            process.ended(-signal.SIGKILL)


_servers: dict[str, ForkServer] = {}
_lock = threading.Lock()


def fork_server(warm_up: str) -> ForkServer:
    """Return this process's fork server that has called `warm_up`; start it if none runs."""
    with _lock:
        server = _servers.get(warm_up)
        if server is None or server.gone:
            server = _servers[warm_up] = ForkServer(warm_up)
        return server


def close() -> None:
    """Kill the fork servers of this process, and their processes."""
    with _lock:
        while _servers:
            _servers.popitem()[1].close()
