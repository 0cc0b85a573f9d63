"""The page's web server. It listens on the loopback interface by default.

It refuses requests of foreign web pages, and runs missions for browsers on this machine only.
"""

from __future__ import annotations

import asyncio
import gc
import ipaddress
import logging
import signal
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import nullcontext, suppress
from typing import Any, TypeVar

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
from compose.recording.run_setup import RunSetup
from compose.scenario.scenario_change import ScenarioChange
from compose.scenario.toml_file import field_first
from compose.view.recorded import scenes
from compose.view.series import series
from compose.view.web.origin import refusal
from compose.view.web.site import Site
from compose.view.web.sources import WatchedRun
from compose.view.web.standalone import PAGE
from protocol import documents

LOOPBACK = "127.0.0.1"
LIVE_POLL_S = 0.05
"""The interval in s at which runs are polled and updates are sent to pages while a mission is live."""
IDLE_POLL_S = 0.5
"""The interval in s at which runs are polled and updates are sent to pages while no mission is live."""
PLAYERS_AT_ONCE = 1000
"""The maximum number of robots times ticks in one answer: half a megabyte and some 10 ms of work."""
HEADERS = {
    b"content-security-policy": b"default-src 'self'; style-src 'self' 'unsafe-inline'; "
    b"img-src 'self' data:; frame-ancestors 'none'",
    b"cross-origin-resource-policy": b"same-origin",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cache-control": b"no-store",
}
"""The headers of every answer. The page loads nothing from elsewhere, and no other page may embed it."""
T = TypeVar("T")
MOST_WAITING = 16
"""The maximum number of requests that are computed, or wait until they are."""
LONGEST_SERIES_S = 10.0
"""The wall time in s that the series of one request may take."""
SCENES_TOLD = 5
"""The number of scenes in one event of the news. A page requests all others, in larger numbers."""
MAX_CHANGE_BYTES = 8192
"""The maximum size of a request to change a mission."""
NEWS = "/api/news"
"""The path of the events of `_news`, whose answer lasts as long as the page is open."""
EMBEDDED = "/one"
"""The path of the page of one recording, which only the page of two recordings embeds."""


class CannotServe(OSError):
    """The port is not available; the text says why."""


# --- requests ---------------------------------------------------------------------------------------


class _Answers:
    """The request handlers for `site`."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._working = asyncio.Lock()
        """Held while a request is computed: one at a time."""
        self._waiting = 0
        """The number of requests that are computed, or wait until they are."""
        self._costing = asyncio.Lock()
        """Held while the costs of one mission are computed."""
        self._costs: dict[str, asyncio.Task[None]] = {}
        """The computations of what faults have cost, by the name of the mission."""

    async def _computed(self, work: Callable[..., T], *arguments: Any) -> T:
        """Return the result of `work` in a thread. Raises _Refused if MOST_WAITING requests wait already."""
        if self._waiting >= MOST_WAITING:
            raise _Refused(503, "the server computes other answers; try again in a moment")
        self._waiting += 1
        try:
            async with self._working:
                return await asyncio.to_thread(work, *arguments)
        finally:
            self._waiting -= 1

    async def index(self, _request: Request) -> Response:
        return FileResponse(PAGE / ("compare.html" if self._site.compared else "index.html"))

    async def one(self, _request: Request) -> Response:
        self._site.require_compared()
        policy = HEADERS[b"content-security-policy"].decode().replace("'none'", "'self'")
        return FileResponse(PAGE / "index.html", headers={"content-security-policy": policy})

    async def comparison(self, _request: Request) -> Response:
        return _json(await self._computed(self._site.comparison))

    async def results(self, request: Request) -> Response:
        """Return the data of the sweep or of the estimate that the server shows."""
        return _json(await self._computed(self._site.results, request.path_params["kind"]))

    async def figure(self, request: Request) -> Response:
        figure = self._site.figure(request.path_params["name"])
        if figure is None:
            raise _Refused(404, "there is no such figure")
        return Response(figure, media_type="image/svg+xml")

    async def worst(self, request: Request) -> Response:
        """Run the worst trial of a cell, unless that has been done, and return the name of its recording."""
        trials, cell = self._site.trials, _whole(request.path_params["cell"])
        _require_local(request)
        if trials is None or cell is None:
            raise _Refused(404, "there is no such cell")
        worst = await self._computed(trials.worst, cell)
        return _json({"show": worst.show.name, "outcome": worst.outcome, "trial": worst.trial})

    async def values(self, request: Request) -> Response:
        """Return the values of a mission that can be changed."""
        return _json(await self._computed(self._site.changed.values, self._changeable(request)))

    async def changed_file(self, request: Request) -> Response:
        """Return the scenario file of a mission with other values."""
        show, change = self._changeable(request), await _change_in(request)
        text = await self._computed(self._site.changed.text, show, change)
        return PlainTextResponse(text, media_type="application/toml")

    async def run_changed(self, request: Request) -> Response:
        """Run a mission with other values, and return the name of its recording."""
        site, show, change = self._site, self._changeable(request), await _change_in(request)
        if self._working.locked():
            raise _Refused(409, "another mission is being run; try again in a moment")
        found = await self._computed(site.changed.run, show, change)
        site.changed.add(found, site.shows)
        return _json({"show": found.name})

    def _show(self, request: Request) -> tuple[WatchedRun, RunSetup]:
        """Return the run that a request is about, and its static data. Raises _Refused."""
        show = self._site.shows.get(request.path_params["name"])
        if show is None or show.setup is None:
            raise _Refused(404, "there is no such mission")
        return show, show.setup

    def _changeable(self, request: Request) -> WatchedRun:
        """Return the mission that a request is about. Raises _Refused if its values cannot be changed."""
        show, _ = self._show(request)
        if self._site.compared:
            raise _Refused(404, "the mission is shown side by side with another")
        _require_local(request)
        return show

    async def show(self, request: Request) -> Response:
        """Return a mission, and begin to compute what its faults have cost, once it has ended."""
        show, _ = self._show(request)
        if not show.live and show.name not in self._costs:
            self._costs[show.name] = asyncio.create_task(self._add_costs(show))
        return _json(show.mission)

    async def _add_costs(self, show: WatchedRun) -> None:
        async with self._costing:  # else the costs of many missions take all threads from requests
            show.known.add_costs(await asyncio.to_thread(self._site.costs_of, show))
        show.revised()

    async def scenes(self, request: Request) -> Response:
        show, setup = self._show(request)
        first = _number(request, "from", 0)
        most = max(1, PLAYERS_AT_ONCE // len(setup.robots))
        last = min(_number(request, "to", show.known.last), first + most - 1, show.known.last)
        shown = scenes(setup, show.known, first, last)
        return _json({"from": first, "to": last, "version": show.version, "scenes": shown})

    async def series(self, request: Request) -> Response:
        """Return the numbers of the robots named `robot`, of all without a name, over time."""
        show, setup = self._show(request)
        robots = request.query_params.getlist("robot") or None
        give_up = time.monotonic() + LONGEST_SERIES_S

        def check() -> None:
            if self._site.over or time.monotonic() > give_up:
                raise _Refused(503, f"it takes more than {LONGEST_SERIES_S:g} s: ask for fewer robots")

        # A thread, because thousands of ticks take longer than the interval of the news.
        return _json(await self._computed(series, setup, show.known, robots, check))

    async def news(self, request: Request) -> Response:
        stream = news_events(self._site, request.query_params.get("show"), _number(request, "since", 0))
        return StreamingResponse(stream, media_type="text/event-stream")


class _Refused(Exception):
    """A request that is refused; the text says why."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status
        """The status of the answer."""


