"""The channels and messages of MCAP files and streams, read in bounded memory."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader

from compose.errors import BadRecording

LARGEST_BYTES = 1 << 28
"""The largest record, and the largest chunk once it is decompressed; a million rows are 150 MB."""
EXPANSION, SMALL_BYTES = 1000, 1 << 22
"""The largest ratio of all decompressed chunks to the bytes of the file so far, beyond a small size.

JSON has 5 to 50. With zstd, 65 kB can hold 2 GB.
"""


class EndOfStream(BadRecording):
    """The file or stream ends before its end record."""


class _NoMore(EndOfFile):
    """The bytes end where a record could begin."""


class _Whole:
    """A file, a stream or the content of a chunk, of which only whole values are read.

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
            raise _NoMore if self._size == self.at and count == 1 else EndOfFile
        data, self._first = self._first + self._file.read(count - len(self._first)), b""
        self.at += len(data)
        if len(data) < count:
            raise EndOfFile
        return data


def entries(file: BinaryIO, path: object, size: int | None) -> Iterator[Channel | Message | None]:
    """Yield the channels and messages in `file`, which has `size` bytes; None for a stream.

    Files after each other, as `cat` joins them, are read one by one. None is yielded at the begin of each,
    in which earlier channels are not valid. Raises BadRecording, which names `path` and the byte, and
    EndOfStream.
    """
    source = _Whole(file, size)
    wrong = f"{path}: it is not a complete MCAP file: "
    if source.is_at_end():
        raise EndOfStream(f"{wrong}it is empty")
    try:
        while source.at == 0 or not source.is_at_end():
            yield None
            yield from _of_file(source)
    except InvalidMagic:
        raise BadRecording(f"{wrong}no MCAP begins or ends before byte {source.at}") from None
    except RecordLengthLimitExceeded as error:
        raise BadRecording(f"{path}: before byte {source.at}: {error}") from None
    except EndOfFile as error:
        begun = "" if isinstance(error, _NoMore) else "within what begins "
        raise EndOfStream(f"{wrong}it ends {begun}at byte {source.at}: it was cut off") from None
    except (McapError, struct.error, ValueError, OverflowError, RuntimeError, zstandard.ZstdError) as error:
        raise BadRecording(f"{wrong}before byte {source.at}: {error}") from None


def _of_file(source: _Whole) -> Iterator[Channel | Message]:
    """Yield the channels and messages of one file. Raises McapError and ValueError."""
    for record in _records(source):
        if isinstance(record, Channel | Message):
            yield record
        elif isinstance(record, Chunk):
            most = min(LARGEST_BYTES, SMALL_BYTES + EXPANSION * source.at - source.expanded)
            if record.uncompressed_size > most:
                raise ValueError(f"a chunk of {record.uncompressed_size} bytes, and at most {most} are read")
            source.expanded += record.uncompressed_size
            data = _decompressed(record)
            inside = _records(_Whole(BytesIO(data), len(data)), skip_magic=True)
            try:
                yield from (inner for inner in inside if isinstance(inner, Channel | Message))
            except _NoMore:
                continue
            except EndOfFile:
                raise ValueError("a record in a chunk is longer than the chunk") from None


def _records(source: _Whole, *, skip_magic: bool = False) -> Iterator[McapRecord]:
    reader = StreamReader(
        source,  # type: ignore[arg-type]  # only `read` is called
        skip_magic=skip_magic,
        emit_chunks=True,
        validate_crcs=True,
        record_size_limit=LARGEST_BYTES,
    )
    return reader.records


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
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a byte in a chunk is damaged: its CRC is another")
    return data
