"""The ROS 2 driver: its encoding, its arithmetic, and the driver contract."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing
from functools import partial
from itertools import cycle
from pathlib import Path
from queue import SimpleQueue

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh import ext

from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import parse
from protocol.messages import Estimate
from protocol.motion import ORIGIN, Controls, Covariance, Pose, compose, step, wrap
from protocol.network import session
from protocol.network.endpoints import listening
from tests import ros_base
from tests.commands import BOUND_S, TandemProcess, tandem
from world.hardware import ros2
from world.hardware.driver import Reading
from world.hardware.ros2_topics import GID_BYTES, JAZZY, QOS, decoded, rmw_type

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""The encapsulation header of CDR (OMG DDSI-RTPS 10.5): CDR_LE without options."""

TWIST = LITTLE_ENDIAN + struct.pack("<6d", 1.5, 0.0, 0.0, 0.0, 0.0, -0.25)
"""A Twist encoded by hand: six doubles, aligned to 8 bytes after the header (OMG CORBA 15.3.1)."""

STAMPED = LITTLE_ENDIAN + struct.pack("<iII1s3x", 0, 0, 1, b"\0") + TWIST[len(LITTLE_ENDIAN) :]
"""A TwistStamped encoded by hand: a stamp, an empty frame_id, and the Twist, aligned to 8 bytes."""

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


def odometry(payload: bytes) -> Pose:
    return ros2.odometry(decoded(payload, ros2.ODOMETRY))


def ranged(payload: bytes, reach: float) -> float | None:
    return ros2.ranged(decoded(payload, ros2.RANGE), reach)


def test_twists_are_the_bytes_of_the_specification() -> None:
    assert ros2.twist(1.5, -0.25) == TWIST
    assert ros2.twist(1.5, -0.25, stamped=True) == STAMPED


def test_a_range_and_an_odometry_are_read_from_the_bytes_of_the_specification() -> None:
    assert ranged(RANGE, 3.0) == 2.5
    pose = odometry(ODOMETRY)
    assert (pose.x, pose.y) == (3.0, -4.0)
    assert pose.heading == pytest.approx(0.8, abs=1e-15)


@pytest.mark.parametrize(
    ("rho", "reach", "found"),
    [(2.5, 3.0, 2.5), (2.5, 2.5, 2.5), (2.5, 2.4, None), (math.inf, 3.0, None), (200.0, 1000.0, None)],
)
def test_a_range_out_of_reach_is_none(rho: float, reach: float, found: float | None) -> None:
    assert ranged(ros_base.ranged(rho), reach) == found


@pytest.mark.parametrize(
    ("rho", "most", "least", "found"),
    [(2.5, 0.0, 0.0, 2.5), (0.0625, 0.0, 0.0, 0.0625), (2.5, 0.0, 0.1, 2.5), (2.5, math.inf, 0.0, 2.5)],
)
def test_a_limit_of_zero_is_no_limit(rho: float, most: float, least: float, found: float) -> None:
    assert ranged(ros_base.ranged(rho, most, least), 3.0) == found
    assert ranged(ros_base.ranged(3.5, most, least), 3.0) is None


@pytest.mark.parametrize("rho", [-math.inf, 0.05])
def test_too_close_is_no_range_and_not_out_of_reach(rho: float) -> None:
    with pytest.raises(ros2.TooClose, match="too close to measure"):
        ranged(ros_base.ranged(rho), 3.0)


