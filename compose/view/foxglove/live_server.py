"""A run served to Foxglove's viewers while it is played, by a process of its own that reads its journals.

    python -m compose.view.foxglove.live_server PORT ORIGIN,... FOLDER ROBOT ...

The mission knows nothing of it. What cannot be shown as fast as it happens is left out: the frames of every
tick are told, but of a backlog only the latest tick is seen. It ends when its standard input does.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import foxglove
from foxglove import Context
from foxglove.websocket import Capability, ChannelView, Client, ServerListener, WebSocketServer

from compose.launch.signals import stop_with_launcher
from compose.recording.frames import Telling
from compose.recording.run import WORLD_JOURNAL, agent_journal
from compose.view.cast import Stage
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
LOOK_S = 0.05
"""how often the journals are looked at"""
WAIT_S = 0.5
"""for what is missing of a tick, once the next is there"""
SETTLED_S = 1.0
"""after which who has asked for a channel surely listens"""
BACKLOG = 8
"""ticks that are shown one by one; of more, the latest"""
MESSAGES = 1 << 14
"""that a slow viewer may be behind, before it misses the oldest"""
NICE = 10
"""how much the mission goes first"""


class Live:
    """A run whose record grows in a folder, on channels."""

    def __init__(self, folder: Path, channels: Channels) -> None:
        self.asked = False
        """whether somebody has come who has not seen what stands"""
        self._folder = folder
        self._channels = channels
        self._journals = Journals(folder)
        self._tails: dict[str, tuple[Tail, Telling]] = {}
        self._views: Views | None = None
        self._next = 0
        """the tick that is to be shown next"""
        self._once_more: float | None = None
        """when what stands is to be told again: whoever has just asked may not have listened yet"""
        self._since: dict[int, float] = {}
        """when those from there on were first there to be shown"""

    def look(self, now: float) -> int | None:
        """Tell what has come since the last time; what time it is in the run, in ns, once it has begun."""
        with suppress(OSError):
            self._journals.read()
        stage = self._journals.stage
        if stage is None or stage.seed is None:  # the world has not told yet
            return None
        if self._views is None:
            self._views = Views(stage)
        self._tell_frames(stage)
        ready = self._ready(stage, now)
        seen = ready[0 if len(ready) <= BACKLOG else -1].tick if ready else 0
        for scene in ready:
            visible = scene.tick >= seen and self._channels.watched
            for view in self._views.of(scene) if visible else self._views.passing(scene):
                self._channels.view(*view, nanoseconds(stage, scene.tick))
        if ready:
            self._next = ready[-1].tick + 1
        due = self._once_more is not None and now >= self._once_more
        if self.asked or due:
            self._once_more = now + SETTLED_S if self.asked else None
            self.asked = False
            self._channels.again()
            for view in (self._views.standing(), *self._views.again()):
                self._channels.view(*view, nanoseconds(stage, max(0, self._next - 1)))
        return nanoseconds(stage, self._next)

    def _tell_frames(self, stage: Stage) -> None:
        for name in (WORLD_JOURNAL, *map(agent_journal, stage.ids)):
            tail, telling = self._tails.setdefault(name, (Tail(self._folder / name), Telling(name)))
            with suppress(OSError, CorruptJournal):
                for one in telling.of(tail.news()):
                    self._channels.frame(one, nanoseconds(stage, one.tick))

    def _ready(self, stage: Stage, now: float) -> list[Scene]:
        """Scenes of which all is known, or as much as will be: not before the world has gone on."""
        known = self._journals.known
        last = known.last if known.end is not None else known.last - 1
        there = scenes(stage, known, self._next, last)
        for scene in there:
            self._since.setdefault(scene.tick, now)
        found = []
        for scene in there:
            whole = all(player.held is not None and player.pose is not None for player in scene.players)
            if not whole and now - self._since[scene.tick] < WAIT_S:
                break
            found.append(scene)
        for scene in found:
            del self._since[scene.tick]
        return found


class _Door(ServerListener):
    """Notes who comes."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002
        self._live.asked = True


def main(port: int, origins: Sequence[str], folder: Path, robots: Sequence[str]) -> int:
    """Serve until standard input ends. 1 if the port cannot be had.

    Channels are there before anyone can come: under load the SDK refuses who asks for one that is new.
    Web pages of `origins` may look, too.
    """
    os.nice(NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launcher's to handle
    inbox = Inbox("tandem run --foxglove")
    stop_with_launcher(inbox)
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
            server_listener=_Door(live),
            message_backlog_size=MESSAGES,
        )
    except Exception as error:  # noqa: BLE001  # the SDK's own, of no type of its own
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
    going_on = True
    while going_on:
        try:
            inbox.next(LOOK_S)
        except Interrupted:
            going_on = False
        at = live.look(time.monotonic())
        if at is not None:
            server.broadcast_time(at)


if __name__ == "__main__":
    _, where, pages, recording, *ids = sys.argv
    sys.exit(main(int(where), [one for one in pages.split(",") if one], Path(recording), ids))
