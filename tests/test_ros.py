"""The ROS 2 driver: its encoding, its arithmetic, and the driver contract."""

from __future__ import annotations

import math
import struct
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import parse
from protocol.motion import Controls, Pose, step, wrap
from protocol.network import session
from protocol.network.endpoints import listening
from tests import ros_base
from tests.commands import BOUND_S, TandemProcess, tandem
from world.hardware import ros2

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""The encapsulation header of CDR (OMG DDSI-RTPS 10.5): CDR_LE without options."""

TWIST = LITTLE_ENDIAN + struct.pack("<6d", 1.5, 0.0, 0.0, 0.0, 0.0, -0.25)
"""A Twist encoded by hand: six doubles, aligned to 8 bytes after the header (OMG CORBA 15.3.1)."""

STAMP = struct.pack("<iI", 7, 8)
RANGE = (
    LITTLE_ENDIAN
    + STAMP
    + struct.pack("<I4s", 4, b"uwb\0")  # a string: its length including the zero byte, then its bytes
    + struct.pack("<B3x4f", 0, 0.5, 0.25, 100.0, 2.5)  # a byte, then padding to a multiple of 4
)
"""A sensor_msgs/Range of 2.5 m, encoded by hand."""

ODOMETRY = (
    LITTLE_ENDIAN
    + STAMP
    + struct.pack("<I5s3x", 5, b"odom\0")
    + struct.pack("<I10s", 10, b"base_link\0")
    + b"\0" * 6  # up to a multiple of 8: 8 + 12 + 14 + 6 = 40
    + struct.pack("<7d", 3.0, -4.0, 0.0, 0.0, 0.0, math.sin(0.4), math.cos(0.4))
    + struct.pack("<36d", *[0.0] * 36)
    + struct.pack("<6d", *[0.0] * 6)
    + struct.pack("<36d", *[0.0] * 36)
)
"""A nav_msgs/Odometry at (3, -4) with heading 0.8, encoded by hand."""


def test_a_twist_is_the_bytes_of_the_specification_and_of_another_library() -> None:
    assert ros2.twist(1.5, -0.25) == TWIST
    assert ros_base.twist(TWIST) == (1.5, -0.25)


def test_a_range_and_an_odometry_are_read_from_the_bytes_of_the_specification() -> None:
    assert ros2.ranged(RANGE, 3.0) == 2.5
    pose = ros2.odometry(ODOMETRY)
    assert (pose.x, pose.y) == (3.0, -4.0)
    assert pose.heading == pytest.approx(0.8, abs=1e-15)


def test_another_library_makes_the_same_bytes() -> None:
    assert ros_base.odometry(Pose(3.0, -4.0, 0.8)) == ODOMETRY
    made = ros_base.Range(ros_base.Header(frame_id="uwb"), 0, 0.5, 0.25, 100.0, 2.5)
    assert made.serialize() == RANGE


@pytest.mark.parametrize(
    ("rho", "reach", "found"),
    [(2.5, 3.0, 2.5), (2.5, 2.5, 2.5), (2.5, 2.4, None), (math.inf, 3.0, None), (200.0, 1000.0, None)],
)
def test_a_range_out_of_reach_is_none(rho: float, reach: float, found: float | None) -> None:
    assert ros2.ranged(ros_base.ranged(rho), reach) == found


@pytest.mark.parametrize("payload", [b"", b"\0\1", RANGE[:-2], TWIST[:9], b"\xff" * 60])
def test_bytes_that_are_no_message_are_refused(payload: bytes) -> None:
    with pytest.raises(ValueError, match=r"not a sensor_msgs/msg/Range"):
        ros2.ranged(payload, 3.0)
    with pytest.raises(ValueError, match=r"not a nav_msgs/msg/Odometry"):
        ros2.odometry(payload)


def test_what_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="not a number"):
        ros2.ranged(ros_base.ranged(math.nan), 3.0)
    with pytest.raises(ValueError, match="not finite"):
        ros2.odometry(ros_base.odometry(Pose(math.nan, 0.0, 0.0)))


@given(
    st.floats(-5.0, 5.0),
    st.floats(-3.0, 3.0),
    st.floats(-1.0, 1.0),
    st.floats(0.1, 2.0),
)
def test_what_was_executed_leads_from_one_pose_to_the_next(
    v: float, omega: float, heading: float, period: float
) -> None:
    before = Pose(3.0, -4.0, heading)
    after = step(before, v, omega, period)
    done = ros2.executed(before, after, period)
    again = step(before, done.v, done.omega, period)
    assert math.dist((again.x, again.y), (after.x, after.y)) <= 1e-9 * (1.0 + abs(v))
    assert again.heading == pytest.approx(after.heading, abs=1e-12)
    assert done.v == pytest.approx(v, abs=1e-6)


def test_equal_poses_are_exactly_zero_motion() -> None:
    pose = Pose(3.0, -4.0, 0.8)
    assert ros2.executed(pose, pose, 1.0) == Controls(0.0, 0.0)


SCENARIO = """
name = "ros"
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.0
[mission.noise]
anchor_sigma = 0.01
mutual_sigma = 0.01
drop_outs = 0.05
odometry = {v = 0.02, omega = 0.02}
[[robot]]
id = "a"
anchor = [1.0, 0.5]
[[robot]]
id = "b"
anchor = [10.0, 0.0]
"""


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_base_behind_a_bridge_fulfils_the_driver_contract(tmp_path: Path) -> None:
    """The base uses another CDR library, has its own watchdog, and its headings wrap.

    Odometry has to arrive within a fraction of a manoeuvre, so a manoeuvre is long for a busy machine.
    """
    (tmp_path / "ros.toml").write_text(SCENARIO)
    endpoint = free_endpoint()
    with ros_base.base(endpoint, (1.0, 0.5), 3.0) as base:
        with TandemProcess(
            *(
                "check-driver",
                "world.hardware.ros2:Ros2",
                "--mission",
                tmp_path / "ros.toml",
                "--rate",
                "0.5",
            ),
            *(
                "--option",
                f"connect={endpoint}",
                "--option",
                "cmd_vel=bot/cmd_vel",
                "--option",
                "odom=bot/odom",
            ),
            *("--option", "anchor_range=bot/uwb", "--option", "peer_range=bot/peer"),
        ) as checked:
            ended = checked.ended(3.0 * BOUND_S)  # the exercise lasts in proportion to its manoeuvres
        assert ended.status == 0, ended.out + ended.err
        assert ended.out.count("ok     ") == 8
        assert math.dist((base.pose.x, base.pose.y), (0.3, -0.4)) > 3.0
        assert base.pose.heading != wrap(base.pose.heading) or abs(base.pose.heading) < math.pi


def test_a_robot_of_a_group_reads_a_topic_for_each_other_robot() -> None:
    config = parse(f'{SCENARIO}[[robot]]\nid = "c"\nanchor = [1.0, 12.0]\n', "ros").config("a")
    endpoint = free_endpoint()
    with (
        session.open_router(listening(endpoint)) as link,
        closing(ros2.Ros2(config, 60.0, connect=endpoint)) as driver,
    ):
        topics = {"anchor_range": 1.5, "peer_range/b": 2.5, "peer_range/c": math.inf}
        publishers = {topic: session.publisher(link, topic) for topic in (*topics, "odom")}
        with ThreadPoolExecutor(1) as pool:
            reading = pool.submit(driver.sense, 1)
            while not reading.done():
                publishers["odom"].put(ros_base.odometry(Pose(0.0, 0.0, 0.0)))
                for topic, rho in topics.items():
                    publishers[topic].put(ros_base.ranged(rho))
                wait([reading], 0.01)
        found = reading.result()
    assert (found.anchor_range, found.mutual_ranges) == (1.5, {"b": 2.5})


@pytest.mark.long
def test_a_bridge_that_is_not_there_is_one_line() -> None:
    endpoint = free_endpoint()
    ended = tandem("check-driver", "world.hardware.ros2:Ros2", "--option", f"connect={endpoint}")
    assert ended.status == 2
    why = f"cannot be created: TimeoutError: no bridge at {endpoint}"
    assert ended.err == f"tandem check-driver: world.hardware.ros2:Ros2: {why}\n"
