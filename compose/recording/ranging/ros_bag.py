"""The messages of a rosbag2 (MCAP or SQLite) as a range recording, by a TOML file that maps its topics.

It needs the extra `ros`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from compose.errors import BadRecording, UserError
from compose.recording.ranging.recording_builder import RecordingBuilder
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    AntennaRow,
    PoseRow,
    RangeRow,
    SourcePlace,
    StatedSigma,
    TruePoseRow,
    row_of,
)
from compose.scenario.toml_file import field_first, table_in
from protocol import files

POSES = {
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
}
"""The field with the pose in each type of message that has one."""
DISTANCES = {"sensor_msgs/msg/Range": "range"}
"""The field with the distance in each type of message that is known to have one."""


Scale = Annotated[float, Meta(gt=0.0, le=1e6)]
"""A unit of length in m."""


class TopicTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One `[[topic]]`: poses of a robot, or ranges; its type decides, or `distance`.

    A field is a path such as `nodes[].distance`, where `[]` stands for all elements of a list.
    """

    name: str
    """The topic, such as `/a/odom`."""
    robot: str = ""
    """The robot whose poses these are, or that ranged."""
    robot_field: str = ""
    """The field with its name or number, in place of `robot`."""
    to: str = ""
    """The anchor or robot to which the ranges are."""
    to_field: str = ""
    """The field with its name or number, in place of `to`."""
    distance: str = ""
    """The field with the distance, of messages that are no sensor_msgs/Range."""
    scale: Scale = 1.0
    """The unit of the distance in m, such as 0.001."""
    sigma: StatedSigma | None = None
    """The standard deviation of the ranges in m; left out: the recording states none."""
    truth: bool = False
    """True if the poses are true ones, such as those of a motion capture."""


class BagFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The TOML file. Paths in it are relative to its folder."""

    bag: str
    """The path of the bag: its folder, or one .mcap or .db3 file."""
    topic: list[TopicTable] = []
    """The topics that are read."""
    stamps: Literal["header", "received"] = "header"
    """The times of messages: those of their headers, or of the recorder, as where there is no stamp."""
    names: dict[str, str] = {}
    """The names of robots and anchors by what messages have, such as `17 = "M1"`."""
    types: dict[str, str] = {}
    """The .msg files of types that the bag does not define, such as `"my_msgs/msg/Uwb" = "Uwb.msg"`."""
    anchor: list[AnchorRow] = []
    """The anchors, as in `anchors.csv`."""
    antenna: list[AntennaRow] = []
    """The antennas, as in `antennas.csv`."""


class _Message(NamedTuple):
    """One message on a topic that is read."""

    content: Any
    kind: str
    """The type of its messages, such as `nav_msgs/msg/Odometry`."""
    t: float
    """The time in s."""
    place: SourcePlace
    topic: TopicTable


def add_bag(builder: RecordingBuilder, path: Path, text: str) -> None:
    """Add the messages of the bag that `text`, the TOML file at `path`, names, in the order of their times.

    Messages on other topics are counted as unused. Raises OSError, and UserError, which names the message.
    """
    try:
        table = msgspec.convert(table_in(text, str(path)), BagFile)
    except msgspec.ValidationError as error:
        raise BadRecording(f"{path}: {field_first(str(error), BagFile)}") from None
    stated: list[AnchorRow | AntennaRow] = [*table.anchor, *table.antenna]
    for one in stated:
        builder.add(one, path)
    rows: list[tuple[PoseRow | RangeRow, SourcePlace]] = []
    for message in _messages(path, table, builder.unused):
        if message.topic.distance or message.kind not in POSES:
            rows += [(row, message.place) for row in _ranges(message, table.names, builder.unused)]
        else:
            rows.append((_pose(message), message.place))
    for row, place in sorted(rows, key=lambda one: one[0].t):
        builder.add(row, place)


def _messages(path: Path, table: BagFile, unused: Counter[str]) -> Iterator[_Message]:
    """Yield the messages on the topics of `table`; count all others in `unused`."""
    bag, topics = path.parent / table.bag, {one.name: one for one in table.topic}
    last: dict[str, _Message] = {}
    place: object = bag
    bag.stat()  # the error of the library does not name the file
    try:
        with AnyReader([bag], default_typestore=_types(path, table.types)) as reader:
            if len(topics) < len(table.topic):
                raise BadRecording(f"{path}: topic: there are two of one name")
            there = {f"messages on {one.topic} ({one.msgtype})": one for one in reader.connections}
            if missing := sorted(topics.keys() - reader.topics.keys()):
                names = ", ".join([f"{name}: {one.msgcount}" for name, one in there.items()])
                raise BadRecording(f"{path}: nothing is on {missing[0][:80]!a} in {bag}; it has {names}")
            unused.update({name: one.msgcount for name, one in there.items() if one.topic not in topics})
            read = [one for one in reader.connections if one.topic in topics]
            for connection, received_ns, data in reader.messages(read) if read else ():
                name, kind = connection.topic, connection.msgtype
                before = last.get(name)
                number = before.place.number + 1 if before is not None else 1
                place = here = SourcePlace(f"{bag}, {name}", number, "message")
                content = reader.deserialize(data, kind)
                stamp = getattr(getattr(content, "header", None), "stamp", None)
                t = stamp.sec + stamp.nanosec / 1e9 if stamp and table.stamps == "header" else 0.0
                last[name] = message = _Message(content, kind, t or received_ns / 1e9, here, topics[name])
                if before is not None and message.t < before.t:
                    earlier = f"the message before it is of {before.t:.15g} s"
                    raise BadRecording(f"{place}: it is of {message.t:.15g} s, and {earlier}")
                yield message
    except (UserError, OSError):
        raise
    except Exception as error:  # noqa: BLE001  # the library raises all kinds of errors for invalid files
        if error.__context__ is not None and isinstance(error.__context__.__context__, KeyError):
            raise BadRecording(f"{bag}: its metadata.yaml is not that of a rosbag2") from None
        raise BadRecording(f"{place}: {' '.join(str(error or type(error).__name__).split())}") from None


def _types(path: Path, definitions: Mapping[str, str]) -> Typestore:
    """Return the types of messages whose definitions a bag does not have. Raises OSError."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = [
        get_types_from_msg(files.read_text(path.parent / file), name) for name, file in definitions.items()
    ]
    store.register({name: one for each in types for name, one in each.items()})
    return store


