"""Processes forked from a fork server, as their launcher sees them.

A fork server (`compose/fork_server.py`) imports what its processes need once, so that each of them starts in
milliseconds. Each is a process of its own in every other respect: it has its own session and process group,
standard streams, signals and exit status. It is as the launcher was when the server began: the same
environment, working directory and limits.
"""

from __future__ import annotations

import errno
import os
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
"""in front of each request"""
STREAMS = 3
"""descriptors that come with a request for a process: its standard input, output and error"""


class Start(msgspec.Struct, frozen=True, tag=True):
    """A request for a process."""

    number: int
    """by which the launcher knows it"""
    main: str
    """module:function that it calls"""
    title: str
    """its name in `ps`, before the arguments"""
    arguments: tuple[str, ...]


class Signal(msgspec.Struct, frozen=True, tag=True):
    """A request to send a signal to a process and its group, if the process has not ended."""

    number: int
    signal: int


KILL_S = 5.0
"""how long a process that is killed may take to end; then its fork server does not answer, and is killed"""
TAKE_S = 60.0
"""how long a fork server may take to accept descriptors while too many are under way; it may still import"""
TRY_AGAIN_S = 0.01
ENDED_BYTES = 8


class Ended(NamedTuple):
    """What the launcher is told of a process."""

    number: int
    status: int
    """negative is the signal that killed it"""

    def frame(self) -> bytes:
        """The same in ENDED_BYTES."""
        return self.number.to_bytes(4, "big") + self.status.to_bytes(4, "big", signed=True)

    @classmethod
    def read(cls, frame: bytes) -> Ended:
        """Return what `frame` made a frame of."""
        return cls(int.from_bytes(frame[:4], "big"), int.from_bytes(frame[4:], "big", signed=True))


class Process:
    """A forked process. It ends when its standard input does, which its launcher holds open."""

    def __init__(
        self, server: ForkServer, number: int, stdin: int, stdout: int | None, on_end: Callable[[], None]
    ) -> None:
        self._stdin = stdin
        self.stdout = stdout
        """where what it says is read, if that is wanted"""
        self._streams = [stream for stream in (stdin, stdout) if stream is not None]
        """of the launcher's; closed once it has ended"""
        self._server = server
        self._number = number
        self._on_end = on_end
        self._over = threading.Event()
        self._status = 0

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return not self._over.is_set()

    @property
    def status(self) -> int:
        """Its exit status, once it has ended; negative is the signal that killed it."""
        self._over.wait()
        return self._status

    def wait(self, timeout: float) -> bool:
        """Whether it has ended, within `timeout` seconds."""
        return self._over.wait(max(timeout, 0.0))

    def signal(self, number: int) -> None:
        """Send a signal to it and its process group, if it has not ended."""
        if self.running:
            self._server.signal(self._number, number)

    def end(self, timeout: float = 0.0) -> int:
        """Return its exit status; it is killed after `timeout` seconds."""
        if not self.wait(timeout):
            self.signal(signal.SIGKILL)
            if not self.wait(KILL_S):
                self._server.kill()
        status = self.status
        self.hang_up()
        return status

    def hang_up(self) -> None:
        """Close the launcher's ends of its streams."""
        streams, self._streams = self._streams, []
        for stream in streams:
            os.close(stream)

    def hand(self, data: bytes) -> None:
        """Write `data` to its standard input, if it has not ended."""
        left = memoryview(data)
        with suppress(BrokenPipeError):
            while left:
                left = left[os.write(self._stdin, left) :]

    def ended(self, status: int) -> None:
        """It has."""
        self._status = status
        self._over.set()
        self._on_end()


class ForkServer:
    """A fork server of this process, its launcher."""

    def __init__(self, warm_up: str) -> None:
        """`warm_up` is what it calls first, module:function."""
        self._socket, its = socket.socketpair()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the server
        # -P: the user's directory may hold a folder called world, or agent
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "compose.fork_server", warm_up],
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
        """whether it has ended, and all its processes with it"""
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
        """A process that calls `main`, module:function, with `arguments` in sys.argv.

        Its standard error goes to `errors`; its standard output to a pipe if it `answers`, else nowhere.
        `on_end` is called in another thread when it has ended.
        """
        its_input, our_input = os.pipe()
        our_output, its_output = os.pipe() if answers else (None, os.open(os.devnull, os.O_WRONLY))
        with self._lock:
            number = next(self._numbers)
            process = self._running[number] = Process(self, number, our_input, our_output, on_end)
            self._ask(Start(number, main, title, arguments), [its_input, its_output, errors])
        os.close(its_input)
        os.close(its_output)
        if self.gone:
            self._end_all()
        return process

    def signal(self, process: int, number: int) -> None:
        """Send a signal to a process of that number, if it has not ended."""
        with self._lock:
            self._ask(Signal(process, number), [])

    def why_gone(self) -> str:
        """Say how the server ended, once it is gone."""
        status = self._process.wait()
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().splitlines()
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return f"the fork server {how}{f': {said[-1]}' if said else ''}"

    def kill(self) -> None:
        """End it, and any process of it that still runs."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """The same, and free what it takes in the launcher."""
        self.kill()
        self._listener.join()
        self._socket.close()
        self._errors.close()

    def _ask(self, request: Start | Signal, streams: list[int]) -> None:
        body = msgspec.msgpack.encode(request)
        frame = len(body).to_bytes(LENGTH_BYTES, "big") + body
        try:
            sent = self._send_streams(frame, streams) if streams else 0
            self._socket.sendall(frame[sent:])
        except OSError:  # no request is lost in silence: `_listen` sees the end of the server
            self._process.kill()

    def _send_streams(self, frame: bytes, streams: list[int]) -> int:
        """Send `streams` with the beginning of `frame`, whose size is returned. Raises OSError.

        A user may have no more descriptors under way between all processes than one may have open; so the
        server has TAKE_S to take those of earlier requests.
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
            while received := self._socket.recv(4096):
                news += received
                while len(news) >= ENDED_BYTES:
                    one, news = Ended.read(news[:ENDED_BYTES]), news[ENDED_BYTES:]
                    self._running.pop(one.number).ended(one.status)
        self.gone = True
        self._end_all()

    def _end_all(self) -> None:
        """No process outlasts the server."""
        with self._lock:
            left, self._running = self._running, {}
        for process in left.values():
            process.ended(-signal.SIGKILL)


_servers: dict[str, ForkServer] = {}
_lock = threading.Lock()


def fork_server(warm_up: str) -> ForkServer:
    """Return this process's fork server that has called `warm_up`; it is started if there is none."""
    with _lock:
        server = _servers.get(warm_up)
        if server is None or server.gone:
            server = _servers[warm_up] = ForkServer(warm_up)
        return server


def close() -> None:
    """End the fork servers of this process."""
    with _lock:
        while _servers:
            _servers.popitem()[1].close()
