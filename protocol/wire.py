"""The encoding of messages as frames.

A frame is one version byte, the CRC-32 of the body in four bytes (big-endian), and the body in msgpack.
"""

from __future__ import annotations

import struct
import threading
import zlib
from typing import Any, TypeVar, overload

import msgspec

VERSION = 3
"""The version of the protocol."""
RELEASES = {1: "0.1", 2: "0.2"}
"""The minor version of Tandem that has each earlier version of the protocol."""
MAX_SENT_BYTES = 1 << 15
"""The maximum size of a frame on the network. From about 48 kB on, a low-latency Zenoh link breaks."""
MAX_REPORT_BYTES = 4096
"""The maximum size of a Report's frame."""
MAX_FRAME_BYTES = 1 << 20
"""The maximum size of a frame in a journal: the scenario in a world's journal contains all robots."""

_HEAD = struct.Struct(">BI")
_encoder = msgspec.msgpack.Encoder()
_decoders: dict[object, msgspec.msgpack.Decoder[Any]] = {}
_preparing = threading.Lock()

M = TypeVar("M")


class MalformedFrame(ValueError):
    """A frame cannot be decoded. The text of the error is the reason."""


def encode(message: msgspec.Struct) -> bytes:
    """Return the frame of `message`."""
    payload = _encoder.encode(message)
    return _HEAD.pack(VERSION, zlib.crc32(payload)) + payload


class EncodedMessages(dict[bytes, Any]):
    """The messages that this process has encoded, by frame. A reader need not decode these frames."""

    def encode(self, message: msgspec.Struct) -> bytes:
        """Return the frame of `message`, and store both."""
        frame = encode(message)
        self[frame] = message
        return frame


def is_sound(frame: bytes) -> bool:
    """Return whether `frame` has this version and the right checksum. Its body is not decoded."""
    return len(frame) > _HEAD.size and _HEAD.unpack_from(frame) == (VERSION, zlib.crc32(frame[_HEAD.size :]))


def version_of(frame: bytes) -> int | None:
    """Return the protocol version of `frame`; None if it is too short to be a frame."""
    return frame[0] if len(frame) > _HEAD.size else None


def versions(version: int) -> str:
    """Return text that names another version of the protocol, the release that has it, and this version."""
    release = f" of Tandem {RELEASES[version]}" if version in RELEASES else ""
    return f"protocol version {version}{release}, this is version {VERSION}"


def other_version(frame: bytes) -> int | None:
    """Return the protocol version of an undamaged `frame` of another version; None for any other frame."""
    if len(frame) <= _HEAD.size:
        return None
    version, crc = _HEAD.unpack_from(frame)
    return version if version != VERSION and crc == zlib.crc32(frame[_HEAD.size :]) else None


@overload
def decode(frame: bytes, kind: type[M], limit: int = ...) -> M: ...
@overload
def decode(frame: bytes, kind: Any, limit: int = ...) -> Any: ...
def decode(frame: bytes, kind: Any, limit: int = MAX_SENT_BYTES) -> Any:
    """Return the message in `frame`, which must be a `kind` (a message or a union of messages).

    Raises MalformedFrame if the frame is truncated, is longer than `limit` bytes, has another version or a
    wrong checksum, is not msgpack or another kind of message, or has a field of a wrong type or value.
    """
    if not _HEAD.size < len(frame) <= limit:
        raise MalformedFrame(f"{len(frame)} bytes, outside {_HEAD.size + 1} to {limit}")
    payload = frame[_HEAD.size :]
    version, crc = _HEAD.unpack_from(frame)
    if version != VERSION:
        raise MalformedFrame(versions(version))
    if zlib.crc32(payload) != crc:
        raise MalformedFrame("damaged: the CRC does not match")
    try:
        return (_decoders.get(kind) or prepare(kind)).decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedFrame(str(error)) from None


def prepare(kind: Any) -> msgspec.msgpack.Decoder[Any]:
    """Return the decoder of `kind`. Creating it takes milliseconds, so it is stored for `decode`.

    While one thread creates it, msgspec crashes if another one uses the same types.
    """
    with _preparing:
        decoder = _decoders[kind] = _decoders.get(kind) or msgspec.msgpack.Decoder(kind)
    return decoder
