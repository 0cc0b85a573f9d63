"""Bags of ROS 2, written by the writer of rosbags: the same data as that of the run they were made of."""

from __future__ import annotations

import dataclasses
import math
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from compose.errors import UserError
from compose.launch import in_process
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.scenario.scenario_file import load
from tests.commands import tandem

DEFINITIONS = {
    "my_msgs/msg/Uwb": "uint16 id\nfloat64 dis\n",
    "my_msgs/msg/UwbArray": "std_msgs/Header header\nuint8 own\nmy_msgs/Uwb[] nodes\n",
}
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(
    {name: one for kind, text in DEFINITIONS.items() for name, one in get_types_from_msg(text, kind).items()}
)
TYPES = STORE.types
ODOMETRY, RANGE, UWB = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Range", "my_msgs/msg/UwbArray"
POSE, TEXT = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/String"
BEGIN_S = 1_700_000_000
NUMBERS = {1: "a", 2: "b", 11: "anchor-a", 12: "anchor-b"}
MAP = """
bag = "bag"
[[topic]]
name = "/a/odom"
robot = "a"
[[topic]]
name = "/b/odom"
robot = "b"
[[topic]]
name = "/mocap/a"
robot = "a"
truth = true
[[topic]]
name = "/a/anchor_range"
robot = "a"
to = "anchor-a"
sigma = 0.03
[[topic]]
name = "/uwb"
robot_field = "own"
to_field = "nodes[].id"
distance = "nodes[].dis"
scale = 0.001
[names]
1 = "a"
2 = "b"
11 = "anchor-a"
12 = "anchor-b"
"""
Messages = list[tuple[str, str, float, Any]]
"""Topic, type, time in s, and content."""


def header(t: float) -> Any:
    whole = math.floor(t)
    stamp = TYPES["builtin_interfaces/msg/Time"](BEGIN_S + whole, round((t - whole) * 1e9))
    return TYPES["std_msgs/msg/Header"](stamp, "odom")


def pose(x: float, y: float, heading: float) -> Any:
    q = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading))
    return TYPES["geometry_msgs/msg/Pose"](TYPES["geometry_msgs/msg/Point"](x, y, 0.2), q)


def odometry(t: float, *at: float) -> Any:
    zero = TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](
        TYPES["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
    )
    placed = TYPES["geometry_msgs/msg/PoseWithCovariance"](pose(*at), np.zeros(36))
    return TYPES[ODOMETRY](header(t), "base_link", placed, twist)


def ranged(t: float, rho: float) -> Any:
    return TYPES[RANGE](header(t), 0, 0.1, 0.0, 50.0, rho)


def uwb(t: float, own: int, *nodes: tuple[int, float]) -> Any:
    return TYPES[UWB](header(t), own, [TYPES["my_msgs/msg/Uwb"](*one) for one in nodes])


def messages_of(recording: RangeRecording) -> Messages:
    """Return the messages of a run: `/a/anchor_range` for robot a, and all other ranges on `/uwb` in mm."""
    found: Messages = [("/chat", TEXT, 0.0, TYPES[TEXT]("hello"))]
    for robot in recording.robots:
        x, y, heading = 100.0, -50.0, 2.0
        steps = [(robot.odometry.t0[0], (0.0, 0.0, 0.0)), *zip(*robot.odometry[1:3], strict=True)]
        for t, (dx, dy, turn) in steps:
            x += math.cos(heading) * dx - math.sin(heading) * dy
            y += math.sin(heading) * dx + math.cos(heading) * dy
            heading += turn
            found.append((f"/{robot.id}/odom", ODOMETRY, t, odometry(t, x, y, heading)))
    truth = recording.robots[0].truth
    assert truth is not None
    for t, at in zip(*truth, strict=True):
        found.append(("/mocap/a", POSE, t, TYPES[POSE](header(t), pose(*at))))
    number = {name: one for one, name in NUMBERS.items()}
    radios = recording.radios
    for t, first, second, rho, _ in zip(*recording.ranges, strict=True):
        names = radios[first], radios[second]
        if names == ("a", "anchor-a"):
            found.append(("/a/anchor_range", RANGE, t, ranged(t, rho)))
        else:
            nodes = [(number[names[1]], 1000.0 * rho), (77, math.nan)]
            found.append(("/uwb", UWB, t, uwb(t, number[names[0]], *nodes)))
    return sorted(found, key=lambda one: one[2])


def written(folder: Path, messages: Messages, plugin: StoragePlugin, mapping: str = MAP) -> Path:
    """Write a bag, and the file that maps it; return the path of that. Messages come 0.25 s late."""
    with Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
        kinds = {topic: kind for topic, kind, _, _ in messages}
        on = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()}
        for topic, kind, t, content in messages:
            received = round((BEGIN_S + t + 0.25) * 1e9)
            writer.write(on[topic], received, STORE.serialize_cdr(content, kind))
    (folder / "map.toml").write_text(mapping)
    return folder / "map.toml"


