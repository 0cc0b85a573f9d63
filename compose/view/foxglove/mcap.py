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
from compose.view.foxglove.views import Views, nanoseconds
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


def mcap(
    setup: RunSetup,
    frames: Sequence[Journaled],
    scenes: Sequence[Scene],
    check: Callable[[], object] = lambda: None,
) -> bytes:
    """Return the content of the file of a run: tick by tick, its journaled `frames`, then the scene.

    The frames and the `scenes` are in the order of their ticks. Calls `check` in each tick, which may raise.
    Raises TooLong if the run is too long.
    """
    last = max([scene.tick for scene in scenes], default=0)
    if nanoseconds(setup, last) >= LAST_TIMESTAMP_S * 1_000_000_000:
        raise TooLong(
            f"the run lasts {last * setup.mission.period:g} s; MCAP can represent {LAST_TIMESTAMP_S} s"
        )
    context, file, views = Context(), BytesIO(), Views(setup)
    options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, compression_threads=0)
    with foxglove.open_mcap(file, context=context, writer_options=options):
        shown: dict[str, Channel] = {}
        journaled: dict[tuple[str, type[msgspec.Struct]], Channel] = {}
        both: Iterable[Journaled | Scene] = (*frames, *scenes)
        for one in sorted(both, key=lambda one: one.tick):
            at = nanoseconds(setup, one.tick)
            if isinstance(one, Journaled):
                of = one.journal, type(one.message)
                if of not in journaled:
                    journaled[of] = _of_frames(*of, context)
                journaled[of].log(one.body, log_time=at)
                continue
            for topic, message in (*([] if one.tick else [views.standing()]), *views.of(one)):
                if topic not in shown:
                    shown[topic] = _of_scenes(topic, message, context)
                shown[topic].log(message.encode(), log_time=at)
            check()
    return file.getvalue()


def _of_frames(journal: str, kind: type[msgspec.Struct], context: Context) -> Channel:
    """Return the channel of the messages of type `kind` in a journal, which has their msgpack bodies."""
    return Channel(
        f"/journal/{journal.removesuffix('.journal')}/{kind_of(kind)}",
        message_encoding="msgpack",
        schema=Schema(name=f"tandem.{kind.__name__}", encoding="jsonschema", data=schema(kind)),
        context=context,
        metadata={"version": str(VERSION)},
    )


def _of_scenes(topic: str, message: Any, context: Context) -> Channel:
    """Return the channel of a topic of scenes, which has messages like `message`."""
    if isinstance(message, Numbers):
        return Channel(topic, message_encoding="json", schema=NUMBERS, context=context)
    return Channel(topic, message_encoding="protobuf", schema=message.get_schema(), context=context)
