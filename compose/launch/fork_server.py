"""The process that a launcher's processes are forked from.

Its first argument is WARM_UP, a module, or a module:function that it calls, which imports what the processes
need. It opens no session and starts no thread. Its standard input is a socket to the launcher
(`compose/launch/forked.py`). The launcher sends requests for processes and signals on it, and receives the
exit status of each process. The server ends when the launcher does, and no process outlasts the server.
"""

from __future__ import annotations

import ctypes
import gc
import os
import select
import signal
import socket
import sys
import time
from contextlib import suppress
from importlib import import_module

import msgspec
from setproctitle import setproctitle

from compose.launch.forked import REQUEST_BYTES, STREAMS, Ended, ForkRequest, Imported, Signal
from protocol.output import one_line

PRCTL = ctypes.CDLL(None).prctl
PR_SET_PDEATHSIG = 1
"""The option of prctl(2) for a signal on the end of the parent, from <sys/prctl.h>."""
NOT_FORKED = 71
"""The exit status reported for a process that could not be forked (EX_OSERR)."""
LINGER_S = 5.0
"""Time in s that processes have to end after their launcher has ended; then they are killed."""


class _RequestLoop:
    """The request loop of the fork server, and the children that run, by process id."""

    def __init__(self, launcher: socket.socket) -> None:
        self._launcher = launcher
        self._numbers: dict[int, int] = {}
        self._decoder = msgspec.msgpack.Decoder(ForkRequest | Signal)
        # a signal that arrives just before a blocking call does not interrupt it, but it fills this pipe
        self._ends, self._wake_up = os.pipe()
        os.set_blocking(self._wake_up, False)
        self._news = select.poll()
        self._news.register(self._ends, select.POLLIN)

    def serve(self) -> ForkRequest | None:
        """Handle the launcher's requests until the launcher has ended, then return None.

        It also returns in each forked process: there, the request for that process.
        """
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(self._wake_up, warn_on_full_buffer=False)
        self._news.register(self._launcher, select.POLLIN)
        self._report(Imported())
        while True:
            if self._launcher.fileno() in self._wait(None):
                frame, streams, _, _ = socket.recv_fds(self._launcher, REQUEST_BYTES, len(STREAMS))
                if not frame:
                    return None
                match self._decoder.decode(frame):
                    case Signal() as request:
                        self._send(request)
                    case ForkRequest() as request if self._fork(request, streams):
                        return request

    def linger(self) -> None:
        """Wait at most LINGER_S until all children have ended."""
        self._news.unregister(self._launcher)
        give_up = time.monotonic() + LINGER_S
        while self._numbers and (left := give_up - time.monotonic()) > 0.0:
            self._wait(left)

    def _wait(self, within: float | None) -> set[int]:
        """Wait at most `within` seconds for news, report ended children, and return where it is from."""
        found = {source for source, _ in self._news.poll(None if within is None else 1e3 * within)}
        if self._ends in found:
            os.read(self._ends, select.PIPE_BUF)
            with suppress(ChildProcessError):
                while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                    pid, status = ended
                    self._report(Ended(self._numbers.pop(pid), os.waitstatus_to_exitcode(status)))
        return found

    def _fork(self, start: ForkRequest, streams: list[int]) -> bool:
        """Fork a process, and return whether this is the child."""
        parent = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            os.write(streams[1], f"cannot start a process: {error.strerror}\n".encode())
            self._report(Ended(start.number, NOT_FORKED))
        else:
            if not pid:
                self._launcher.detach()  # its descriptor becomes the child's standard input
                signal.set_wakeup_fd(-1)
                os.close(self._ends)
                os.close(self._wake_up)
                _become(start, streams, parent)
                return True
            self._numbers[pid] = start.number
        for stream in streams:
            os.close(stream)
        return False

    def _send(self, request: Signal) -> None:
        for pid, number in self._numbers.items():
            if number == request.number:
                try:
                    os.killpg(pid, request.signal)
                except ProcessLookupError:  # it has not created its process group yet
                    os.kill(pid, request.signal)

    def _report(self, event: Ended | Imported) -> None:
        with suppress(OSError):  # the launcher has ended
            self._launcher.send(msgspec.msgpack.encode(event))


def _become(start: ForkRequest, streams: list[int], parent: int) -> None:
    """Give this forked process its own session, default signals, `streams`, arguments and title."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    PRCTL(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(128 + signal.SIGKILL)
    for number, stream in zip(STREAMS, streams, strict=True):
        os.dup2(stream, number)
        os.close(stream)
    sys.argv = [start.title, *start.arguments]
    setproctitle(one_line(" ".join(sys.argv)))


def _call(name: str) -> None:
    module, _, function = name.partition(":")
    imported = import_module(module)
    if function:
        getattr(imported, function)()


def main() -> None:
    """Import or call WARM_UP, and fork processes until the launcher has ended."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    PRCTL(PR_SET_PDEATHSIG, signal.SIGCONT)  # a suspended server must notice the end, too
    _call(sys.argv[1])
    setproctitle(f"tandem fork-server of {os.getppid()}")
    gc.collect()
    gc.freeze()  # else garbage collection in a child would copy the pages of imported modules
    server = _RequestLoop(socket.socket(fileno=0))
    start = server.serve()
    if start is None:
        server.linger()
        os._exit(0)
    _call(start.main)