def _require_local(request: Request) -> None:
    """Raise _Refused unless the request is from this machine: only its users may start missions."""
    if request.client is None or not ipaddress.ip_address(request.client.host).is_loopback:
        raise _Refused(403, "missions are run again for browsers on the server's machine only")


async def _refusal(_request: Request, error: Exception) -> Response:
    """Return the answer to a request that is refused, or whose values are."""
    return _json({"error": str(error)}, error.status if isinstance(error, _Refused) else 422)


async def _change_in(request: Request) -> ScenarioChange:
    """Return the values in the body of a POST of the page. Raises _Refused."""
    if len(request.headers.getlist("origin")) != 1:  # `_Sealed` has refused foreign ones
        raise _Refused(403, "only the page of this server may change a mission (Origin header)")
    if request.headers.get("content-type") != "application/json":
        raise _Refused(415, "the values must be JSON (Content-Type header)")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MAX_CHANGE_BYTES:
            raise _Refused(413, f"too many robots are changed: more than {MAX_CHANGE_BYTES} bytes")
    try:
        found: ScenarioChange = documents.json_value(body, ScenarioChange)
    except msgspec.DecodeError as error:
        raise _Refused(400, field_first(str(error), ScenarioChange)) from None
    return found


def application(site: Site) -> Starlette:
    """Return the web application of `site`, which refuses requests of foreign web pages."""
    answers = _Answers(site)
    return Starlette(
        routes=[
            Route("/", answers.index),
            Route(EMBEDDED, answers.one),
            Route("/api/comparison", answers.comparison),
            Route("/api/results/{kind}", answers.results),
            Route("/api/figures/{name}", answers.figure),
            Route("/api/cells/{cell}/worst", answers.worst, methods=["POST"]),
            Route("/api/shows/{name}", answers.show),
            Route("/api/shows/{name}/scenes", answers.scenes),
            Route("/api/shows/{name}/values", answers.values),
            Route("/api/shows/{name}/changed", answers.run_changed, methods=["POST"]),
            Route("/api/shows/{name}/changed.toml", answers.changed_file, methods=["POST"]),
            Route("/api/shows/{name}/series", answers.series),
            Route(NEWS, answers.news),
            Mount("/page", StaticFiles(directory=PAGE)),
        ],
        exception_handlers={_Refused: _refusal, UserError: _refusal},
        middleware=[Middleware(_Sealed, site)],
    )


