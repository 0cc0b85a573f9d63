"""The gate before the SDK's server, which accepts whoever connects, web pages of any origin included.

The gate reads the head of each request, refuses what a foreign page asks, and hands on the rest to the SDK's
server. That one listens on an address of 127.0.0.0/8 and a port that are drawn at random: some 2^38 places,
too many for a page to try. Other programs of this machine may look, with or without a gate.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
import threading
from asyncio import LimitOverrunError, StreamReader, StreamWriter
from collections.abc import Sequence
from contextlib import closing, suppress

from compose.origin import refusal

FOXGLOVE = ("https://app.foxglove.dev", "file://")
"""origins of Foxglove's own app, in a browser and installed; not `null`, which any page can have"""
HEAD_BYTES = 1 << 14
"""a request may have before its body"""
HEAD_S = 10.0
"""a request may take until its head is there"""
PIECE_BYTES = 1 << 16
GUESTS = 64
"""connections at once; more are turned away, or the SDK's server, short of descriptors, accepts no more"""
GUESTS_FILES = 3 * GUESTS + 120
"""descriptors for them: of each, both of the gate's and the SDK's; and those that are being turned away"""

Place = tuple[str, int]


def private_host() -> str:
    """Return an address of loopback that nobody can guess."""
    return "127." + ".".join([str(1 + secrets.randbelow(254)) for _ in range(3)])


class Gate:
    """A port that hands on what may pass, in a thread of its own."""

    def __init__(self, taken: socket.socket, behind: Place, origins: Sequence[str]) -> None:
        """`taken` listens; `behind` is where the SDK's server does; `origins` may ask beside FOXGLOVE."""
        self._taken = taken
        self._behind = behind
        self._origins = (*FOXGLOVE, *origins)
        self._guests = 0

    def open(self) -> None:
        """Begin; it ends with the process."""
        threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True).start()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._admit, sock=self._taken, limit=HEAD_BYTES)
        await server.serve_forever()

    async def _admit(self, reader: StreamReader, writer: StreamWriter) -> None:
        with closing(writer), suppress(OSError, EOFError, LimitOverrunError):
            if self._guests >= GUESTS:
                await _refuse(writer, "503 Service Unavailable", "too many look already")
                return
            self._guests += 1
            try:
                await self._look_at(reader, writer)
            finally:
                self._guests -= 1

    async def _look_at(self, reader: StreamReader, writer: StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
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
            return "only viewers are served here, over WebSocket"  # so a connection has one head
        return refusal(values("host"), values("origin"), self._origins)

    async def _hand_on(self, head: bytes, reader: StreamReader, writer: StreamWriter) -> None:
        """Both ways, until one end closes; who reads slowly holds up the SDK's server, not the gate."""
        there, back = await asyncio.open_connection(*self._behind)
        with closing(back):
            back.write(head)
            ways = [asyncio.create_task(_copy(reader, back)), asyncio.create_task(_copy(there, writer))]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _refuse(writer: StreamWriter, status: str, why: str) -> None:
    said = f"{why}\n".encode()
    writer.write(f"HTTP/1.1 {status}\r\nConnection: close\r\nContent-Type: text/plain\r\n".encode())
    writer.write(b"Content-Length: %d\r\n\r\n%s" % (len(said), said))
    await writer.drain()


async def _copy(reader: StreamReader, writer: StreamWriter) -> None:
    while piece := await reader.read(PIECE_BYTES):
        writer.write(piece)
        await writer.drain()
