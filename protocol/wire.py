"""Frame <-> message. A frame is one version byte, the CRC-32 of the body, and the body in msgpack."""

from __future__ import annotations

import struct
import zlib
from typing import Any, TypeVar, overload

import msgspec

VERSION = 1
MAX_SENT_BYTES = 1 << 15
"""a low-latency Zenoh link breaks, instead of refusing, from some 48 kB on"""
MAX_REPORT_BYTES = 4096
MAX_FRAME_BYTES = 1 << 20
"""in a journal, whose scenario names every robot"""

_HEAD = struct.Struct(">BI")
_encoder = msgspec.msgpack.Encoder()
_decoders: dict[object, msgspec.msgpack.Decoder[Any]] = {}

M = TypeVar("M")


class MalformedFrame(ValueError):
    """The one error for every frame that cannot be understood; its text says why."""


def encode(message: msgspec.Struct) -> bytes:
    """The frame of `message`."""
    said = _encoder.encode(message)
    return _HEAD.pack(VERSION, zlib.crc32(said)) + said


def body(frame: bytes) -> bytes:
    """What stands in `frame` behind its head: msgpack."""
    return frame[_HEAD.size :]


def is_sound(frame: bytes) -> bool:
    """Whether `frame` is one of this version, and undamaged, whatever it says."""
    return len(frame) > _HEAD.size and _HEAD.unpack_from(frame) == (VERSION, zlib.crc32(frame[_HEAD.size :]))


def version_of(frame: bytes) -> int | None:
    """The version of the protocol that `frame` is of, if it is long enough to be a frame."""
    return frame[0] if len(frame) > _HEAD.size else None


@overload
def decode(frame: bytes, kind: type[M], limit: int = ...) -> M: ...
@overload
def decode(frame: bytes, kind: Any, limit: int = ...) -> Any: ...
def decode(frame: bytes, kind: Any, limit: int = MAX_SENT_BYTES) -> Any:
    """The message in `frame`, which must be a `kind` (a message or a union of messages).

    Raises MalformedFrame when the frame is truncated, longer than `limit` bytes, of another version,
    damaged (CRC), not msgpack, of another kind, or has a field of the wrong type or out of bounds.
    """
    if not _HEAD.size < len(frame) <= limit:
        raise MalformedFrame(f"{len(frame)} bytes, outside {_HEAD.size + 1} to {limit}")
    version, crc = _HEAD.unpack_from(frame)
    if version != VERSION:
        raise MalformedFrame(f"protocol version {version}, this is version {VERSION}")
    said = memoryview(frame)[_HEAD.size :]
    if zlib.crc32(said) != crc:
        raise MalformedFrame("damaged: the CRC does not match")
    try:
        return (_decoders.get(kind) or prepare(kind)).decode(said)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedFrame(str(error)) from None


def prepare(kind: Any) -> msgspec.msgpack.Decoder[Any]:
    """Return the decoder of `kind`, which takes milliseconds to make and is made once."""
    decoder = _decoders[kind] = msgspec.msgpack.Decoder(kind)
    return decoder
