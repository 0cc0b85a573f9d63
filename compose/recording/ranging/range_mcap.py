"""Range recordings as MCAP files: messages in JSON, whose fields are the columns of the CSV files."""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import msgspec
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from compose.errors import BadRecording
from compose.recording.ranging.range_csv import TABLES
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    AnyRow,
    RecordingBuilder,
    SourcePlace,
    wrong_field,
)
from protocol import documents, files

TOPICS = {f"/{name}": kind for name, kind in TABLES.items()}
"""The rows of each topic. Other topics are not used."""


def read_mcap(path: Path, anchors: Sequence[AnchorRow] = ()) -> RangeRecording:
    """Return the recording in the file `path`, with `anchors` in place of those of the same names there.

    Raises OSError, and BadRecording, which names the message.
    """
    with files.open_file(path) as file:
        return _read(file, path, RecordingBuilder(path, anchors))


def _read(file: BinaryIO, path: Path, builder: RecordingBuilder) -> RangeRecording:
    size = os.fstat(file.fileno()).st_size
    for row, place in _rows(file, path, size, builder.unused):
        builder.add(row, place)
    return builder.recording()


def rows_as_they_arrive(stream: BinaryIO, name: str) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield the rows of a stream and their places; it may end at any message.

    Raises BadRecording, which names the message.
    """
    try:
        yield from _rows(stream, name, LARGEST_RECORD_BYTES, Counter())
    except EndOfStream:
        return


LARGEST_RECORD_BYTES = 1 << 26
"""The largest record that is taken from a stream, in bytes."""


class EndOfStream(BadRecording):
    """The file or stream ends before its end record."""


def _rows(
    file: BinaryIO, path: object, largest: int, unused: Counter[str]
) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield all rows and their places; count the messages on other topics in `unused`."""
    topics: dict[int, str] = {}
    counts = dict.fromkeys(TOPICS, 0)
    try:
        for record in StreamReader(file, validate_crcs=True, record_size_limit=largest).records:
            match record:
                case Channel(id=number, topic=topic, message_encoding=encoding):
                    topics[number] = topic
                    if topic in TOPICS and encoding != "json":
                        raise BadRecording(f"{path}: {topic} is encoded as {encoding!a}, not as 'json'")
                case Message(channel_id=number, data=data):
                    topic = topics[number]
                    if topic not in TOPICS:
                        unused[f"messages on {topic}"] += 1
                        continue
                    counts[topic] += 1
                    place = SourcePlace(f"{path}, {topic}", counts[topic], "message")
                    yield _row(data, topic, place), place
    except EndOfFile as error:
        raise EndOfStream(f"{path}: it is not a complete MCAP file: {error}") from None
    except (McapError, zstandard.ZstdError, struct.error, KeyError, ValueError, RuntimeError) as error:
        raise BadRecording(f"{path}: it is not a complete MCAP file: {error}") from None


def _row(data: bytes, topic: str, place: SourcePlace) -> AnyRow:
    try:
        row: AnyRow = documents.json_value(data, TOPICS[topic])
    except msgspec.ValidationError as error:
        raise BadRecording(f"{place}: {wrong_field(error)}") from None
    except msgspec.DecodeError as error:
        raise BadRecording(f"{place}: it is not JSON: {error}") from None
    return row