@pytest.fixture(scope="module")
def run() -> RangeRecording:
    return ranges_of_run(in_process.run_mission(load("noisy")))


def mapped(run: RangeRecording) -> str:
    return MAP + "".join(
        f'[[anchor]]\nanchor = "{one.id}"\nx = {one.x}\ny = {one.y}\n' for one in run.anchors
    )


def same(found: RangeRecording, run: RangeRecording) -> None:
    """Fail unless both have the same data; stamps and a sensor_msgs/Range have fewer digits."""
    assert (found.radios, found.anchors) == (run.radios, run.anchors)
    for one, other in zip(found.robots, run.robots, strict=True):
        np.testing.assert_allclose(one.odometry.t1 - BEGIN_S, other.odometry.t1, atol=1e-6)
        np.testing.assert_allclose(one.odometry.increments, other.odometry.increments, atol=1e-9)
    assert found.robots[0].truth is not None
    assert run.robots[0].truth is not None
    np.testing.assert_allclose(found.robots[0].truth.poses[:, :2], run.robots[0].truth.poses[:, :2])
    np.testing.assert_array_equal(
        (found.ranges.first, found.ranges.second), (run.ranges.first, run.ranges.second)
    )
    np.testing.assert_allclose(found.ranges.range, run.ranges.range, rtol=1e-6)
    to_own = (run.ranges.first == 0) & (run.ranges.second == run.radios.index("anchor-a"))
    np.testing.assert_array_equal(found.ranges.sigma, np.where(to_own, 0.03, np.nan))


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_bag_gives_the_data_of_the_run_of_which_it_was_made(
    plugin: StoragePlugin, run: RangeRecording, tmp_path: Path
) -> None:
    found = read_ranges(written(tmp_path, messages_of(run), plugin, mapped(run)))
    same(found, run)
    others = int(np.count_nonzero(np.isnan(found.ranges.sigma)))
    assert found.unused == {f"messages on /chat ({TEXT})": 1, "ranges on /uwb that are none": others}


def test_a_bag_without_definitions_needs_those_of_types_that_ros_does_not_have(
    run: RangeRecording, tmp_path: Path
) -> None:
    path = written(tmp_path, messages_of(run), StoragePlugin.SQLITE3, mapped(run))
    (data,) = (tmp_path / "bag").glob("*.db3")
    with sqlite3.connect(data) as base:
        base.execute("DELETE FROM message_definitions")
    assert f"{tmp_path}/bag, /uwb, message 1: " in refused(path)
    for name, text in DEFINITIONS.items():
        (tmp_path / f"{name[12:]}.msg").write_text(text)
    types = "".join(f'"{name}" = "{name[12:]}.msg"\n' for name in DEFINITIONS)
    (tmp_path / "map.toml").write_text(f"{mapped(run)}\n[types]\n{types}")
    same(read_ranges(path), run)
    (tmp_path / "alone.toml").write_text(path.read_text().replace('"bag"', f'"bag/{data.name}"'))
    same(read_ranges(tmp_path / "alone.toml"), run)