@pytest.mark.parametrize(
    ("rho", "most", "least", "said"),
    [
        (0.0, 100.0, 0.0, "a range of 0 m"),
        (-2.5, 100.0, 0.0, "a range of -2.5 m"),
        (2.5, math.nan, 0.1, "limits that are none"),
        (2.5, 100.0, math.nan, "limits that are none"),
        (math.inf, 100.0, math.nan, "limits that are none"),
        (2.5, 1.0, 2.0, "limits that are none: min_range 2 m, max_range 1 m"),
        (2.5, -1.0, 0.0, "limits that are none"),
        (2.5, math.inf, math.inf, "limits that are none"),
    ],
)
def test_an_invalid_range_or_limit_is_refused(rho: float, most: float, least: float, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ranged(ros_base.ranged(rho, most, least), 3.0)


@given(st.floats(0.91, 1.09), st.floats(-3.1, 3.1))
def test_the_norm_of_an_orientation_does_not_change_the_heading(norm: float, heading: float) -> None:
    found = odometry(ros_base.odometry(Pose(3.0, -4.0, heading), norm))
    assert found.heading == pytest.approx(heading, abs=1e-12)


@pytest.mark.parametrize(
    ("turned", "said"),
    [
        ((0.0, 0.0, 0.0, 0.0), "an orientation with a norm of 0, expected 1"),
        ((0.0, 0.0, 0.0, 0.5), "a norm of 0.5"),
        ((0.0, 0.0, 2.0, 0.0), "a norm of 2"),
        ((0.0, 0.0, 0.0, 1e200), "a norm of 1e\\+200"),
        ((0.0, 0.0, math.nan, 1.0), "not finite"),
        ((math.inf, 0.0, 0.0, 1.0), "not finite"),
        ((1.0, 0.0, 0.0, 0.0), "tilted by 180 degrees"),  # of a frame with z down
        ((0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), "tilted by 90 degrees"),
    ],
)
def test_an_orientation_that_is_none_is_refused(turned: tuple[float, ...], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        odometry(ros_base.cdr(ros_base.oriented(turned)))


@pytest.mark.parametrize("payload", [b"", b"\0\1", RANGE[:-2], TWIST[:9], b"\xff" * 60])
def test_bytes_that_are_no_message_are_refused(payload: bytes) -> None:
    with pytest.raises(ValueError, match=r"not a sensor_msgs/msg/Range"):
        ranged(payload, 3.0)
    with pytest.raises(ValueError, match=r"not a nav_msgs/msg/Odometry"):
        odometry(payload)


def test_what_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="not a number"):
        ranged(ros_base.ranged(math.nan), 3.0)
    with pytest.raises(ValueError, match="not finite"):
        odometry(ros_base.odometry(Pose(math.nan, 0.0, 0.0)))


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


@pytest.mark.long("slow")
@pytest.mark.timeout(300)
def test_a_base_behind_a_bridge_fulfils_the_driver_contract(tmp_path: Path) -> None:
    """The base has its own watchdog, and its headings wrap.

    Odometry has to arrive within a fraction of a manoeuvre, so a manoeuvre is long for a busy machine.
    """
    (tmp_path / "ros.toml").write_text(SCENARIO)
    endpoint = free_endpoint()
    with ros_base.base(endpoint, (1.0, 0.5), 3.0) as base:
        options = ("cmd_vel=bot/cmd_vel", "odom=bot/odom", "anchor_range=bot/uwb", "peer_range=bot/peer")
        words = [word for one in (f"connect={endpoint}", *options) for word in ("--option", one)]
        mission = ("--mission", tmp_path / "ros.toml", "--rate", "0.5")
        with TandemProcess("check-driver", "world.hardware.ros2:Ros2", *mission, *words) as checked:
            ended = checked.ended(3.0 * BOUND_S)  # the exercise lasts in proportion to its manoeuvres
        assert ended.status == 0, ended.out + ended.err
        assert ended.out.count("ok     ") == 8
        assert math.dist((base.pose.x, base.pose.y), (0.3, -0.4)) > 3.0
        assert base.pose.heading != wrap(base.pose.heading) or abs(base.pose.heading) < math.pi


EXACT = SCENARIO[: SCENARIO.index("[mission.noise]")] + SCENARIO[SCENARIO.index("[[robot]]") :]
GROUP = f'{SCENARIO}[[robot]]\nid = "c"\nanchor = [1.0, 12.0]\n'
ODOM = [ros_base.odometry(Pose(0.0, 0.0, 0.0))]


def sensed(scenario: str, topics: Mapping[str, Sequence[bytes]], manoeuvre_s: float = 60.0) -> Reading:
    """Return the reading of a driver that receives these messages, one after another and again."""
    config, endpoint = parse(scenario, "ros").config("a"), free_endpoint()
    with (
        session.open_router(listening(endpoint)) as link,
        closing(ros2.Ros2(config, manoeuvre_s, connect=endpoint)) as driver,
    ):
        publishers = {topic: session.publisher(link, topic) for topic in topics}
        messages = {topic: cycle(payloads) for topic, payloads in topics.items()}
        with ThreadPoolExecutor(1) as pool:
            reading = pool.submit(driver.sense, 1)
            while not reading.done():
                for topic, publisher in publishers.items():
                    publisher.put(next(messages[topic]))
                wait([reading], 0.01)
        return reading.result()


def test_a_robot_of_a_group_reads_a_topic_for_each_other_robot() -> None:
    ranges = {"anchor_range": 1.5, "peer_range/b": 2.5, "peer_range/c": math.inf}
    found = sensed(GROUP, {"odom": ODOM} | {topic: [ros_base.ranged(rho)] for topic, rho in ranges.items()})
    assert (found.anchor_range, found.mutual_ranges) == (1.5, {"b": 2.5})


def test_too_close_is_a_drop_out_and_a_contact_if_the_mission_has_drop_outs() -> None:
    near = [ros_base.ranged(-math.inf)]
    topics = {"odom": ODOM, "anchor_range": near, "peer_range/b": near, "peer_range/c": near}
    found = sensed(GROUP, topics)
    assert (found.anchor_range, found.mutual_ranges) == (None, {"b": None, "c": None})


@pytest.mark.parametrize("refused", [-math.inf, 0.05, math.nan, 0.0])
def test_without_drop_outs_what_is_no_measurement_is_measured_again(refused: float) -> None:
    again = [ros_base.ranged(refused), ros_base.ranged(refused), ros_base.ranged(2.5)]
    found = sensed(EXACT, {"odom": ODOM, "anchor_range": again, "peer_range": again})
    assert (found.anchor_range, found.mutual_ranges) == (2.5, {"b": 2.5})


@pytest.mark.parametrize(
    ("scenario", "topics", "said"),
    [
        (
            EXACT,
            {"anchor_range": [ros_base.ranged(-math.inf)]},
            r"no range on anchor_range .* no drop-outs: too close to measure \(-inf\)",
        ),
        (
            EXACT,
            {"peer_range": [ros_base.ranged(0.05)]},
            r"no range on peer_range .*: too close to measure: 0.05 m, min_range is 0.1 m",
        ),
        (EXACT, {"peer_range": []}, "nothing on peer_range since the robot stopped, and the mission has no"),
        (
            SCENARIO,
            {"odom": [ros_base.odometry(Pose(0.0, 0.0, 1.0), 0.0)]},
            "no odometry since the robot stopped: an orientation with a norm of 0, expected 1",
        ),
        (
            SCENARIO,
            {"peer_range": [ros_base.ranged(1.0, 2.5)]},
            "peer_range: max_range is 2.5 m, less than the mission's sensing_range of 3 m: reduce that",
        ),
    ],
)
def test_a_measurement_that_does_not_come_ends_with_the_reason(
    scenario: str, topics: dict[str, list[bytes]], said: str
) -> None:
    fine = [ros_base.ranged(2.5)]
    given = {"odom": ODOM, "anchor_range": fine, "peer_range": fine} | topics
    with pytest.raises((TimeoutError, ValueError), match=said):
        sensed(scenario, {topic: payloads for topic, payloads in given.items() if payloads}, 4.0)


def test_odometry_of_another_publisher_on_the_topic_is_not_used() -> None:
    other = ros_base.odometry(Pose(5.0, 0.0, 0.0), frame="map")
    found = sensed(SCENARIO, {"odom": [*ODOM, other], "anchor_range": [ros_base.ranged(2.5)]}, 4.0)
    assert found.mark[0] in (0.0, 5.0)
    assert found.executed == Controls(0.0, 0.0)


@pytest.mark.parametrize(("stamped", "sent"), [("false", TWIST), ("true", STAMPED)])
def test_a_driver_sends_stamped_twists_if_it_is_told_to(stamped: str, sent: bytes) -> None:
    config, endpoint = parse(SCENARIO, "ros").config("a"), free_endpoint()
    received: SimpleQueue[bytes] = SimpleQueue()
    with session.open_router(listening(endpoint)) as link:
        link.declare_subscriber("cmd_vel", lambda sample: received.put(sample.payload.to_bytes()))
        with closing(ros2.Ros2(config, 60.0, connect=endpoint, stamped=stamped)) as driver:
            driver.drive(90.0, -15.0)  # of a manoeuvre of 1 s, executed in 60 s
            assert received.get(timeout=BOUND_S) == sent
            driver.stop()
    with pytest.raises(ValueError, match="stamped: 'yes', expected true or false"):
        ros2.Ros2(config, 60.0, connect=endpoint, stamped="yes")


def test_a_range_of_jazzy_which_has_a_variance_is_read() -> None:
    types = JAZZY.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](7, 8), "uwb")
    message = types["sensor_msgs/msg/Range"](header, 0, 0.1, 0.1, 50.0, 2.5, 0.01)
    assert ranged(bytes(JAZZY.serialize_cdr(message, "sensor_msgs/msg/Range")), 3.0) == 2.5


