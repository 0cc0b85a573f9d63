"""A proxy in front of the Foxglove SDK's server, which itself accepts web pages of any origin.

The gate reads the head of each request, refuses requests of foreign web pages, and forwards all others to
the SDK's server. That server listens on a random address of 127.0.0.0/8 and a random port: about 2^38
combinations, too many for a page to try. The gate does not restrict other programs on this machine.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
import threading
from asyncio import LimitOverrunError, StreamReader, StreamWriter
from collections.abc import Sequence
from contextlib import closing, suppress

from compose.view.web.origin import refusal

FOXGLOVE = ("https://app.foxglove.dev", "file://")
"""The origins of Foxglove's app, in a browser and installed; not `null`, which any page can have."""
HEAD_BYTES = 1 << 14
"""The maximum size of a request's head in bytes."""
HEAD_S = 10.0
"""The maximum time in s for a request's head to arrive."""
GATE_PIECE_BYTES = 1 << 16
"""The maximum size in bytes of a forwarded piece."""
GUESTS = 64
"""The maximum number of forwarded connections; more are refused.

Without a limit, the SDK's server would run out of descriptors, and accept no more.
"""
REFUSED = 32
"""The maximum number of connections that are being refused. Further ones wait until they are accepted."""
REFUSED_REQUEST_S = 1.0
"""The time in s for the head of a refused request to arrive, and for the end of an answer to be read."""
RETRY_S = 0.1
"""The time in s until a connection is accepted after one could not be."""
GUESTS_FILES = 3 * GUESTS + REFUSED + 88
"""The file descriptors for GUESTS, three for each, for REFUSED, and for the rest of the process."""

Place = tuple[str, int]
"""A host and a port."""


def private_host() -> str:
    """Return a random loopback address, which a web page cannot guess."""
    return "127." + ".".join([str(1 + secrets.randbelow(254)) for _ in range(3)])


class Gate:
    """A listening port whose thread forwards the allowed connections to the SDK's server."""

    def __init__(self, taken: socket.socket, behind: Place, origins: Sequence[str]) -> None:
        """Create a gate on the listening socket `taken`, in front of the SDK's server at `behind`.

        Web pages of `origins` are allowed in addition to FOXGLOVE.
        """
        self._taken = taken
        self._behind = behind
        self._origins = (*FOXGLOVE, *origins)
        self._guests = 0
        self._room = asyncio.Semaphore(GUESTS + REFUSED)
        """The number of connections that may still be opened, so that descriptors never run out."""
        self._admitted: set[asyncio.Task[None]] = set()

    def open(self) -> None:
        """Start the thread, which ends with the process."""
        threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True).start()

    async def _serve(self) -> None:
        self._taken.setblocking(False)
        while True:
            await self._room.acquire()
            try:
                accepted, _ = await asyncio.get_running_loop().sock_accept(self._taken)
            except OSError:  # the connection has been reset, or the system has no descriptor left
                self._room.release()
                await asyncio.sleep(RETRY_S)
                continue
            task = asyncio.create_task(self._admit(accepted))
            self._admitted.add(task)
            task.add_done_callback(self._admitted.discard)

    async def _admit(self, accepted: socket.socket) -> None:
        guest = self._guests < GUESTS
        self._guests += guest
        try:
            reader, writer = await asyncio.open_connection(sock=accepted, limit=HEAD_BYTES)
            with suppress(OSError, EOFError, LimitOverrunError):
                await self._answer(guest, reader, writer)
            writer.close()
            with suppress(OSError):
                await asyncio.wait_for(writer.wait_closed(), REFUSED_REQUEST_S)
            writer.transport.abort()  # it may hold data that nobody reads
        finally:
            self._guests -= guest
            self._room.release()

    async def _answer(self, guest: bool, reader: StreamReader, writer: StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S if guest else REFUSED_REQUEST_S)
        if not guest:
            await _refuse(writer, "503 Service Unavailable", "too many connections")
            return
        why = self._refusal(head)
        if why is not None:
            await _refuse(writer, "403 Forbidden", why)
            return
        await self._hand_on(head, reader, writer)

    def _refusal(self, head: bytes) -> str | None:
        lines = [line.partition(":") for line in head.decode("latin-1").split("\r\n")[1:]]

        def values(wanted: str) -> list[str]:
            return [value.strip() for name, _, value in lines if name.strip().lower() == wanted]

        if [value.lower() for value in values("upgrade")] != ["websocket"]:
            return "only WebSocket connections are accepted"  # so that a connection has one head
        return refusal(values("host"), values("origin"), self._origins)

    async def _hand_on(self, head: bytes, reader: StreamReader, writer: StreamWriter) -> None:
        """Forward both ways until one end closes. A slow reader delays the SDK's server, not the gate."""
        there, back = await asyncio.open_connection(*self._behind)
        with closing(back):
            back.write(head)
            ways = [asyncio.create_task(_copy(reader, back)), asyncio.create_task(_copy(there, writer))]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _refuse(writer: StreamWriter, status: str, why: str) -> None:
    body = f"{why}\n".encode()
    writer.write(f"HTTP/1.1 {status}\r\nConnection: close\r\nContent-Type: text/plain\r\n".encode())
    writer.write(b"Content-Length: %d\r\n\r\n%s" % (len(body), body))
    await writer.drain()


async def _copy(reader: StreamReader, writer: StreamWriter) -> None:
    while piece := await reader.read(GATE_PIECE_BYTES):
        writer.write(piece)
        await writer.drain()
