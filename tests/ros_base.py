"""A simulated robot base as zenoh-bridge-ros2dds exposes it: Twists in, Odometry and Ranges out, in CDR."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import zenoh
from rosbags.typesys import Stores, get_typestore

from protocol.motion import Pose, step
from protocol.network import session
from protocol.network.endpoints import listening

STORE = get_typestore(Stores.ROS2_HUMBLE)
PERIOD_S = 0.01
"""The period in s of odometry and ranges."""
WATCHDOG_S = 0.5
"""The time in s after the last Twist at which the base stops: the default of ros2_control's diff drive.

A driver on a busy machine may be late by tens of milliseconds, which must not stop the base.
"""


def message(kind: str, *fields: Any) -> Any:
    """Return a message of a type such as `geometry_msgs/Point`."""
    return STORE.types[kind.replace("/", "/msg/")](*fields)


def oriented(turned: Sequence[float], at: Sequence[float] = (0.0, 0.0, 0.0), frame: str = "odom") -> Any:
    """Return an Odometry with this quaternion."""
    still = message("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
    pose = message(
        "geometry_msgs/Pose",
        message("geometry_msgs/Point", *at),
        message("geometry_msgs/Quaternion", *turned),
    )
    twist = message("geometry_msgs/Twist", still, still)
    return message(
        "nav_msgs/Odometry",
        header(frame),
        "base_link",
        message("geometry_msgs/PoseWithCovariance", pose, np.zeros(36)),
        message("geometry_msgs/TwistWithCovariance", twist, np.zeros(36)),
    )


def header(frame: str) -> Any:
    return message("std_msgs/Header", message("builtin_interfaces/Time", 7, 8), frame)


def cdr(content: Any) -> bytes:
    return bytes(STORE.serialize_cdr(content, content.__msgtype__))


def odometry(pose: Pose, norm: float = 1.0, frame: str = "odom") -> bytes:
    half = 0.5 * pose.heading
    turned = (0.0, 0.0, norm * math.sin(half), norm * math.cos(half))
    return cdr(oriented(turned, (pose.x, pose.y, 0.0), frame))


def ranged(rho: float, most: float = 100.0, least: float = 0.1) -> bytes:
    return cdr(message("sensor_msgs/Range", header("uwb"), 0, 0.1, least, most, rho))


def twist(payload: bytes) -> tuple[float, float]:
    found: Any = STORE.deserialize_cdr(payload, "geometry_msgs/msg/Twist")
    return found.linear.x, found.angular.z


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