def put(queue: SimpleQueue[bytes], sample: zenoh.Sample) -> None:
    queue.put(sample.payload.to_bytes())


@pytest.mark.parametrize("domain", ["", "3"])
def test_a_claimed_pose_and_its_transform_are_published_and_diagnostics_always(domain: str) -> None:
    """The odometry is at `base`, and the claim says where its frame is."""
    config, endpoint, base = parse(SCENARIO, "ros").config("a"), free_endpoint(), Pose(2.0, -1.0, 3.0)
    claim, covariance = Pose(-4.0, 7.0, 0.5), Covariance(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    several = Estimate(1, "a", (ORIGIN, claim), (), localised=False, probabilities=(0.75, 0.25))
    claimed = Estimate(2, "a", (), (claim,), localised=True, probabilities=(1.0,), covariance=covariance)
    received: dict[str, SimpleQueue[bytes]] = {name: SimpleQueue() for name in ("pose", "tf", "diagnostics")}

    def key(topic: str) -> str:
        return f"3/{topic}/{rmw_type(TOPIC_TYPES[topic])}" if domain else topic

    with session.open_router(listening(endpoint)) as link:
        for name, queue in received.items():
            link.declare_subscriber(key(name), partial(put, queue))
        odom = session.publisher(link, key("odom"))
        with (
            closing(ros2.Ros2(config, 60.0, connect=endpoint, domain=domain)) as driver,
            ThreadPoolExecutor(1) as pool,
        ):
            driver.estimated(several)  # of a tick without a reading
            for estimate in (several, claimed):
                driver.stop()
                reading = pool.submit(driver.sense, estimate.tick)
                while not reading.done():
                    odom.put(ros_base.odometry(base, frame="a/odom"))
                    for topic in ("anchor_range", "peer_range"):
                        session.publisher(link, key(topic)).put(ros_base.ranged(2.5))
                    wait([reading], 0.01)
                driver.estimated(estimate)
            odom.put(ros_base.odometry(base, frame="a/odom"))
            found = {name: queue.get(timeout=BOUND_S) for name, queue in received.items()}
            second = decoded(received["diagnostics"].get(timeout=BOUND_S), TOPIC_TYPES["diagnostics"])
            driver.stop()
    pose, tf, first = (decoded(frame, TOPIC_TYPES[name]) for name, frame in found.items())
    assert (pose.header.frame_id, pose.header.stamp.sec, pose.header.stamp.nanosec) == ("map", 7, 8)
    assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == (-4.0, 7.0)
    assert pose.pose.pose.orientation.z == pytest.approx(math.sin(0.25))
    rows = [list(pose.pose.covariance[6 * row : 6 * row + 6]) for row in (0, 1, 5)]
    assert [[row[0], row[1], row[5]] for row in rows] == covariance.matrix
    assert sum(pose.pose.covariance) == sum(map(sum, covariance.matrix))
    (one,) = tf.transforms
    assert (one.header.frame_id, one.child_frame_id, one.header.stamp.sec) == ("map", "a/odom", 7)
    at, turned = one.transform.translation, one.transform.rotation
    placed = compose(Pose(at.x, at.y, 2.0 * math.atan2(turned.z, turned.w)), base)
    assert (placed.x, placed.y, wrap(placed.heading)) == pytest.approx((claim.x, claim.y, claim.heading))
    told = [(one.status[0].level, one.status[0].message) for one in (first, second)]
    assert told == [(1, "2 hypotheses"), (0, "localised")]
    assert {one.key: one.value for one in first.status[0].values} == {
        "tick": "1",
        "hypotheses": "2",
        "frame": "local",
        "probability": "0.75",
        "position_sigma_m": "",
    }
    assert received["pose"].empty()


TOPIC_TYPES = {
    "odom": "nav_msgs/msg/Odometry",
    "anchor_range": "sensor_msgs/msg/Range",
    "peer_range": "sensor_msgs/msg/Range",
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "tf": "tf2_msgs/msg/TFMessage",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
HASHES = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
}
"""The hashes of types: that in the design document of rmw_zenoh, and one that a node of ROS 2 used."""


def test_a_node_of_rmw_zenoh_has_the_keys_tokens_and_attachments_of_its_design() -> None:
    """Attachments are a sequence number from 1, a time in ns and 16 bytes, as Zenoh serializes them."""
    for kind, digest in HASHES.items():
        package, _, name = kind.split("/")
        assert rmw_type(kind) == f"{package}::msg::dds_::{name}_/RIHS01_{digest}"
    config, endpoint = parse(SCENARIO, "ros").config("a"), free_endpoint()
    received: SimpleQueue[zenoh.Sample] = SimpleQueue()
    shown: SimpleQueue[zenoh.Sample] = SimpleQueue()
    twist = rmw_type("geometry_msgs/msg/TwistStamped")
    with session.open_router(listening(endpoint)) as link:
        link.declare_subscriber(f"3/bot/cmd_vel/{twist}", received.put)
        link.liveliness().declare_subscriber("@ros2_lv/3/**", shown.put)
        options = {"connect": endpoint, "stamped": "true", "cmd_vel": "/bot/cmd_vel", "domain": "3"}
        with closing(ros2.Ros2(config, 60.0, **options)) as driver:
            driver.stop()
            driver.stop()
            samples = [received.get(timeout=BOUND_S) for _ in range(2)]
            tokens = [str(shown.get(timeout=BOUND_S).key_expr) for _ in range(8)]
    numbers = []
    for sample in samples:
        assert sample.attachment is not None
        number, sent_ns, gid = ext.z_deserialize(tuple[ext.Int64, ext.Int64, bytes], sample.attachment)
        assert abs(sent_ns / 1e9 - time.time()) < BOUND_S
        assert len(gid) == GID_BYTES
        numbers.append(int(number))
    assert numbers == [1, 2]
    (zid,) = {token.split("/")[2] for token in tokens}
    assert f"@ros2_lv/3/{zid}/0/0/NN/%/%/tandem_a" in tokens
    assert f"@ros2_lv/3/{zid}/0/1/MP/%/%/tandem_a/%bot%cmd_vel/{twist}/{QOS}" in tokens
    assert sum("/MS/" in token for token in tokens) == 3
    assert len({token.split("/")[4] for token in tokens}) == len(tokens)


@pytest.mark.long
def test_a_bridge_that_is_not_there_is_one_line() -> None:
    endpoint = free_endpoint()
    ended = tandem("check-driver", "world.hardware.ros2:Ros2", "--option", f"connect={endpoint}")
    assert ended.status == 2
    why = f"cannot be created: TimeoutError: no bridge at {endpoint}"
    assert ended.err == f"tandem check-driver: world.hardware.ros2:Ros2: {why}\n"
