"""`run.mcap`: the scenes of a recording.

Times are simulated times, beginning at 0. Equal recordings give equal bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any

import foxglove
import msgspec
from foxglove import Channel, Context, Schema
from foxglove.mcap import MCAPWriteOptions

from compose.recording.run_setup import RunSetup
from compose.view.foxglove.views import Views, nanoseconds
from compose.view.numbers import Numbers
from compose.view.scene import Scene

CHUNK_BYTES = 1 << 18
"""The size of a chunk. Trails of consecutive ticks are similar, so large chunks compress ten times better."""
NUMBERS = Schema(
    name="tandem.Numbers",
    encoding="jsonschema",
    data=msgspec.json.encode(msgspec.json.schema(Numbers)["$defs"]["Numbers"], order="sorted"),
)
"""The schema of the numbers of a robot, which are JSON objects. Not all viewers follow references."""
LAST_TIMESTAMP_S = 2**32
"""The largest time in s that Foxglove's timestamps can represent."""


class TooLong(ValueError):
    """A run that is too long for the format's timestamps."""


def mcap(setup: RunSetup, scenes: Sequence[Scene], check: Callable[[], object] = lambda: None) -> bytes:
    """Return the content of the file of a run, whose `scenes` are in the order of their ticks.

    Calls `check` in each tick, which may raise. Raises TooLong if the run is too long.
    """
    last = max([scene.tick for scene in scenes], default=0)
    if nanoseconds(setup, last) >= LAST_TIMESTAMP_S * 1_000_000_000:
        raise TooLong(
            f"the run lasts {last * setup.mission.period:g} s; MCAP can represent {LAST_TIMESTAMP_S} s"
        )
    context, file, views = Context(), BytesIO(), Views(setup)
    options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, compression_threads=0)
    with foxglove.open_mcap(file, context=context, writer_options=options):
        channels: dict[str, Channel] = {}
        for scene in scenes:
            at = nanoseconds(setup, scene.tick)
            for topic, message in (*([] if scene.tick else [views.standing()]), *views.of(scene)):
                if topic not in channels:
                    channels[topic] = _channel(topic, message, context)
                channels[topic].log(message.encode(), log_time=at)
            check()
    return file.getvalue()


def _channel(topic: str, message: Any, context: Context) -> Channel:
    """Return the channel of a topic of scenes, which has messages like `message`."""
    if isinstance(message, Numbers):
        return Channel(topic, message_encoding="json", schema=NUMBERS, context=context)
    return Channel(topic, message_encoding="protobuf", schema=message.get_schema(), context=context)
