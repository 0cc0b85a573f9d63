"""The messages that are made from the readings of a driver, which may contain anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from protocol.messages import Contact, Message, NamedRange, Observation, RobotConfig
from protocol.wire import MalformedFrame, decode, encode
from world.hardware.driver import Reading
from world.hardware.driver_journal import Mark


class InvalidReading(Exception):
    """The reading of a driver is invalid. The text of the error says why."""


def observation_frame(reading: Any, tick: int, config: RobotConfig) -> bytes:
    """Return the frame of the Observation with `reading`. Raises InvalidReading.

    It has no range to the anchor if the robot has none: drivers need not know.
    """
    if not isinstance(reading, Reading):
        raise InvalidReading(f"returns {type(reading).__name__}, expected a Reading")
    executed = reading.executed if tick > 0 else None
    anchor_range = None if config.given_anchor is None else reading.anchor_range
    contacts, anchors = _contacts(reading, config), _anchors(reading, config)
    return _checked(Observation(tick, config.robot, executed, anchor_range, contacts, anchors=anchors))


def mark_frames(reading: Reading, tick: int, robot: str) -> list[bytes]:
    """Return the frame of the mark of `reading`, if it has one. Raises InvalidReading."""
    if not reading.mark:
        return []
    try:
        return [_checked(Mark(tick, robot, reading.mark))]
    except InvalidReading as error:
        raise InvalidReading(f"mark: {error}") from None


def _contacts(reading: Reading, config: RobotConfig) -> tuple[Contact, ...]:
    """Return the contacts in `reading`. Raises InvalidReading."""
    if not isinstance(reading.mutual_ranges, Mapping):
        raise InvalidReading(f"mutual_ranges is a {type(reading.mutual_ranges).__name__}, expected a mapping")
    ranges = dict(reading.mutual_ranges)
    if reading.mutual_range is not None or reading.contact:
        if config.encounter is None:
            raise InvalidReading("robots of a team have no peer: mutual_ranges has their contacts")
        peer = config.encounter.peer
        if peer in ranges:
            raise InvalidReading(f"both mutual_ranges and the other fields have a contact with {peer}")
        ranges[peer] = reading.mutual_range
    contacts = tuple([Contact(one, ranges.pop(one), None) for one in config.others if one in ranges])
    if ranges:
        stranger = next(iter(ranges))
        raise InvalidReading(f"mutual_ranges: {stranger!r} is none of {', '.join(config.others)}")
    return contacts


def _anchors(reading: Reading, config: RobotConfig) -> tuple[NamedRange, ...]:
    """Return the ranges to anchors of a team in `reading`. Raises InvalidReading."""
    if not isinstance(reading.anchors, Mapping):
        raise InvalidReading(f"anchors is a {type(reading.anchors).__name__}, expected a mapping")
    for name in reading.anchors:
        if name not in config.ranges:
            raise InvalidReading(f"anchors: {name!r} is none that {config.robot} may range")
    ranges = [(name, reading.anchors.get(name)) for name in config.ranges]
    return tuple([NamedRange(name, rho) for name, rho in ranges if rho is not None])


def _checked(message: Message) -> bytes:
    """Return the frame of `message` if it can be decoded. Raises InvalidReading."""
    try:
        frame = encode(message)
        decode(frame, type(message))
    except (MalformedFrame, TypeError, msgspec.MsgspecError) as error:
        raise InvalidReading(str(error)) from None
    return frame