def _values(message: _Message, field: str) -> list[Any]:
    """Return the values of the field at a path. Raises BadRecording, which names the fields there."""
    found = [message.content]
    for part in field.split("."):
        name, every = part.removesuffix("[]"), part.endswith("[]")
        try:
            found = [getattr(one, name) for one in found]
            found = [each for one in found for each in one] if every else found
        except (AttributeError, TypeError):
            names = [one for one in getattr(found[0], "__dataclass_fields__", ()) if one[0].islower()]
            there = f"; beside it are {', '.join(names)}" if names else ""
            raise BadRecording(f"{message.place}: there is no field {field[:80]!a}{there}") from None
    return found


def _pose(message: _Message) -> PoseRow:
    """Return the pose in a message. Raises BadRecording."""
    (pose,) = _values(message, POSES[message.kind])
    at, q = pose.position, pose.orientation
    numbers = {"t": message.t, "x": at.x, "y": at.y, "qx": q.x, "qy": q.y, "qz": q.z, "qw": q.w}
    row = {"robot": message.topic.robot, **{name: repr(float(one)) for name, one in numbers.items()}}
    return row_of(row, TruePoseRow if message.topic.truth else PoseRow, message.place)


def _ranges(message: _Message, names: Mapping[str, str], unused: Counter[str]) -> Iterator[RangeRow]:
    """Yield the ranges in a message; count those that are none in `unused`. Raises BadRecording.

    None are those that are not positive and finite, or beyond the limits of the message, of which 0 is none.
    """
    topic, place = message.topic, message.place
    if not (field := topic.distance or DISTANCES.get(message.kind, "")):
        what = f"{message.kind} is no known type with a pose or a range"
        raise BadRecording(f"{place}: {what}: `distance` has to name the field with the distance")
    measured = _values(message, field)
    ends = []
    for name, field in ((topic.robot, topic.robot_field), (topic.to, topic.to_field)):
        own = [str(one) for one in _values(message, field)] if field else [name]
        ends.append([names.get(one, one) for one in (own * len(measured) if len(own) == 1 else own)])
        if len(ends[-1]) != len(measured):
            raise BadRecording(f"{place}: it has {len(own)} {field} for {len(measured)} distances")
    least, most = [float(getattr(message.content, name, 0.0)) for name in ("min_range", "max_range")]
    sigma = {"sigma": repr(topic.sigma)} if topic.sigma is not None else {}
    for rho, first, second in zip(map(float, measured), *ends, strict=True):
        if 0.0 < rho < math.inf and least <= rho <= (most or math.inf):
            row = {"t": repr(message.t), "from": first, "to": second, "range": repr(rho * topic.scale)}
            yield row_of(row | sigma, RangeRow, place)
        else:
            unused[f"ranges on {topic.name} that are none"] += 1
