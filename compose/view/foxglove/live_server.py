"""A process that serves a live run to Foxglove's viewers, from the journals of the run.

    python -m compose.view.foxglove.live_server PORT ORIGIN,... FOLDER ROBOT ...

The mission does not depend on this process. It publishes every journaled frame, but skips scenes if it falls
behind: of a backlog it shows the latest tick. It ends when its standard input is closed.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

import foxglove
from foxglove import Context
from foxglove.websocket import Capability, ChannelView, Client, ServerListener, WebSocketServer

from compose.launch.signals import stop_by_signal, stop_with_launcher
from compose.recording.frames import JournalDecoder
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run_setup import RunSetup
from compose.view.foxglove.gate import GUESTS_FILES, Gate, private_host
from compose.view.foxglove.mcap import Channels
from compose.view.foxglove.views import Views, nanoseconds
from compose.view.recorded import Journals, scenes
from compose.view.scene import Scene
from protocol import limits
from protocol.journal.journal_file import CorruptJournal, Tail
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say

HOST = "127.0.0.1"
JOURNALS_S = 0.05
"""The interval in s at which the journals are read."""
INCOMPLETE_TICK_S = 0.5
"""The time in s to wait for the rest of an incomplete tick once the next tick has begun."""
SETTLED_S = 1.0
"""The time in s after which a new subscriber certainly receives messages."""
BACKLOG = 8
"""The maximum number of new ticks that are shown one by one. Of more, only the latest is shown."""
MESSAGES = 1 << 14
"""The number of messages buffered for a slow viewer before the oldest are dropped."""
NICE = 10
"""The niceness of the process, which gives priority to the mission."""


class Live:
    """A growing recording, published on channels."""

    def __init__(self, folder: Path, channels: Channels) -> None:
        self.subscribed = False
        """True if a viewer has subscribed since `look` last published the static content."""
        self._folder = folder
        self._channels = channels
        self._journals = Journals(folder)
        self._tails: dict[str, tuple[Tail, JournalDecoder]] = {}
        self._views: Views | None = None
        self._next = 0
        """The next tick to show."""
        self._once_more: float | None = None
        """The time at which to publish the static content once more, for viewers that missed it; or None."""
        self._since: dict[int, float] = {}
        """The time at which each tick that is not yet shown was first seen."""

    def look(self, now: float) -> int | None:
        """Publish everything new in the journals.

        `now` is the monotonic clock in s. Return the simulated time in ns; None before the run has begun.
        """
        with suppress(OSError):
            self._journals.read()
        setup = self._journals.setup
        if setup is None or setup.seed is None:  # the world's journal has no scenario yet
            return None
        if self._views is None:
            self._views = Views(setup)
        self._publish_frames(setup)
        ready = self._ready(setup, now)
        first_shown = ready[0 if len(ready) <= BACKLOG else -1].tick if ready else 0
        for scene in ready:
            visible = scene.tick >= first_shown and self._channels.watched
            for view in self._views.of(scene) if visible else self._views.passing(scene):
                self._channels.view(*view, nanoseconds(setup, scene.tick))
        if ready:
            self._next = ready[-1].tick + 1
        due = self._once_more is not None and now >= self._once_more
        if self.subscribed or due:
            self._once_more = now + SETTLED_S if self.subscribed else None
            self.subscribed = False
            self._channels.republish()
            for view in (self._views.standing(), *self._views.latest()):
                self._channels.view(*view, nanoseconds(setup, max(0, self._next - 1)))
        return nanoseconds(setup, self._next)

    def _publish_frames(self, setup: RunSetup) -> None:
        for name in (WORLD_JOURNAL, *map(agent_journal, setup.ids)):
            tail, decoder = self._tails.setdefault(name, (Tail(self._folder / name), JournalDecoder(name)))
            with suppress(OSError, CorruptJournal):
                for one in decoder.decoded(tail.news()):
                    self._channels.frame(one, nanoseconds(setup, one.tick))

    def _ready(self, setup: RunSetup, now: float) -> list[Scene]:
        """Return the next scenes that are complete, or incomplete for longer than INCOMPLETE_TICK_S.

        The last tick is ready only after the mission's end, because its data may still be arriving.
        """
        known = self._journals.known
        last = known.last if known.end is not None else known.last - 1
        there = scenes(setup, known, self._next, last)
        for scene in there:
            self._since.setdefault(scene.tick, now)
        found = []
        for scene in there:
            whole = all(player.held is not None and player.pose is not None for player in scene.players)
            if not whole and now - self._since[scene.tick] < INCOMPLETE_TICK_S:
                break
            found.append(scene)
        for scene in found:
            del self._since[scene.tick]
        return found


class _Listener(ServerListener):
    """A listener that notes new subscriptions."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002
        self._live.subscribed = True


def main() -> NoReturn:
    """Serve the run that sys.argv names, and end the process with an exit status."""
    _, port, pages, recording, *ids = sys.argv
    sys.exit(serve(int(port), [one for one in pages.split(",") if one], Path(recording), ids))


def serve(port: int, origins: Sequence[str], folder: Path, robots: Sequence[str]) -> int:
    """Serve until a signal, or the end of the launcher. Return 1 if the port is not available, else 0.

    Web pages of `origins` are allowed to connect, in addition to Foxglove's app. All channels are created
    before a viewer can connect, because under load the SDK rejects subscriptions to new channels.
    """
    os.nice(NICE)
    inbox = Inbox("tandem run --foxglove")
    stop_with_launcher(inbox)
    stop_by_signal(inbox)
    context = Context()
    channels = Channels(context)
    channels.open(robots)
    live = Live(folder, channels)
    behind = private_host()
    try:
        limits.need_files(GUESTS_FILES, "Foxglove's viewers")
        taken = socket.create_server((HOST, port))
        server = foxglove.start_server(
            name="tandem",
            host=behind,
            port=0,
            context=context,
            capabilities=[Capability.Time],
            server_listener=_Listener(live),
            message_backlog_size=MESSAGES,
        )
    except Exception as error:  # noqa: BLE001  # the SDK raises untyped errors
        say(f"--foxglove: port {port} cannot be served: {error}", error=True)
        return 1
    Gate(taken, (behind, server.port), origins).open()
    say(f"ws://{HOST}:{taken.getsockname()[1]}")
    try:
        _serve(live, server, inbox)
    finally:
        server.stop()
    return 0


def _serve(live: Live, server: WebSocketServer, inbox: Inbox) -> None:
    running = True
    while running:
        try:
            inbox.next(JOURNALS_S)
        except Interrupted:
            running = False
        at = live.look(time.monotonic())
        if at is not None:
            server.broadcast_time(at)
