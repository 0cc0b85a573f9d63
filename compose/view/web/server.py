"""Who serves the page: on loopback if not told otherwise, to programs and to its own page.

It reads, and writes nothing.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import signal
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from compose.errors import UserError
from compose.view.recorded import scenes
from compose.view.web import sweep_page
from compose.view.web.origin import refusal
from compose.view.web.site import Site
from compose.view.web.sources import Show

LOOPBACK = "127.0.0.1"
PAGE = Path(__file__).parent / "page"
POLL_S = 0.05
"""how often to look for what is new while a mission runs, and how often a page hears of it"""
IDLE_S = 0.5
"""the same, while none does"""
PLAYERS_AT_ONCE = 4000
"""robots times ticks in one answer: some megabytes, and some hundredths of a second of work"""
HEADERS = {
    b"content-security-policy": b"default-src 'self'; style-src 'self' 'unsafe-inline'; "
    b"img-src 'self' data:; frame-ancestors 'none'",
    b"cross-origin-resource-policy": b"same-origin",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cache-control": b"no-store",
}
"""the page may ask nobody else for anything, and no other page may show it, or a part of it"""


class CannotServe(OSError):
    """The port cannot be had; the text says why."""


# --- what is asked for ------------------------------------------------------------------------------


class _Answers:
    """What is answered, of `site`."""

    def __init__(self, site: Site) -> None:
        self._site = site

    async def index(self, _request: Request) -> Response:
        return FileResponse(PAGE / "index.html")

    async def sweep(self, _request: Request) -> Response:
        if self._site.folder is None:
            return _json({"error": "no sweep is shown"}, 404)
        try:
            return _json(sweep_page.told(self._site.folder))
        except UserError as error:
            return _json({"error": str(error)}, 500)

    async def figure(self, request: Request) -> Response:
        folder, name = self._site.folder, request.path_params["name"]
        if folder is None or name not in sweep_page.figures(folder):
            return _json({"error": "there is no such figure"}, 404)
        return FileResponse(folder / sweep_page.FIGURES / name, media_type="image/svg+xml")

    async def show(self, request: Request) -> Response:
        show = self._site.shows.get(request.path_params["name"])
        if show is None:
            return _json({"error": "there is no such mission"}, 404)
        return _json({"stage": show.stage, **_state(show), "version": show.version})

    async def scenes(self, request: Request) -> Response:
        show = self._site.shows.get(request.path_params["name"])
        if show is None or show.stage is None:
            return _json({"error": "there is no such mission"}, 404)
        first = _number(request, "from", 0)
        most = max(1, PLAYERS_AT_ONCE // len(show.stage.robots))
        last = min(_number(request, "to", show.known.last), first + most - 1, show.known.last)
        shown = scenes(show.stage, show.known, first, last)
        return _json({"from": first, "to": last, "version": show.version, "scenes": shown})

    async def news(self, request: Request) -> Response:
        told = _news(self._site, request.query_params.get("show"), _number(request, "since", 0))
        return StreamingResponse(told, media_type="text/event-stream")


def application(site: Site) -> Starlette:
    """The pages of `site`, for whoever asks for them by an address, and is no page of another."""
    answers = _Answers(site)
    return Starlette(
        routes=[
            Route("/", answers.index),
            Route("/api/sweep", answers.sweep),
            Route("/api/figures/{name}", answers.figure),
            Route("/api/shows/{name}", answers.show),
            Route("/api/shows/{name}/scenes", answers.scenes),
            Route("/api/news", answers.news),
            Mount("/page", StaticFiles(directory=PAGE)),
        ],
        middleware=[
            Middleware(_Sealed),
            Middleware(_Own),
        ],
    )


class _Own:
    """Refuses what pages of others ask."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        why = refusal(headers.getlist("host"), headers.getlist("origin"))
        if why is not None:
            await PlainTextResponse(f"{why}\n", 403)(scope, receive, send)
        else:
            await self._app(scope, receive, send)


