"""`run.mcap`: every journaled frame of a record, and what there is to see of it.

Times are of the simulation, from 0 on. The same record gives the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from heapq import merge
from io import RawIOBase
from operator import itemgetter
from pathlib import Path
from typing import Any, get_args

import foxglove
import msgspec
from foxglove import Channel, Context, Schema
from foxglove.mcap import MCAPWriteOptions

from compose.recording.frames import Journaled, OfWorld, in_time, kind_of
from compose.recording.run import WORLD_JOURNAL, JournalFile, agent_journal
from compose.view.foxglove.schemas import schema
from compose.view.foxglove.views import Views, nanoseconds, topics
from compose.view.recorded import Performance
from compose.view.scene import Scene
from protocol.messages import OfRobot
from protocol.wire import VERSION

CHUNK_BYTES = 1 << 18
"""trails of ticks in a row are much alike: a chunk of many is a tenth of many chunks"""
LONGEST_S = 2**32
"""what Foxglove's timestamps can tell"""


class TooLong(ValueError):
    """A run of more time than the format can tell."""


class Channels:
    """Those of a run in a context, made as something is to be told on them."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._frames: dict[tuple[str, type], Channel] = {}
        self._latest: dict[Channel, tuple[bytes, int]] = {}
        self._views: dict[str, Channel] = {}

    def open(self, robots: Sequence[str]) -> None:
        """All that there can be in a run of these, so that none is added once somebody looks."""
        for name, kinds in {
            WORLD_JOURNAL: OfWorld,
            **{agent_journal(one): OfRobot for one in robots},
        }.items():
            for kind in get_args(kinds):
                self._of_frames(name, kind)
        self.open_views(robots)

    def frame(self, one: Journaled, at: int) -> None:
        """A journaled frame: its body, msgpack, on a channel of its journal and kind."""
        channel = self._of_frames(one.journal, type(one.message))
        channel.log(one.body, log_time=at)
        self._latest[channel] = (one.body, at)

    def again(self) -> None:
        """The latest journaled frame on each channel, for who has come since."""
        for channel, (body, at) in self._latest.items():
            channel.log(body, log_time=at)

    def _of_frames(self, journal: str, kind: type[msgspec.Struct]) -> Channel:
        """That one, made if there is none yet."""
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
        """All that there will be to see, whether or not anything is told of it."""
        for topic, kind in topics(robots).items():
            if topic not in self._views:
                self._views[topic] = Channel(
                    topic, message_encoding="protobuf", schema=kind.get_schema(), context=self._context
                )

    def view(self, topic: str, message: Any, at: int) -> None:
        """Something to be seen."""
        self._views[topic].log(message.encode(), log_time=at)

    @property
    def watched(self) -> bool:
        """Whether there is anyone to see anything."""
        return any(channel.has_sinks() for channel in self._views.values())

    def close(self) -> None:
        """Nothing more is told on them."""
        for channel in (*self._frames.values(), *self._views.values()):
            channel.close()


def write_mcap(
    books: Mapping[str, JournalFile], run: Performance, path: Path, check: Callable[[], object] = lambda: None
) -> int:
    """Write `path` anew; how many frames are in it. Calls `check` in each tick, which may raise.

    Raises OSError if it cannot be written, TooLong, CorruptJournal.
    """
    last = max([scene.tick for scene in run.scenes], default=0)
    if nanoseconds(run.stage, last) >= LONGEST_S * 1_000_000_000:
        raise TooLong(f"the run lasts {last * run.stage.mission.period:g} s; MCAP can tell {LONGEST_S} s")
    context = Context()
    channels = Channels(context)
    try:
        with path.open("wb", buffering=0) as file:
            kept = _Kept(file)
            options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, compression_threads=0)
            with foxglove.open_mcap(kept, context=context, writer_options=options):
                count = _tell(books, run, channels, [kept.check, check])
            kept.check()
    finally:
        channels.close()
    return count


def _tell(
    books: Mapping[str, JournalFile],
    run: Performance,
    channels: Channels,
    checks: Sequence[Callable[[], object]],
) -> int:
    """Everything, tick by tick: first the frames, then what there is to see."""
    views = Views(run.stage)
    channels.open_views(run.stage.ids)
    count = 0
    for tick, one in _by_tick(books, run):
        at = nanoseconds(run.stage, tick)
        if isinstance(one, Journaled):
            channels.frame(one, at)
            count += 1
            continue
        if tick == 0:
            channels.view(*views.standing(), at)
        for shown in views.of(one):
            channels.view(*shown, at)
        for check in checks:
            check()
    return count


def _by_tick(books: Mapping[str, JournalFile], run: Performance) -> Iterator[tuple[int, Journaled | Scene]]:
    frames: Iterable[tuple[int, int, Journaled | Scene]] = ((one.tick, 0, one) for one in in_time(books))
    scenes = ((scene.tick, 1, scene) for scene in run.scenes)
    for tick, _, one in merge(frames, scenes, key=itemgetter(0, 1)):
        yield tick, one


class _Kept:
    """A file whose first error is kept. From then on it seems to take what it is given, as if it had room.

    The writer would say every time that it cannot, and does not survive that places are not as it left them.
    """

    def __init__(self, file: RawIOBase) -> None:
        self._file = file
        self._error: OSError | None = None
        self._at = self._end = 0

    def check(self) -> None:
        """Raises OSError if something could not be written."""
        if self._error is not None:
            raise self._error

    def write(self, data: bytes | bytearray) -> int:
        rest = memoryview(data)
        while rest and self._error is None:
            try:
                rest = rest[self._file.write(rest) or 0 :]
            except OSError as error:
                self._error = error
        self._at += len(data)
        self._end = max(self._end, self._at)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end}[whence]
        if self._error is None:
            self._file.seek(self._at)
        return self._at

    def flush(self) -> None:
        """Nothing waits."""
