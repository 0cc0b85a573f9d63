"""The checks of `mcap doctor`, applied to the records that the official reader parses.

`mcap doctor` is a Go program that is not available everywhere. These checks follow its source.
"""

from __future__ import annotations

import io
from pathlib import Path

from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.well_known import Profile


def complaints(path: Path) -> list[str]:
    """Return the errors and warnings on the file. Raises the reader's error if a CRC or record is damaged."""
    data = path.read_bytes()
    records = list(StreamReader(io.BytesIO(data), emit_chunks=True, validate_crcs=True).records)
    end = next(i for i, record in enumerate(records) if isinstance(record, DataEnd))
    found: list[str] = []
    header, footer = records[0], records[-1]
    if (
        not isinstance(header, Header)
        or not header.library
        or header.profile not in ("", Profile.ROS1, Profile.ROS2)
    ):
        found.append(f"header: {header}")
    if not isinstance(footer, Footer):
        found.append("no footer")
    examined = _Examined(found)
    for record in records[:end]:
        examined.take(record)
    examined.summary(records[end:])
    return found


class _Examined:
    """The records of the data section that have been examined."""

    def __init__(self, found: list[str]) -> None:
        self.found = found
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        self.times: list[int] = []
        self.chunks: list[tuple[int, int]] = []

    def take(self, record: McapRecord) -> None:
        match record:
            case Schema():
                self._schema(record)
            case Channel():
                self._channel(record)
            case Message():
                self._message(record)
            case Chunk():
                before = len(self.times)
                for inner in breakup_chunk(record, validate_crc=True):
                    self.take(inner)
                times = self.times[before:]
                self.chunks.append((record.message_start_time, record.message_end_time))
                if times and (min(times), max(times)) != self.chunks[-1]:
                    self.found.append(f"a chunk of {self.chunks[-1]} ns holds messages of other times")

    def _schema(self, record: Schema) -> None:
        if record.id == 0 or not record.encoding or not record.name or not record.data:
            self.found.append(f"schema {record.id} is empty")
        if record.id in self.schemas:
            self.found.append(f"schema {record.id} occurs twice in the data section")
        self.schemas[record.id] = record

    def _channel(self, record: Channel) -> None:
        if record.id in self.channels:
            self.found.append(f"channel {record.id} occurs twice in the data section")
        if record.schema_id not in self.schemas:
            self.found.append(f"channel {record.id} has no schema")
        self.channels[record.id] = record

    def _message(self, record: Message) -> None:
        if record.channel_id not in self.channels:
            self.found.append(f"a message before its channel {record.channel_id}")
        if self.times and record.log_time < self.times[-1]:
            self.found.append(f"a message of {record.log_time} ns after one of {self.times[-1]} ns")
        self.times.append(record.log_time)
        self.counts[record.channel_id] = self.counts.get(record.channel_id, 0) + 1

    def summary(self, records: list[McapRecord]) -> None:
        """Check that the summary section describes the data section completely, and each item once."""
        if {one.id: one for one in records if isinstance(one, Schema)} != self.schemas:
            self.found.append("the summary has other schemas")
        if {one.id: one for one in records if isinstance(one, Channel)} != self.channels:
            self.found.append("the summary has other channels")
        indexes = [one for one in records if isinstance(one, ChunkIndex)]
        if [(one.message_start_time, one.message_end_time) for one in indexes] != self.chunks:
            self.found.append("the chunk indexes are not those of the chunks")
        statistics = [one for one in records if isinstance(one, Statistics)]
        claimed = [
            (one.message_count, one.channel_count, one.schema_count, one.chunk_count)
            + (one.message_start_time, one.message_end_time, one.channel_message_counts)
            for one in statistics
        ]
        there = (len(self.times), len(self.channels), len(self.schemas), len(self.chunks))
        if claimed != [(*there, min(self.times), max(self.times), self.counts)]:
            self.found.append(f"the statistics are {claimed}, the records are {there}")
