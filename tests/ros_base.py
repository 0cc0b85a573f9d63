"""A simulated robot base as zenoh-bridge-ros2dds exposes it: Twists in, Odometry and Ranges out, in CDR.

It shares no code with the driver: the messages are declared here with pycdr2, from the definitions of ROS 2
Humble (common_interfaces). pycdr2 evaluates annotations at run time, so they must not be strings.
"""

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import zenoh
from pycdr2 import IdlStruct
from pycdr2.types import array, float32, float64, int32, sequence, uint8, uint32

from protocol.motion import Pose, step
from protocol.network import session
from protocol.network.endpoints import listening

Covariance: Any = array[float64, 36]  # type: ignore[misc]
PERIOD_S = 0.01
"""The period in s of odometry and ranges."""
WATCHDOG_S = 0.5
"""The time in s after the last Twist at which the base stops: the default of ros2_control's diff drive.

A driver on a busy machine may be late by tens of milliseconds, which must not stop the base.
"""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces/msg/Time"):
    sec: int32 = 7
    nanosec: uint32 = 8


@dataclass
class Header(IdlStruct, typename="std_msgs/msg/Header"):
    stamp: Time = field(default_factory=Time)
    frame_id: str = "odom"


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs/msg/Vector3"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs/msg/Quaternion"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Twist(IdlStruct, typename="geometry_msgs/msg/Twist"):
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(IdlStruct, typename="geometry_msgs/msg/TwistStamped"):
    header: Header
    twist: Twist


@dataclass
class RosPose(IdlStruct, typename="geometry_msgs/msg/Pose"):
    position: Vector3
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs/msg/PoseWithCovariance"):
    pose: RosPose
    covariance: Covariance


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs/msg/TwistWithCovariance"):
    twist: Twist
    covariance: Covariance


@dataclass
class Odometry(IdlStruct, typename="nav_msgs/msg/Odometry"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class Range(IdlStruct, typename="sensor_msgs/msg/Range"):
    header: Header
    radiation_type: uint8
    field_of_view: float32
    min_range: float32
    max_range: float32
    range: float32


@dataclass
class PoseWithCovarianceStamped(IdlStruct, typename="geometry_msgs/msg/PoseWithCovarianceStamped"):
    header: Header
    pose: PoseWithCovariance


@dataclass
class Transform(IdlStruct, typename="geometry_msgs/msg/Transform"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs/msg/TransformStamped"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs/msg/TFMessage"):
    transforms: sequence[TransformStamped]  # type: ignore[type-arg]


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs/msg/KeyValue"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs/msg/DiagnosticStatus"):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]  # type: ignore[type-arg]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs/msg/DiagnosticArray"):
    header: Header
    status: sequence[DiagnosticStatus]  # type: ignore[type-arg]


def odometry(pose: Pose, norm: float = 1.0, frame: str = "odom") -> bytes:
    half = 0.5 * pose.heading
    turned = Quaternion(0.0, 0.0, norm * math.sin(half), norm * math.cos(half))
    return oriented(turned, Vector3(pose.x, pose.y, 0.0), frame)


def oriented(turned: Quaternion, at: Vector3 | None = None, frame: str = "odom") -> bytes:
    zeros = [0.0] * 36
    pose = PoseWithCovariance(RosPose(at or Vector3(), turned), zeros)
    message = Odometry(Header(frame_id=frame), "base_link", pose, TwistWithCovariance(Twist(), zeros))
    return bytes(message.serialize())


def ranged(rho: float, most: float = 100.0, least: float = 0.1) -> bytes:
    return bytes(Range(Header(frame_id="uwb"), 0, 0.1, least, most, rho).serialize())


def twist(payload: bytes) -> tuple[float, float]:
    message: Any = Twist.deserialize(payload)
    return message.linear.x, message.angular.z


class Base:
    """A base that executes Twists, publishes measurements, and stops when it receives no more Twists."""

    def __init__(self, link: zenoh.Session, anchor: tuple[float, float], reach: float) -> None:
        self.pose = Pose(0.3, -0.4, 3.0)
        self._anchor = anchor
        self._reach = reach
        self._command = (0.0, 0.0)
        self._at = 0.0
        self._over = threading.Event()
        self._odom = session.publisher(link, "bot/odom")
        self._anchor_range = session.publisher(link, "bot/uwb")
        self._peer_range = session.publisher(link, "bot/peer")
        link.declare_subscriber("bot/cmd_vel", self._on_twist)

    def _on_twist(self, sample: zenoh.Sample) -> None:
        self._command, self._at = twist(sample.payload.to_bytes()), time.monotonic()

    def run(self) -> None:
        before = time.monotonic()
        while not self._over.wait(PERIOD_S):
            now = time.monotonic()
            v, omega = self._command if now - self._at < WATCHDOG_S else (0.0, 0.0)
            self.pose, before = step(self.pose, v, omega, now - before), now
            rho = math.dist((self.pose.x, self.pose.y), self._anchor)
            self._odom.put(odometry(self.pose))
            self._anchor_range.put(ranged(rho if rho <= self._reach else math.inf))
            self._peer_range.put(ranged(math.inf))

    def end(self) -> None:
        self._over.set()


@contextmanager
def base(endpoint: str, anchor: tuple[float, float], reach: float) -> Iterator[Base]:
    """Yield a running base behind a bridge at `endpoint`."""
    with session.open_router(listening(endpoint)) as link:
        found = Base(link, anchor, reach)
        thread = threading.Thread(target=found.run)
        thread.start()
        try:
            yield found
        finally:
            found.end()
            thread.join()
