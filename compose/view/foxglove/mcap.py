"""`run.mcap`: every journaled frame of a recording, and its scenes.

Times are simulated times, beginning at 0. Equal recordings give equal bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from io import BytesIO
from typing import Any

import foxglove
import msgspec
from foxglove import Channel, Context, Schema
from foxglove.mcap import MCAPWriteOptions

from compose.recording.frames import Journaled, kind_of
from compose.recording.run_setup import RunSetup
from compose.view.foxglove.schemas import object_schema, schema
from compose.view.foxglove.views import Views, nanoseconds, topics
from compose.view.numbers import Numbers
from compose.view.scene import Scene
from protocol.wire import VERSION

CHUNK_BYTES = 1 << 18
"""The size of a chunk. Trails of consecutive ticks are similar, so large chunks compress ten times better."""
NUMBERS = Schema(name="tandem.Numbers", encoding="jsonschema", data=object_schema(Numbers))
"""The schema of the numbers of a robot, which are JSON objects."""
LAST_TIMESTAMP_S = 2**32
"""The largest time in s that Foxglove's timestamps can represent."""


class TooLong(ValueError):
    """A run that is too long for the format's timestamps."""


class Channels:
    """The channels of a run in a Foxglove context, created on first use."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._frames: dict[tuple[str, type], Channel] = {}
        self._views: dict[str, Channel] = {}

    def frame(self, one: Journaled, at: int) -> None:
        """Publish the msgpack body of a journaled frame on the channel of its journal and message type.

        `at` is the simulated time in ns.
        """
        self._of_frames(one.journal, type(one.message)).log(one.body, log_time=at)

    def _of_frames(self, journal: str, kind: type[msgspec.Struct]) -> Channel:
        """Return the channel of a journal and a message type, created if needed."""
        channel = self._frames.get((journal, kind))
        if channel is None:
            described = Schema(name=f"tandem.{kind.__name__}", encoding="jsonschema", data=schema(kind))
            channel = self._frames[journal, kind] = Channel(
                f"/journal/{journal.removesuffix('.journal')}/{kind_of(kind)}",
                message_encoding="msgpack",
                schema=described,
                context=self._context,
                metadata={"version": str(VERSION)},
            )
        return channel

    def open_views(self, robots: Iterable[str]) -> None:
        """Create all channels for scenes, including those that stay empty."""
        for topic, kind in topics(robots).items():
            numbers = kind is Numbers
            self._views[topic] = Channel(
                topic,
                message_encoding="json" if numbers else "protobuf",
                schema=NUMBERS if numbers else kind.get_schema(),
                context=self._context,
            )

    def view(self, topic: str, message: Any, at: int) -> None:
        """Publish a message of a scene on `topic`; `at` is the simulated time in ns."""
        self._views[topic].log(message.encode(), log_time=at)

    def close(self) -> None:
        """Close all channels."""
        for channel in (*self._frames.values(), *self._views.values()):
            channel.close()


def mcap(
    setup: RunSetup,
    frames: Sequence[Journaled],
    scenes: Sequence[Scene],
    check: Callable[[], object] = lambda: None,
) -> bytes:
    """Return the journaled `frames` and the `scenes` of a run, both in the order of their ticks, as a file.

    Calls `check` in each tick, which may raise. Raises TooLong if the run is too long.
    """
    last = max([scene.tick for scene in scenes], default=0)
    if nanoseconds(setup, last) >= LAST_TIMESTAMP_S * 1_000_000_000:
        raise TooLong(
            f"the run lasts {last * setup.mission.period:g} s; MCAP can represent {LAST_TIMESTAMP_S} s"
        )
    context = Context()
    channels = Channels(context)
    file = BytesIO()
    options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, compression_threads=0)
    try:
        with foxglove.open_mcap(file, context=context, writer_options=options):
            _publish(setup, frames, scenes, channels, check)
    finally:
        channels.close()
    return file.getvalue()


def _publish(
    setup: RunSetup,
    frames: Sequence[Journaled],
    scenes: Sequence[Scene],
    channels: Channels,
    check: Callable[[], object],
) -> None:
    """Publish everything, tick by tick: the journaled frames, then the scene."""
    views = Views(setup)
    channels.open_views(setup.ids)
    both: Iterable[Journaled | Scene] = (*frames, *scenes)
    tick, at = 0, nanoseconds(setup, 0)
    for one in sorted(both, key=lambda one: one.tick):
        if one.tick != tick:
            tick, at = one.tick, nanoseconds(setup, one.tick)
        if isinstance(one, Journaled):
            channels.frame(one, at)
            continue
        if one.tick == 0:
            channels.view(*views.standing(), at)
        for shown in views.of(one):
            channels.view(*shown, at)
        check()
