"""A driver for a robot that speaks ROS 2, through zenoh-bridge-ros2dds: a topic's name is its key, in CDR.

Out goes geometry_msgs/Twist, in come nav_msgs/Odometry and sensor_msgs/Range. What is fresh is told by when
it came, not by its stamp: no two clocks have to agree. Needs the extra `ros`.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import zenoh
from rosbags.typesys import Stores, get_typestore

from protocol.messages import RobotConfig
from protocol.motion import ORIGIN, Controls, Pose, wrap
from protocol.network import session
from protocol.network.endpoints import at
from world.hardware.driver import SENSING, Reading

TWIST, ODOMETRY, RANGE = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry", "sensor_msgs/msg/Range"
CONNECT_S = 10.0
"""how long to look for the bridge"""
REPEATS = 10
"""Twists in a manoeuvre: a base that hears none for a while stops, and must"""

_types = get_typestore(Stores.ROS2_HUMBLE)


def twist(v: float, omega: float) -> bytes:
    """A geometry_msgs/Twist, in m/s and rad/s."""
    vector = _types.types["geometry_msgs/msg/Vector3"]
    message = _types.types[TWIST](linear=vector(v, 0.0, 0.0), angular=vector(0.0, 0.0, omega))
    return bytes(_types.serialize_cdr(message, TWIST))


def odometry(payload: bytes) -> Pose:
    """The pose in a nav_msgs/Odometry; its heading in (-pi, pi]. Raises ValueError."""
    pose = _message(payload, ODOMETRY).pose.pose
    q = pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    found = Pose(float(pose.position.x), float(pose.position.y), yaw)
    if not all(map(math.isfinite, (found.x, found.y, found.heading))):
        raise ValueError("a pose that is no number")
    return found


def ranged(payload: bytes, reach: float) -> float | None:
    """m: what a sensor_msgs/Range says; none beyond `reach`, or its own limits. Raises ValueError."""
    message = _message(payload, RANGE)
    rho = float(message.range)
    if math.isnan(rho):
        raise ValueError("a range that is no number")
    return rho if message.min_range <= rho <= min(message.max_range, reach) else None


def executed(before: Pose, after: Pose, period: float) -> Controls:
    """What leads from `before` to `after` (headings not wrapped) if held for `period` s; eq. (1a), inverted.

    What a robot slips sideways is lost.
    """
    turn = after.heading - before.heading
    course = before.heading + 0.5 * turn
    ahead = (after.x - before.x) * math.cos(course) + (after.y - before.y) * math.sin(course)
    shorter = math.sin(0.5 * turn) / (0.5 * turn) if turn else 1.0
    return Controls(ahead / (shorter * period), turn / period)


class Ros2:
    """One robot behind a bridge."""

    def __init__(
        self,
        config: RobotConfig,
        manoeuvre_s: float,
        *,
        connect: str = "tcp/127.0.0.1:7448",
        cmd_vel: str = "cmd_vel",
        odom: str = "odom",
        anchor_range: str = "anchor_range",
        peer_range: str = "peer_range",
    ) -> None:
        """`connect` is the bridge's Zenoh endpoint, the rest are topics. Raises TimeoutError."""
        self._mission = config.mission
        self._manoeuvre_s = manoeuvre_s
        self._changed = threading.Condition()
        self._pose: tuple[Pose, float] | None = None
        """the latest, its heading not wrapped, and when it came"""
        self._ranges: dict[str, tuple[float | None, float]] = {}
        """the latest by topic, and when it came"""
        self._last: Pose | None = None
        """at the reading before"""
        self._rest_since = time.monotonic()
        self._command = threading.Event()
        self._command.set()  # nothing to be ended
        self._anchor, self._peer = anchor_range, peer_range
        self._open = ExitStack()
        give_up = time.monotonic() + CONNECT_S

        def unanswered() -> None:
            if time.monotonic() >= give_up:
                raise TimeoutError(f"no bridge at {connect}")
            time.sleep(0.05)

        link = self._open.enter_context(session.open_client(at(connect), unanswered))
        self._cmd_vel = session.publisher(link, cmd_vel)
        link.declare_subscriber(odom, lambda sample: self._on_odometry(sample.payload.to_bytes()))
        for topic in (anchor_range, peer_range):
            link.declare_subscriber(topic, self._on_range(topic))

    def sense(self, tick: int) -> Reading:
        """What came since it stands. Raises TimeoutError, if nothing came that must."""
        now = time.monotonic()
        since = min(self._rest_since, now)
        give_up = now + (SENSING * self._manoeuvre_s if tick else CONNECT_S)
        with self._changed:
            self._changed.wait_for(lambda: self._is_all_here(since), give_up - now)
            if self._pose is None or self._pose[1] < since:
                raise TimeoutError("no odometry since the robot stands")
            pose, _ = self._pose
            driven = executed(self._last or pose, pose, self._mission.period)
            self._last = pose
            ranges = self._fresh(self._anchor, since), self._fresh(self._peer, since)
            return Reading(driven, *ranges, mark=(pose.x, pose.y, pose.heading))

    def drive(self, v: float, omega: float) -> None:
        """Say it over and over, for the time of a manoeuvre; then to rest."""
        self._end_drive()
        ended = self._command = threading.Event()
        faster = self._mission.period / self._manoeuvre_s  # 1 in real time
        payload, until = twist(v * faster, omega * faster), time.monotonic() + self._manoeuvre_s
        self._rest_since = until

        def say() -> None:
            while not ended.is_set() and (left := until - time.monotonic()) > 0.0:
                self._cmd_vel.put(payload)
                ended.wait(min(left, self._manoeuvre_s / REPEATS))
            self._cmd_vel.put(twist(0.0, 0.0))

        self._saying = threading.Thread(target=say, daemon=True)
        self._saying.start()

    def resume(self, tick: int, mark: tuple[float, ...]) -> None:  # noqa: ARG002  # the odometer tells
        """Go on from the odometry of the latest reading, which the bridge, or the base, has outlived."""
        with self._changed:
            self._last = Pose(*mark)
            pose, came = self._pose or (self._last, -math.inf)
            heading = self._last.heading + wrap(pose.heading - self._last.heading)
            self._pose = Pose(pose.x, pose.y, heading), came

    def stop(self) -> None:
        """Twist zero, now."""
        self._end_drive()
        self._rest_since = min(self._rest_since, time.monotonic())
        self._cmd_vel.put(twist(0.0, 0.0))

    def close(self) -> None:
        """Leave the bridge."""
        self.stop()
        self._open.close()

    def _end_drive(self) -> None:
        if not self._command.is_set():
            self._command.set()
            self._saying.join()

    # --- what arrives, on threads of Zenoh's ---

    def _on_odometry(self, payload: bytes) -> None:
        try:
            pose = odometry(payload)
        except ValueError:
            return
        with self._changed:
            before = self._pose[0] if self._pose is not None else ORIGIN
            heading = before.heading + wrap(pose.heading - before.heading)
            self._pose = Pose(pose.x, pose.y, heading), time.monotonic()
            self._changed.notify_all()

    def _on_range(self, topic: str) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            try:
                rho = ranged(sample.payload.to_bytes(), self._mission.sensing_range)
            except ValueError:
                return
            with self._changed:
                self._ranges[topic] = rho, time.monotonic()
                self._changed.notify_all()

        return take

    # --- what is fresh ---

    def _is_all_here(self, since: float) -> bool:
        came = [self._pose[1] if self._pose else 0.0]
        came += [self._ranges[topic][1] for topic in (self._anchor, self._peer) if topic in self._ranges]
        return len(came) == 3 and min(came) >= since

    def _fresh(self, topic: str, since: float) -> float | None:
        """m: what came on `topic` since then. Raises TimeoutError, unless ranges may drop out."""
        rho, came = self._ranges.get(topic, (None, -math.inf))
        if came >= since:
            return rho
        if not self._mission.noise.drop_outs:
            raise TimeoutError(f"nothing on {topic} since the robot stands, and the mission has no drop-outs")
        return None


def _message(payload: bytes, kind: str) -> Any:
    try:
        return _types.deserialize_cdr(payload, kind)
    except Exception as error:  # noqa: BLE001  # the library says of bytes that are no message whatever it says
        raise ValueError(f"no {kind}: {error}") from None