class _Sealed:
    """Middleware that refuses requests of foreign web pages (see `origin`), and adds HEADERS to every answer.

    A header that the answer has already stays. It counts the requests that are being answered.
    """

    def __init__(self, app: ASGIApp, site: Site) -> None:
        self._app = app
        self._site = site

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def sealed(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name for name, _ in message["headers"]}
                added = [(name, value) for name, value in HEADERS.items() if name not in given]
                message["headers"] = [*message["headers"], *added]
            await send(message)

        headers = Headers(scope=scope)
        why = refusal(headers.getlist("host"), headers.getlist("origin"))
        app = self._app if why is None else PlainTextResponse(f"{why}\n", 403)
        counted = scope["path"] != NEWS
        self._site.answering += counted
        try:
            await app(scope, receive, sealed)
        finally:
            self._site.answering -= counted


def _number(request: Request, name: str, default: int) -> int:
    found = _whole(request.query_params.get(name, ""))
    return default if found is None else found


def _whole(text: str) -> int | None:
    """Return the number from 0 to 10^15 - 1 that `text` is; None if it is none."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else None


def _json(value: object, status: int = 200) -> Response:
    """Return an answer. Raises UserError if a number in `value` cannot be in JSON."""
    try:
        return Response(msgspec.json.encode(value), status, media_type="application/json")
    except OverflowError as error:
        raise UserError(str(error)) from None


async def news_events(site: Site, name: str | None, version: int) -> AsyncIterator[bytes]:
    """Yield server-sent events: the list of runs when it changes, and updates of the show called `name`.

    An update has the state of the run, the first tick that changed since `version`, and the scenes from that
    tick on, if these are at most SCENES_TOLD; else, while the run goes on, the scene of the latest tick.
    """
    listed: dict[str, Any] | None = None
    state: dict[str, Any] | None = None
    while not site.over:
        event: dict[str, Any] = {}
        now = site.listed()
        if now != listed:
            event["list"] = listed = now
        show = site.shows.get(name or "")
        if show is not None and show.setup is not None:
            since = show.since(version)
            version = show.version
            now = show.state
            if since is not None or now != state:
                state = now
                head = show.head
                first = head if since is None else min(since, head)
                if head - first >= SCENES_TOLD:
                    first = head if show.live else head + 1
                told = scenes(show.setup, show.known, first, head)
                event["show"] = {**now, "from": since, "robots": len(show.setup.robots), "scenes": told}
        if event:
            yield b"data: " + msgspec.json.encode(event) + b"\n\n"
        await asyncio.sleep(LIVE_POLL_S if site.waiting else IDLE_POLL_S)


# --- serving ----------------------------------------------------------------------------------------


def bound(port: int, address: str = LOOPBACK) -> socket.socket:
    """Return a listening socket on `address` at `port`, or at a free port if it is 0.

    Raises CannotServe if the port is not available.
    """
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


def address(taken: socket.socket) -> str:
    """Return the URL of the server that listens on the socket `taken`, for a browser on this machine."""
    host, port, *_ = taken.getsockname()
    if ipaddress.ip_address(host).is_unspecified:
        host = LOOPBACK
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


Ready = Callable[[Callable[[], None]], None]
"""A callback for when the server answers requests. Its argument is a function that stops the server."""


def serve(site: Site, taken: socket.socket, ready: Ready) -> None:
    """Serve `site` until SIGINT, SIGTERM or SIGHUP, or until the function passed to `ready` is called."""
    asyncio.run(_serve(site, taken, ready))


logging.getLogger("uvicorn").addHandler(logging.NullHandler())  # Tandem reports errors itself


async def _serve(site: Site, taken: socket.socket, ready: Ready) -> None:
    app = application(site)
    server = _Server(
        uvicorn.Config(app, log_config=None, lifespan="off", timeout_graceful_shutdown=1, ws="none")
    )
    loop = asyncio.get_running_loop()

    def stop() -> None:
        site.work.stop()
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, stop)
    reading_s = _polled(site)
    serving = asyncio.create_task(server.serve(sockets=[taken]))
    announced = False
    while not serving.done():
        if server.started and not announced:
            announced = True
            ready(lambda: _soon(loop, stop))
        pause = LIVE_POLL_S if site.waiting or not announced else IDLE_POLL_S
        if site.more:  # requests come first: while there are any, they have half of the time
            pause = reading_s if site.answering else 0.0
        await asyncio.wait([serving], timeout=pause)
        reading_s = _polled(site)
    await serving


def _polled(site: Site) -> float:
    """Poll `site`, and return the wall time in s that it has taken."""
    begun = time.monotonic()
    site.poll()
    if site.waiting:  # the data of a run stays: looking through it for garbage takes a third of the time
        gc.freeze()
    return time.monotonic() - begun


def _soon(loop: asyncio.AbstractEventLoop, stop: Callable[[], None]) -> None:
    with suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(stop)


class _Server(uvicorn.Server):
    """A uvicorn server that leaves signals to `_serve`."""

    def capture_signals(self) -> Any:
        """Return a context that does nothing."""
        return nullcontext()
