"""The process that a launcher's processes are forked from: `python -P -m compose.fork_server WARM_UP`.

It has called WARM_UP (module:function), which imports what they need, and has opened nothing: no session, no
thread. Its standard input is a socket to the launcher (`compose/forked.py`), which asks on it for processes
and signals, and is told how each process ended. It ends with the launcher, and no process outlasts it.
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import socket
import sys
import time
from contextlib import suppress
from importlib import import_module

import msgspec
from setproctitle import setproctitle

from compose.forked import LENGTH_BYTES, STREAMS, Ended, Signal, Start
from protocol.terminal import one_line

NOT_FORKED = 71
"""exit status told of a process that could not be forked: EX_OSERR"""
LINGER_S = 5.0
"""how long processes may outlast their launcher, whose end each of them sees; then they are killed"""
LOOK_AGAIN_S = 0.01
PR_SET_PDEATHSIG = 1
"""<sys/prctl.h>"""


class _Server:
    """The children that run, by process id."""

    def __init__(self, launcher: socket.socket) -> None:
        self._launcher = launcher
        self._numbers: dict[int, int] = {}
        self._decoder = msgspec.msgpack.Decoder(Start | Signal)

    def serve(self) -> Start | None:
        """Do what the launcher asks for.

        Returns twice: in each forked process with what it is to be, and here None when the launcher has gone.
        """
        signal.signal(signal.SIGCHLD, self._reap)
        while (received := self._request()) is not None:
            request, streams = received
            # a child that ends meanwhile is reaped afterwards
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])
            if isinstance(request, Signal):
                self._send(request)
            elif self._fork(request, streams):
                return request
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
        return None

    def linger(self) -> None:
        """Wait until all children have ended, for LINGER_S at the most."""
        give_up = time.monotonic() + LINGER_S
        while self._numbers and time.monotonic() < give_up:
            time.sleep(LOOK_AGAIN_S)

    def _request(self) -> tuple[Start | Signal, list[int]] | None:
        head, streams, _, _ = socket.recv_fds(self._launcher, LENGTH_BYTES, STREAMS)
        if not head:
            return None
        body = self._read(int.from_bytes(head + self._read(LENGTH_BYTES - len(head)), "big"))
        return self._decoder.decode(body), streams

    def _read(self, size: int) -> bytes:
        body = b""
        while len(body) < size:
            body += self._launcher.recv(size - len(body)) or sys.exit(0)
        return body

    def _fork(self, start: Start, streams: list[int]) -> bool:
        """Whether this is the forked process."""
        parent = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            os.write(streams[2], f"cannot start a process: {error.strerror}\n".encode())
            self._tell(Ended(start.number, NOT_FORKED))
        else:
            if not pid:
                self._launcher.detach()  # its descriptor becomes the child's standard input
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
                except ProcessLookupError:  # it is about to make its group
                    os.kill(pid, request.signal)

    def _reap(self, _number: int, _frame: object) -> None:
        with suppress(ChildProcessError):
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                pid, status = found
                self._tell(Ended(self._numbers.pop(pid), os.waitstatus_to_exitcode(status)))

    def _tell(self, news: Ended) -> None:
        with suppress(OSError):  # the launcher has gone
            self._launcher.sendall(news.frame())


def _become(start: Start, streams: list[int], parent: int) -> None:
    """Make this forked process what it would be had it been started by itself."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
    os.setsid()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(-signal.SIGKILL)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    sys.argv = [start.title, *start.arguments]
    setproctitle(one_line(" ".join(sys.argv)))


def _call(name: str) -> None:
    module, _, function = name.partition(":")
    getattr(import_module(module), function)()


def main() -> None:
    """Get ready, and fork processes until the launcher has gone."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    _call(sys.argv[1])
    setproctitle(f"tandem fork-server of {os.getppid()}")
    gc.collect()
    gc.freeze()  # a collection in a child does not touch, and so copy, what was imported
    server = _Server(socket.socket(fileno=0))
    start = server.serve()
    if start is None:
        server.linger()
        os._exit(0)
    _call(start.main)


if __name__ == "__main__":
    main()
