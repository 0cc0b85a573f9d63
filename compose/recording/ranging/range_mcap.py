"""Range recordings as MCAP files: messages in JSON, whose fields are the columns of the CSV files.

Files and streams are read record by record, in bounded memory.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import msgspec
import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from compose.errors import BadRecording
from compose.recording.ranging.recording_builder import RecordingBuilder
from compose.recording.ranging.recording_rows import TABLES, AnyRow, SourcePlace, wrong_field
from protocol import documents, files

TOPICS = {f"/{name}": kind for name, kind in TABLES.items()}
"""The rows of each topic. Other topics are not used."""

LARGEST_BYTES = 1 << 28
"""The largest record, and the largest chunk once it is decompressed; a million rows are 150 MB."""
EXPANSION, SMALL_BYTES = 1000, 1 << 22
"""The largest ratio of all decompressed chunks to the bytes of the file so far, beyond a small size.

JSON has 5 to 50. With zstd, 65 kB can hold 2 GB.
"""


class EndOfStream(BadRecording):
    """The file or stream ends before its end record."""


def add_mcap(builder: RecordingBuilder, path: Path) -> None:
    """Add the rows in the file `path`.

    Raises OSError, and BadRecording, which names the message, or the byte.
    """
    with files.open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        try:
            for row, place in _rows(_Whole(file, size), path, builder.unused):
                builder.add(row, place)
        except EndOfStream as error:
            raise BadRecording(
                f"{error}; --follow estimates what is before" if size else str(error)
            ) from None


def rows_as_they_arrive(stream: BinaryIO, name: str) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield the rows of a stream and their places; it may end at any message.

    Raises BadRecording, which names the message, or the byte.
    """
    try:
        yield from _rows(_Whole(stream, None), name, Counter())
    except EndOfStream:
        return


def _rows(source: _Whole, path: object, unused: Counter[str]) -> Iterator[tuple[AnyRow, SourcePlace]]:
    """Yield all rows and their places; count the messages on other topics in `unused`."""
    topics: dict[int, str] = {}
    counts = dict.fromkeys(TOPICS, 0)
    for entry in _entries(source, path):
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
            case None:
                topics.clear()


def _row(data: bytes, topic: str, place: SourcePlace) -> AnyRow:
    try:
        row: AnyRow = documents.json_value(data, TOPICS[topic])
    except msgspec.ValidationError as error:
        raise BadRecording(f"{place}: {wrong_field(error)}") from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise BadRecording(f"{place}: it is not JSON: {error}") from None
    return row


# --- the records of a file ----------------------------------------------------------------------------------


class _Whole:
    """A file of `size` bytes, or a stream without one, of which only whole values are read.

    The library takes what is there for the whole value, and allocates as much as a length says.
    """

    def __init__(self, file: BinaryIO, size: int | None) -> None:
        self._file, self._size, self._first = file, size, b""
        self.at = 0
        """The number of bytes that were read."""
        self.expanded = 0
        """The number of bytes of all chunks in it, decompressed: of files after each other, those of all."""

    def is_at_end(self) -> bool:
        """Return whether nothing is left."""
        self._first = self._file.read(1)
        return not self._first

    def read(self, count: int) -> bytes:
        """Return the next bytes. Raises EndOfFile if there are fewer than `count`."""
        if self._size is not None and count > self._size - self.at:
            raise EndOfFile
        data, self._first = self._first + self._file.read(count - len(self._first)), b""
        self.at += len(data)
        if len(data) < count:
            raise EndOfFile
        return data


def _entries(source: _Whole, path: object) -> Iterator[McapRecord | None]:
    """Yield the records of a file, and those in its chunks.

    Files after each other, as `cat` joins them, are read one by one. None is yielded at the begin of each,
    in which earlier channels are not valid. Raises BadRecording, which names `path` and the byte, and
    EndOfStream.
    """
    wrong = f"{path}: it is not a complete MCAP file: "
    if source.is_at_end():
        raise EndOfStream(f"{wrong}it is empty")
    try:
        while source.at == 0 or not source.is_at_end():
            yield None
            reader = StreamReader(
                source,  # type: ignore[arg-type]  # only `read` is called
                emit_chunks=True,
                validate_crcs=True,
                record_size_limit=LARGEST_BYTES,
            )
            for record in reader.records:
                yield from _inside(record, source) if isinstance(record, Chunk) else (record,)
    except InvalidMagic:
        raise BadRecording(f"{wrong}no MCAP begins or ends before byte {source.at}") from None
    except RecordLengthLimitExceeded as error:
        raise BadRecording(f"{path}: before byte {source.at}: {error}") from None
    except EndOfFile:
        raise EndOfStream(f"{wrong}it was cut off after byte {source.at}") from None
    except (McapError, struct.error, ValueError, OverflowError, RuntimeError, zstandard.ZstdError) as error:
        raise BadRecording(f"{wrong}before byte {source.at}: {error}") from None


def _inside(chunk: Chunk, source: _Whole) -> list[McapRecord]:
    """Return the records in a chunk. Raises ValueError and ZstdError."""
    most = min(LARGEST_BYTES, SMALL_BYTES + EXPANSION * source.at - source.expanded)
    if chunk.uncompressed_size > most:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes, and at most {most} are read")
    source.expanded += chunk.uncompressed_size
    whole = replace(chunk, compression="", data=_decompressed(chunk))
    try:
        return breakup_chunk(whole, validate_crc=True)
    except EndOfFile:
        raise ValueError("a record in a chunk is longer than the chunk") from None


def _decompressed(chunk: Chunk) -> bytes:
    """Return the content of a chunk, at most as large as it says. Raises ValueError and ZstdError."""
    size = chunk.uncompressed_size
    match chunk.compression:
        case "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
        case "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        case "":
            data = chunk.data
        case other:
            raise ValueError(f"a chunk is compressed with {other[:40]!a}, and only zstd and lz4 are known")
    if len(data) != size:
        raise ValueError(f"a chunk says that it holds {size} bytes, and does not")
    return data
