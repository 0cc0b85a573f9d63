"""The channels and messages of MCAP files and streams, read in bounded memory.

The library `mcap` allocates as many bytes as a length in the file says, and skips kinds of records that it
does not know.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from enum import IntEnum
from io import BytesIO
from typing import BinaryIO, NamedTuple, TypeVar

import lz4.frame
import zstandard

from compose.errors import BadRecording

MAGIC = b"\x89MCAP0\r\n"
"""The first and the last bytes of a file."""
LARGEST_RECORD_BYTES = 1 << 26
"""The largest record that is decoded. Others, such as attachments, are passed over in pieces."""
LARGEST_CHUNK_BYTES = 1 << 28
"""The largest chunk that is decompressed. Recorders write 1 to 4 MB; a million rows are 150 MB."""
EXPANSION, SMALL_BYTES = 1000, 1 << 22
"""The largest ratio of all decompressed chunks to the bytes of the file so far, beyond a small size.

JSON has 5 to 50. With zstd, 65 kB can hold 2 GB.
"""
MCAP_PIECE_BYTES = 1 << 20
"""The number of bytes that are passed over at once."""


class Kind(IntEnum):
    """The kinds of records. Those from 0x80 on are private, and are passed over."""

    Header = 0x01
    Footer = 0x02
    Schema = 0x03
    Channel = 0x04
    Message = 0x05
    Chunk = 0x06
    MessageIndex = 0x07
    ChunkIndex = 0x08
    Attachment = 0x09
    AttachmentIndex = 0x0A
    Statistics = 0x0B
    Metadata = 0x0C
    MetadataIndex = 0x0D
    SummaryOffset = 0x0E
    DataEnd = 0x0F
    Private = 0x80


IN_CHUNKS = (Kind.Schema, Kind.Channel, Kind.Message, Kind.Private)
DECODED = (Kind.Channel, Kind.Message, Kind.Chunk, Kind.DataEnd)


class EndOfStream(BadRecording):
    """The file or stream ends before its end record."""


class Begin(NamedTuple):
    """The begin of a file. Channels of files before it are not valid in it."""


class Channel(NamedTuple):
    """A topic, and the encoding of its messages."""

    id: int
    topic: str
    encoding: str


class RawMessage(NamedTuple):
    """The content of a message, and the id of its channel."""

    channel: int
    data: bytes


class _Chunk(NamedTuple):
    size: int
    crc: int
    compression: str
    data: bytes


def entries(file: BinaryIO, path: object, size: int | None) -> Iterator[Begin | Channel | RawMessage]:
    """Yield the channels and messages in `file`, which has `size` bytes; None for a stream.

    Files after each other, as `cat` joins them, are read one by one. Raises BadRecording, which names `path`
    and the byte, and EndOfStream.
    """
    source = _Source(file, path, size)
    while magic := source.upto(len(MAGIC)):
        if magic != MAGIC:
            raise source.wrong(f"no MCAP file begins at byte {source.at - len(magic)}")
        source.crc = zlib.crc32(MAGIC)
        yield Begin()
        yield from _of_file(source)
    if not source.at:
        raise source.wrong("it is empty", EndOfStream)


def _of_file(source: _Source) -> Iterator[Channel | RawMessage]:
    """Yield the channels and messages up to the end of one file, after its first magic bytes."""
    expanded, crc = 0, source.crc
    while kind := source.next():
        match kind:
            case Kind.Channel:
                yield source.decoded(_channel, source.content)
            case Kind.Message:
                yield source.decoded(_message, source.content)
            case Kind.Chunk:
                chunk = source.decoded(_chunk, source.content)
                most = min(LARGEST_CHUNK_BYTES, SMALL_BYTES + EXPANSION * source.at - expanded)
                if chunk.size > most:
                    says = f"says that it holds {chunk.size} bytes, and at most {most} are read"
                    raise BadRecording(f"{source.path}: {source.place} {says}")
                expanded += chunk.size
                yield from _of_chunk(source.decoded(_decompressed, chunk), source)
            case Kind.DataEnd:
                if source.decoded(U32.unpack_from, source.content)[0] not in (0, crc):
                    raise source.wrong(f"a byte before {source.place} is damaged: its CRC is another")
            case Kind.Footer:
                if source.upto(len(MAGIC)) != MAGIC:
                    raise source.wrong(f"it ends within the bytes after {source.place}", EndOfStream)
                return
        crc = source.crc
    raise source.wrong(f"it ends at byte {source.at} without a Footer: it was cut off", EndOfStream)


def _of_chunk(data: bytes, source: _Source) -> Iterator[Channel | RawMessage]:
    inner = _Source(BytesIO(data), f"{source.path}: in {source.place}", len(data))
    while kind := inner.next():
        if kind not in IN_CHUNKS:
            raise inner.wrong(f"there is {inner.place}, which no chunk has")
        if kind == Kind.Channel:
            yield inner.decoded(_channel, inner.content)
        elif kind == Kind.Message:
            yield inner.decoded(_message, inner.content)


HEAD, U32 = struct.Struct("<BQ"), struct.Struct("<I")
Encoded = TypeVar("Encoded")
Decoded = TypeVar("Decoded")


class _Source:
    """A file, a stream or the content of a chunk, which is read from front to back, record by record."""

    def __init__(self, file: BinaryIO, path: object, size: int | None) -> None:
        self._file, self.path, self._size = file, path, size
        self.at = 0
        """The number of bytes that were read."""
        self.crc = 0
        """Their CRC, from the begin of the file on."""
        self.content = b""
        """The content of the record that was read last, if it is DECODED."""
        self._begin, self._kind = 0, Kind.Header

    @property
    def place(self) -> str:
        """The record that was read last."""
        return f"the {self._kind.name} at byte {self._begin}"

    def wrong(self, why: str, kind: type[BadRecording] = BadRecording) -> BadRecording:
        """Return the error for `why`."""
        return kind(f"{self.path}: it is not a complete MCAP file: {why}")

    def upto(self, count: int) -> bytes:
        """Return the next bytes, at most `count`."""
        if self._size is not None:
            count = min(count, self._size - self.at)
        data = self._file.read(count) if count > 0 else b""
        self.at += len(data)
        self.crc = zlib.crc32(data, self.crc)
        return data

    def next(self) -> Kind | None:
        """Return the kind of the next record, and read it; None at the end. Raises BadRecording."""
        self._begin = self.at
        if not (head := self.upto(HEAD.size)):
            return None
        if len(head) < HEAD.size:
            raise self.wrong(f"it ends within the record at byte {self._begin}: it was cut off", EndOfStream)
        kind, length = HEAD.unpack(head)
        try:
            self._kind = Kind(min(kind, Kind.Private))
        except ValueError:
            raise self.wrong(f"there is no kind of record {kind:#04x}, as at byte {self._begin}") from None
        left = length
        if self._kind in DECODED and (self._size is None or length <= self._size - self.at):
            if length > LARGEST_RECORD_BYTES:
                most = f"and at most {LARGEST_RECORD_BYTES} are read"
                raise BadRecording(f"{self.path}: {self.place} has {length} bytes, {most}")
            self.content = self.upto(length)
            left -= len(self.content)
        else:
            while left and (passed := len(self.upto(min(left, MCAP_PIECE_BYTES)))):
                left -= passed
        if left:
            why = f"{self.place} has {length} bytes, of which {length - left} are there: it was cut off"
            raise self.wrong(f"{why}, or is damaged", EndOfStream)
        return self._kind

    def decoded(self, decode: Callable[[Encoded], Decoded], content: Encoded) -> Decoded:
        """Return the `content` of the last record as `decode` returns it. Raises BadRecording."""
        try:
            return decode(content)
        except (struct.error, ValueError, OverflowError, RuntimeError, zstandard.ZstdError) as error:
            raise self.wrong(f"{self.place} cannot be decoded: {error}") from None


def _channel(content: bytes) -> Channel:
    topic, at = _text(content, 4)
    encoding, _ = _text(content, at)
    return Channel(int.from_bytes(content[:2], "little"), topic, encoding)


def _message(content: bytes) -> RawMessage:
    if len(content) < MESSAGE_HEAD_BYTES:
        raise ValueError(f"it has {len(content)} bytes")
    return RawMessage(int.from_bytes(content[:2], "little"), content[MESSAGE_HEAD_BYTES:])


MESSAGE_HEAD_BYTES = 22
"""The bytes of a message's channel, number and two times."""