class _Sealed:
    """Every answer with HEADERS."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def sealed(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *HEADERS.items()]
            await send(message)

        await self._app(scope, receive, sealed)


def _number(request: Request, name: str, otherwise: int) -> int:
    text = request.query_params.get(name, "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else otherwise


def _json(value: object, status: int = 200) -> Response:
    return Response(msgspec.json.encode(value), status, media_type="application/json")


def _state(show: Show) -> dict[str, Any]:
    return {
        "last": show.head,
        "first": next(iter(show.known.ticks), 0),
        "live": show.live,
        "has_truth": show.known.has_truth,
        "end": show.known.end,
        "farewells": show.known.final_reports,
        "notes": show.notes,
    }


async def _news(site: Site, name: str | None, version: int) -> AsyncIterator[bytes]:
    """What changes, as it does: the list, and of the show of that name from which tick on more is known."""
    listed: dict[str, Any] | None = None
    state: dict[str, Any] | None = None
    while not site.over:
        told: dict[str, Any] = {}
        now = site.listed()
        if now != listed:
            told["list"] = listed = now
        show = site.shows.get(name or "")
        if show is not None and show.stage is not None:
            since = show.since(version)
            version = show.version
            now = _state(show)
            if since is not None or now != state:
                state = now
                head = show.head
                told["show"] = {
                    **now,
                    "from": since,
                    "robots": len(show.stage.robots),
                    "scenes": scenes(show.stage, show.known, head, head) if show.live else (),
                }
        if told:
            yield b"data: " + msgspec.json.encode(told) + b"\n\n"
        await asyncio.sleep(POLL_S if site.waiting else IDLE_S)


# --- serving ----------------------------------------------------------------------------------------


def bound(port: int, address: str = LOOPBACK) -> socket.socket:
    """A socket on `address` at `port`, or, if that is 0, at one that is free. Raises CannotServe."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    taken = socket.socket(family, socket.SOCK_STREAM)
    taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        taken.bind((address, port))
        taken.listen(64)
    except OSError as error:
        taken.close()
        raise CannotServe(error.errno, error.strerror) from None
    return taken


def host(address: str) -> str:
    """What a browser on this machine calls a server on `address`."""
    if ipaddress.ip_address(address).is_unspecified:
        return LOOPBACK
    return f"[{address}]" if ":" in address else address


def address(taken: socket.socket) -> str:
    """What to open in a browser."""
    where, port, *_ = taken.getsockname()
    return f"http://{host(where)}:{port}/"


Ready = Callable[[Callable[[], None]], None]
"""what is called once pages are answered, with what ends it all"""


def serve(site: Site, taken: socket.socket, ready: Ready) -> None:
    """Serve `site` until SIGINT, SIGTERM or SIGHUP, or until what `ready` is given is called."""
    asyncio.run(_serve(site, taken, ready))


logging.getLogger("uvicorn").addHandler(logging.NullHandler())  # what is to be said, we say


async def _serve(site: Site, taken: socket.socket, ready: Ready) -> None:
    server = _Server(
        uvicorn.Config(
            application(site),
            log_config=None,
            lifespan="off",
            timeout_graceful_shutdown=1,
            ws="none",
        )
    )
    loop = asyncio.get_running_loop()

    def stop() -> None:
        site.over = True
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, stop)
    site.poll()
    serving = asyncio.create_task(server.serve(sockets=[taken]))
    told = False
    while not serving.done():
        if server.started and not told:
            told = True
            ready(lambda: _soon(loop, stop))
        await asyncio.wait([serving], timeout=POLL_S if site.waiting or not told else IDLE_S)
        site.poll()
    await serving


def _soon(loop: asyncio.AbstractEventLoop, stop: Callable[[], None]) -> None:
    with suppress(RuntimeError):  # it has ended
        loop.call_soon_threadsafe(stop)


class _Server(uvicorn.Server):
    """Signals are ours."""

    def install_signal_handlers(self) -> None:
        """Nothing."""

    def capture_signals(self) -> Any:
        """Nothing."""
        return nullcontext()
