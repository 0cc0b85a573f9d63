"""Range recordings as MCAP files: messages in JSON, whose fields are the columns of the CSV files."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import msgspec
import zstandard
from mcap.exceptions import McapError
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
from protocol import files

TOPICS = {f"/{name}": kind for name, kind in TABLES.items()}
"""The rows of each topic. Other topics are not used."""


def read_mcap(path: Path, anchors: Sequence[AnchorRow] = ()) -> RangeRecording:
    """Return the recording in the file `path`, with `anchors` in place of those of the same names there.

    Raises OSError, and BadRecording, which names the message.
    """
    with files.open_file(path) as file:
        return _read(file, path, RecordingBuilder(path, anchors))


def _read(file: BinaryIO, path: Path, builder: RecordingBuilder) -> RangeRecording:
    topics: dict[int, str] = {}
    counts = dict.fromkeys(TOPICS, 0)
    try:
        size = os.fstat(file.fileno()).st_size
        for record in StreamReader(file, validate_crcs=True, record_size_limit=size).records:
            match record:
                case Channel(id=number, topic=topic, message_encoding=encoding):
                    topics[number] = topic
                    if topic in TOPICS and encoding != "json":
                        raise BadRecording(f"{path}: {topic} is encoded as {encoding!a}, not as 'json'")
                case Message(channel_id=number, data=data):
                    topic = topics[number]
                    if topic not in TOPICS:
                        builder.unused[f"messages on {topic}"] += 1
                        continue
                    counts[topic] += 1
                    place = SourcePlace(f"{path}, {topic}", counts[topic], "message")
                    builder.add(_row(data, topic, place), place)
    except (McapError, zstandard.ZstdError, struct.error, KeyError, ValueError, RuntimeError) as error:
        raise BadRecording(f"{path}: it is not a complete MCAP file: {error}") from None
    return builder.recording()


def _row(data: bytes, topic: str, place: SourcePlace) -> AnyRow:
    try:
        row: AnyRow = msgspec.json.decode(data, type=TOPICS[topic])
    except msgspec.ValidationError as error:
        raise BadRecording(f"{place}: {wrong_field(error)}") from None
    except msgspec.DecodeError as error:
        raise BadRecording(f"{place}: it is not JSON: {error}") from None
    return row