def _chunk(content: bytes) -> _Chunk:
    size, crc = struct.unpack_from("<QI", content, 16)
    compression, at = _text(content, 28)
    (length,) = struct.unpack_from("<Q", content, at)
    if length > len(content) - at - 8:
        raise ValueError(
            f"it says that it has {length} compressed bytes, and there are {len(content) - at - 8}"
        )
    return _Chunk(size, crc, compression, content[at + 8 : at + 8 + length])


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Return the text at this place, and the place after it. Raises ValueError."""
    (length,) = U32.unpack_from(content, at)
    end = at + U32.size + length
    if end > len(content):
        raise ValueError(f"a text in it has {length} bytes, and {len(content) - at - U32.size} are there")
    return content[at + U32.size : end].decode(), end


def _decompressed(chunk: _Chunk) -> bytes:
    """Return the content of a chunk. Raises ValueError, RuntimeError and ZstdError."""
    match chunk.compression:
        case "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(chunk.size + 1)
        case "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.size + 1)
        case "":
            data = chunk.data
        case other:
            raise ValueError(f"it is compressed with {other[:40]!a}, and only zstd and lz4 are known")
    if len(data) != chunk.size:
        more = "more" if len(data) > chunk.size else len(data)
        raise ValueError(f"it says that it holds {chunk.size} bytes, and holds {more}")
    if chunk.crc not in (0, zlib.crc32(data)):
        raise ValueError("a byte in it is damaged: its CRC is another")
    return data
