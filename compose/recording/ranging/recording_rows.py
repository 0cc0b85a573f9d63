"""The rows of a range recording, as its files state them."""

from __future__ import annotations

import re
from typing import Annotated, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from compose.errors import BadRecording
from compose.recording.ranging.range_recording import FixedAnchor
from protocol.units import Angle, Coordinate, Range, RobotId, Sigma

Stamp = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""A time in s, on a clock that all robots and radios of a recording share."""
StatedSigma = Annotated[float, Meta(gt=0.0, le=1e4)]
"""A standard deviation that a file states, in m or rad."""
Part = Annotated[float, Meta(ge=-2.0, le=2.0)]
"""An element of a quaternion."""


class SourcePlace(NamedTuple):
    """The place of a row, for errors."""

    path: object
    number: int
    kind: str = "line"

    def __str__(self) -> str:
        return f"{self.path}, {self.kind} {self.number}"


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The base class of all rows."""


class OdometryRow(Row, frozen=True):
    """The motion of a robot over one interval: its pose at the end in the frame of its pose at the start."""

    robot: RobotId
    """The robot."""
    t0: Stamp
    """The start of the interval in s."""
    t1: Stamp
    """The end of the interval in s, not before its start."""
    dx: Coordinate
    """The motion forward in m."""
    dy: Coordinate
    """The motion to the left in m: lateral slip, and the sideways part of an arc."""
    dheading: Angle
    """The turn in rad, counter-clockwise."""
    sigma_dx: StatedSigma | None = None
    """The standard deviation of `dx` in m; all three or none."""
    sigma_dy: StatedSigma | None = None
    """The standard deviation of `dy` in m."""
    sigma_dheading: StatedSigma | None = None
    """The standard deviation of `dheading` in rad."""


class RangeRow(Row, frozen=True):
    """A measured range between two radios."""

    t: Stamp
    """The time of the measurement in s."""
    first: RobotId = msgspec.field(name="from")
    """The robot that measured: a depth is along its heading. An anchor here counts as one in `to`."""
    second: RobotId = msgspec.field(name="to")
    """The other robot or the anchor. At least one of the two is a robot."""
    range: Range
    """The measured distance in m, or depth of a camera."""
    sigma: StatedSigma | None = None
    """The standard deviation in m."""


class AnchorRow(Row, frozen=True):
    """An anchor. Without a position, or with a sigma, its position is estimated with the poses."""

    anchor: RobotId
    """The name of the anchor."""
    x: Coordinate | None = None
    """The x coordinate in m; both coordinates or none."""
    y: Coordinate | None = None
    """The y coordinate in m."""
    height: Coordinate = 0.0
    """The height in m, above the same level as those of the robots' radios."""
    sigma: Sigma = 0.0
    """The standard deviation of each coordinate in m; 0: surveyed."""

    @property
    def fixed(self) -> FixedAnchor:
        """This anchor in the model of a recording."""
        if self.x is None or self.y is None:
            return FixedAnchor(self.anchor, np.nan, np.nan, self.height, np.inf)
        return FixedAnchor(self.anchor, self.x, self.y, self.height, self.sigma)


class AntennaRow(Row, frozen=True):
    """The position of a robot's radio on the robot."""

    robot: RobotId
    """The robot."""
    forward: Coordinate
    """The distance in m by which it is in front of the robot's centre."""
    left: Coordinate
    """The distance in m by which it is to the left of the robot's centre."""
    height: Coordinate = 0.0
    """The height in m."""


class PoseRow(Row, frozen=True):
    """The pose of a robot by its odometry, in a frame that begins anywhere."""

    robot: RobotId
    """The robot."""
    t: Stamp
    """The time in s."""
    x: Coordinate
    """The x coordinate in m."""
    y: Coordinate
    """The y coordinate in m."""
    heading: Angle | None = None
    """The heading in rad, counter-clockwise from the x-axis, wrapped or not; or the next four."""
    qx: Part | None = None
    """The orientation as a quaternion in place of `heading`, z up: its x."""
    qy: Part | None = None
    """The y of the quaternion."""
    qz: Part | None = None
    """The z of the quaternion."""
    qw: Part | None = None
    """The w of the quaternion."""


class TruePoseRow(PoseRow, frozen=True):
    """The true pose of a robot's centre."""


AnyRow = OdometryRow | PoseRow | RangeRow | AnchorRow | AntennaRow
RowKind = TypeVar("RowKind", bound=Row)
TABLES: dict[str, type[AnyRow]] = {
    "odometry": OdometryRow,
    "poses": PoseRow,
    "ranges": RangeRow,
    "anchors": AnchorRow,
    "antennas": AntennaRow,
    "truth": TruePoseRow,
}
"""The rows of each table, by its name."""


IS_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?", re.ASCII)
"""A number in a text, as C and spreadsheets write it; JSON allows none of `.5`, `5.`, `+3` and `05`."""


def number_of(text: str) -> float | str:
    """Return the number in `text`, or `text` if it is none."""
    return float(text) if IS_NUMBER.fullmatch(text) else text


def row_of(values: dict[str, str], kind: type[RowKind], place: object) -> RowKind:
    """Return the row with `values`, texts by field. Raises BadRecording, which names `place`."""
    try:
        read = {name: text if name in NAMES else number_of(text) for name, text in values.items()}
        return msgspec.convert(read, kind)
    except msgspec.ValidationError as error:
        raise BadRecording(f"{place}: {wrong_field(error, values)}") from None


def wrong_field(error: msgspec.ValidationError, values: object = None) -> str:
    """Return the message of an error for a user: the field of `values`, and what is wrong with it."""
    found = re.fullmatch(r"(?P<what>.*) - at `\$\.?(?P<field>.*)`", str(error), re.DOTALL)
    what, field = (found["what"], found["field"]) if found else (str(error), "")
    if isinstance(values, dict) and field in values:
        if field in STAMPS and "=" in what:
            what += " (a time in s)"
        expected = re.sub(r", got .*", "", what) + f", got {str(values[field])[:40]!a}"
        what = re.sub(r"`str` matching regex '[^']*'", "a name of letters, digits, - and _", expected)
    what = what.replace("Object ", "").replace("`float | null`", "a number").replace("`float`", "a number")
    what = what[:1].lower() + what[1:].replace("`", "'")
    return f"{field}: {what}" if field else what


NAMES = frozenset(("robot", "anchor", "from", "to"))
"""The fields whose values are names; all others are numbers."""
STAMPS = frozenset(("t", "t0", "t1"))
"""The fields whose values are times."""


def check_anchor(row: AnchorRow, place: object) -> None:
    """Raise BadRecording if the row at `place` has one coordinate, or none and a sigma."""
    if (row.x is None) != (row.y is None):
        raise BadRecording(f"{place}: it has one of x and y, and an anchor has both or none")
    if row.x is None and row.sigma:
        raise BadRecording(f"{place}: sigma: an anchor without x and y has none")
