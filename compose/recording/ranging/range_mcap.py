"""Range recordings as MCAP files: messages in JSON, whose fields are the columns of the CSV files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import msgspec
from mcap.records import Channel, Message

from compose.errors import BadRecording
from compose.recording.ranging.mcap_records import EndOfStream, entries
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

    Raises OSError, and BadRecording, which names the message, or the byte.
    """
    builder = RecordingBuilder(path, anchors)
    with files.open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        try:
            for row, place in _rows(file, path, size, builder.unused):
                builder.add(row, place)
        except EndOfStream as error:
            raise BadRecording(
                f"{error}; --follow estimates what is before" if size else str(error)
            ) from None
    return builder.recording()


def rows_as_they_arrive(stream: BinaryIO, name: str) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield the rows of a stream and their places; it may end at any message.

    Raises BadRecording, which names the message, or the byte.
    """
    try:
        yield from _rows(stream, name, None, Counter())
    except EndOfStream:
        return


def _rows(
    file: BinaryIO, path: object, size: int | None, unused: Counter[str]
) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield all rows and their places; count the messages on other topics in `unused`."""
    topics: dict[int, str] = {}
    counts = dict.fromkeys(TOPICS, 0)
    for entry in entries(file, path, size):
        match entry:
            case Message(channel_id=channel, data=data):
                topic = topics.get(channel)
                if topic is None:
                    raise BadRecording(
                        f"{path}: there is a message of channel {channel}, and no such channel"
                    )
                if topic not in TOPICS:
                    unused[f"messages on {topic}"] += 1
                    continue
                counts[topic] += 1
                place = SourcePlace(f"{path}, {topic}", counts[topic], "message")
                yield _row(data, topic, place), place
            case Channel(id=number, topic=topic, message_encoding=encoding):
                topics[number] = topic
                if topic in TOPICS and encoding != "json":
                    raise BadRecording(f"{path}: {topic} is encoded as {encoding[:40]!a}, not as 'json'")
            case _:
                topics.clear()


def _row(data: bytes, topic: str, place: SourcePlace) -> AnyRow:
    try:
        row: AnyRow = documents.json_value(data, TOPICS[topic])
    except msgspec.ValidationError as error:
        raise BadRecording(f"{place}: {wrong_field(error)}") from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise BadRecording(f"{place}: it is not JSON: {error}") from None
    return row