def refused(path: Path) -> str:
    """Return the one line with which `path` is refused."""
    with pytest.raises(UserError) as error:
        read_ranges(path)
    assert "\n" not in str(error.value)
    return str(error.value)


FEW: Messages = [
    ("/a/odom", ODOMETRY, 1.0, odometry(1.0, 0.0, 0.0, 0.0)),
    ("/a/odom", ODOMETRY, 2.0, odometry(2.0, 1.0, 0.0, 0.0)),
    ("/uwb", UWB, 1.5, uwb(1.5, 1, (11, 2.0), (12, 3.0))),
]
A = 'bag = "bag"\n[[topic]]\nname = "/a/odom"\nrobot = "a"\n'
U = 'name = "/uwb"\nrobot = "a"\n'
TILTED = odometry(1.0, 0.0, 0.0, 0.0)
TILTED.pose.pose.orientation.x = 1.0


def test_the_metadata_of_something_else_are_refused(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("name: it\n")
    with pytest.raises(UserError, match=r"its metadata\.yaml is not that of a rosbag2"):
        read_ranges(tmp_path)


@pytest.mark.parametrize(
    ("mapping", "messages", "says"),
    [
        (f"{A}speed = 1", FEW, "/map.toml: topic[0]: unknown field 'speed'"),
        (f"{A}{A[12:]}", FEW, "/map.toml: topic: there are two of one name"),
        (f"{A}scale = 0", FEW, "/map.toml: topic[0].scale: expected a number > 0"),
        ("bag = 1", FEW, "/map.toml: bag: expected text, got a whole number"),
        ('bag = "other"', FEW, "/other cannot be read: No such file or directory"),
        (
            A.replace("odom", "odo"),
            FEW,
            "/map.toml: nothing is on '/a/odo' in {}/bag; it has messages on /a/odom",
        ),
        (f"{A}[[topic]]\n{U}", FEW, f"/bag, /uwb, message 1: {UWB} is no known type with a pose or a range"),
        (
            f'{A}[[topic]]\n{U}distance = "nodes.dis"',
            FEW,
            "/bag, /uwb, message 1: there is no field 'nodes.dis'",
        ),
        (
            f'{A}[[topic]]\n{U}distance = "nodes[].distance"',
            FEW,
            "/bag, /uwb, message 1: there is no field 'nodes[].distance'; beside it are id, dis",
        ),
        (
            f'{A}[[topic]]\n{U}to = "M 1"\ndistance = "nodes[].dis"',
            FEW,
            "/bag, /uwb, message 1: to: expected a name of letters, digits, - and _, got 'M 1'",
        ),
        (
            f'{A}[[topic]]\n{U}to_field = "nodes[].id"\ndistance = "own"',
            FEW,
            "/bag, /uwb, message 1: it has 2 nodes[].id for 1 distances",
        ),
        (
            f'{A}[[topic]]\n{U}to_field = "nodes[].id"\ndistance = "nodes[].dis"',
            FEW,
            "/bag, /uwb, message 1: 11 is neither a robot with odometry nor a known anchor",
        ),
        (
            A,
            [FEW[0], (*FEW[1][:3], TILTED)],
            "/bag, /a/odom, message 2: qx, qy, qz, qw: an orientation with a",
        ),
        (
            A,
            [FEW[1], (*FEW[0][:2], 3.0, FEW[0][3])],
            "/bag, /a/odom, message 2: it is of 1700000001 s, and the",
        ),
        (
            'bag = "bag"',
            FEW,
            "/map.toml: there is no odometry, but messages on /a/odom (nav_msgs/msg/Odometry): 2, message",
        ),
    ],
)
def test_what_does_not_fit_is_one_line_with_its_place(
    mapping: str, messages: Messages, says: str, tmp_path: Path
) -> None:
    said = refused(written(tmp_path, messages, StoragePlugin.MCAP, mapping))
    assert said.startswith(f"{tmp_path}{says.format(tmp_path)}"), said


def test_a_bag_without_a_mapping_is_refused_with_its_topics(tmp_path: Path) -> None:
    written(tmp_path, FEW, StoragePlugin.SQLITE3)
    (data,) = (tmp_path / "bag").glob("*.db3")
    moved = data.rename(tmp_path / "a 'robot'.db3")
    there = f"messages on /a/odom ({ODOMETRY}): 2, messages on /uwb ({UWB}): 1"
    hint = "a .toml file maps topics of ROS"
    assert refused(moved) == f"{moved}: there is no odometry, but {there}; {hint}"


def test_the_folder_of_a_bag_is_refused_like_its_file(tmp_path: Path) -> None:
    written(tmp_path, FEW, StoragePlugin.MCAP)
    there = f"messages on /a/odom ({ODOMETRY}): 2, messages on /uwb ({UWB}): 1"
    assert refused(tmp_path / "bag").startswith(f"{tmp_path}/bag: there is no odometry, but {there}; ")


def test_a_bag_of_ros_1_is_read_like_one_of_ros_2(tmp_path: Path) -> None:
    one, two = get_typestore(Stores.ROS1_NOETIC), tmp_path / "two"
    with Ros1Writer(tmp_path / "one.bag") as writer:
        on = writer.add_connection("/a/odom", ODOMETRY, typestore=one)
        for _, _, t, message in FEW[:2]:
            of_one = one.types["std_msgs/msg/Header"](7, message.header.stamp, message.header.frame_id)
            data = one.serialize_ros1(dataclasses.replace(message, header=of_one), ODOMETRY)
            writer.write(on, round((BEGIN_S + t) * 1e9), data)
    (tmp_path / "one.toml").write_text(A.replace('"bag"', '"one.bag"'))
    two.mkdir()
    expected = read_ranges(written(two, FEW, StoragePlugin.MCAP, A)).robots[0].odometry
    for column, its in zip(read_ranges(tmp_path / "one.toml").robots[0].odometry, expected, strict=True):
        np.testing.assert_array_equal(column, its)


@pytest.mark.parametrize("stamps", ["header", "received"])
def test_times_are_those_of_the_headers_or_of_the_recorder(stamps: str, tmp_path: Path) -> None:
    path = written(tmp_path, FEW, StoragePlugin.MCAP, f'stamps = "{stamps}"\n{A}')
    late = 0.25 if stamps == "received" else 0.0
    assert read_ranges(path).span == pytest.approx((BEGIN_S + 1.0 + late, BEGIN_S + 2.0 + late), rel=1e-15)


def test_a_sensor_that_measures_nothing_gives_no_range(tmp_path: Path) -> None:
    measured = [math.inf, -math.inf, math.nan, 0.0, 51.0, 49.0]
    ranges: Messages = [
        ("/r", RANGE, 1.0 + 0.1 * i, ranged(1.0 + 0.1 * i, rho)) for i, rho in enumerate(measured)
    ]
    anchor = '[[anchor]]\nanchor = "M1"\nx = 1\ny = 2\n'
    mapping = f'{A}[[topic]]\nname = "/r"\nrobot = "a"\nto = "M1"\n{anchor}'
    found = read_ranges(written(tmp_path, [*FEW[:2], *ranges], StoragePlugin.MCAP, mapping))
    assert found.ranges.range.tolist() == [49.0]
    assert found.unused["ranges on /r that are none"] == 5


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


@pytest.mark.parametrize("damage", [cut, lambda _: b"", lambda _: b"no bag at all"])
@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_damaged_bag_is_one_line(
    plugin: StoragePlugin, damage: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    path = written(tmp_path, FEW, plugin, A)
    (data,) = [one for one in (tmp_path / "bag").iterdir() if one.suffix != ".yaml"]
    data.write_bytes(damage(data.read_bytes()))
    assert refused(path).startswith(f"{tmp_path}/bag")


@pytest.mark.long
def test_the_command_line_says_what_it_does_not_use(run: RangeRecording, tmp_path: Path) -> None:
    path = written(tmp_path, messages_of(run), StoragePlugin.SQLITE3, mapped(run))
    ended = tandem("estimate", path)
    assert f"not used: messages on /chat ({TEXT}): 1, ranges on /uwb that are none: " in ended.out
