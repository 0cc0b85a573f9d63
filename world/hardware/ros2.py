"""A driver for robots with ROS 2, through zenoh-bridge-ros2dds.

The bridge maps each topic to the Zenoh key of the same name, with messages in CDR. The driver publishes
geometry_msgs/Twist, and subscribes to nav_msgs/Odometry and sensor_msgs/Range. It decides by the time of
arrival whether a message is fresh, and ignores the stamps, so the clocks need not be synchronised. It needs
the extra `ros`.
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

from protocol.messages import RobotConfig, RobotConfigInGroup, RobotConfigWithoutAnchor
from protocol.motion import ORIGIN, Controls, Pose, wrap
from protocol.network import session
from protocol.network.endpoints import at
from world.hardware.driver import SENSING, Reading

TWIST, ODOMETRY, RANGE = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry", "sensor_msgs/msg/Range"
CONNECT_S = 10.0
"""The time in s to wait for the bridge."""
REPEATS = 10
"""The number of Twists in a manoeuvre. A mobile base stops if it receives none for a while, as it should."""

_types = get_typestore(Stores.ROS2_HUMBLE)


def twist(v: float, omega: float) -> bytes:
    """Return the geometry_msgs/Twist with `v` m/s and `omega` rad/s, in CDR."""
    vector = _types.types["geometry_msgs/msg/Vector3"]
    message = _types.types[TWIST](linear=vector(v, 0.0, 0.0), angular=vector(0.0, 0.0, omega))
    return bytes(_types.serialize_cdr(message, TWIST))


def odometry(payload: bytes) -> Pose:
    """Return the pose in a nav_msgs/Odometry: m, m, and rad in (-pi, pi].

    Raises ValueError if `payload` is not such a message, or a value is not finite.
    """
    pose = _message(payload, ODOMETRY).pose.pose
    q = pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    found = Pose(float(pose.position.x), float(pose.position.y), yaw)
    if not all(map(math.isfinite, (found.x, found.y, found.heading))):
        raise ValueError("a pose that is not finite")
    return found


def ranged(payload: bytes, reach: float) -> float | None:
    """Return the range in a sensor_msgs/Range, in m; None beyond `reach` m or the limits of the message.

    Raises ValueError if `payload` is not such a message, or the range is NaN.
    """
    message = _message(payload, RANGE)
    rho = float(message.range)
    if math.isnan(rho):
        raise ValueError("a range that is not a number")
    return rho if message.min_range <= rho <= min(message.max_range, reach) else None


def executed(before: Pose, after: Pose, period: float) -> Controls:
    """Return the constant controls that lead from `before` to `after` in `period` s: the inverse of eq. (1a).

    Headings must not be wrapped. Lateral slip is ignored.
    """
    turn = after.heading - before.heading
    course = before.heading + 0.5 * turn
    ahead = (after.x - before.x) * math.cos(course) + (after.y - before.y) * math.sin(course)
    shorter = math.sin(0.5 * turn) / (0.5 * turn) if turn else 1.0
    return Controls(ahead / (shorter * period), turn / period)


class Ros2:
    """The driver of one robot behind a bridge."""

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
        """Connect to the bridge at the Zenoh endpoint `connect`. The other options are names of topics.

        In a group, the range to robot ID is on the topic `peer_range`/ID.

        Raises TimeoutError if there is no bridge within CONNECT_S.
        """
        self._mission = config.mission
        self._manoeuvre_s = manoeuvre_s
        self._changed = threading.Condition()
        self._pose: tuple[Pose, float] | None = None
        """The latest pose, with its heading not wrapped, and the time of its arrival."""
        self._ranges: dict[str, tuple[float | None, float]] = {}
        """The latest range by topic, and the time of its arrival."""
        self._last: Pose | None = None
        """The pose at the previous reading."""
        self._rest_since = time.monotonic()
        """The time at which the robot stops, or has stopped."""
        self._command = threading.Event()
        """The event that ends the current manoeuvre."""
        self._command.set()  # there is no manoeuvre yet
        in_group = isinstance(config, RobotConfigInGroup)
        self._anchors = () if isinstance(config, RobotConfigWithoutAnchor) else (anchor_range,)
        """The topic of the range to the robot's own anchor, if it has one."""
        self._peers = {one: f"{peer_range}/{one}" if in_group else peer_range for one in config.others}
        """The topic of the range to each other robot."""
        self._open = ExitStack()
        give_up = time.monotonic() + CONNECT_S

        def unanswered() -> None:
            if time.monotonic() >= give_up:
                raise TimeoutError(f"no bridge at {connect}")
            time.sleep(0.05)

        link = self._open.enter_context(session.open_client(at(connect), unanswered))
        self._cmd_vel = session.publisher(link, cmd_vel)
        link.declare_subscriber(odom, lambda sample: self._on_odometry(sample.payload.to_bytes()))
        for topic in (*self._anchors, *self._peers.values()):
            link.declare_subscriber(topic, self._on_range(topic))

    def sense(self, tick: int) -> Reading:
        """Return the messages that have arrived since the robot stopped.

        Raises TimeoutError if odometry is missing, or a range without drop-outs in the mission.
        """
        now = time.monotonic()
        since = min(self._rest_since, now)
        give_up = now + (SENSING * self._manoeuvre_s if tick else CONNECT_S)
        with self._changed:
            self._changed.wait_for(lambda: self._is_all_here(since), give_up - now)
            if self._pose is None or self._pose[1] < since:
                raise TimeoutError("no odometry since the robot stopped")
            pose, _ = self._pose
            driven = executed(self._last or pose, pose, self._mission.period)
            self._last = pose
            anchor_range = next((self._fresh(topic, since) for topic in self._anchors), None)
            mutual = [(robot, self._fresh(topic, since)) for robot, topic in self._peers.items()]
            return Reading(
                driven,
                anchor_range,
                mark=(pose.x, pose.y, pose.heading),
                mutual_ranges={robot: rho for robot, rho in mutual if rho is not None},
            )

    def drive(self, v: float, omega: float) -> None:
        """Start to publish the velocities repeatedly for the duration of a manoeuvre, and then zero."""
        self._end_drive()
        ended = self._command = threading.Event()
        faster = self._mission.period / self._manoeuvre_s  # 1 in real time
        payload, until = twist(v * faster, omega * faster), time.monotonic() + self._manoeuvre_s
        self._rest_since = until

        def publish() -> None:
            while not ended.is_set() and (left := until - time.monotonic()) > 0.0:
                self._cmd_vel.put(payload)
                ended.wait(min(left, self._manoeuvre_s / REPEATS))
            self._cmd_vel.put(twist(0.0, 0.0))

        self._publisher = threading.Thread(target=publish, daemon=True)
        self._publisher.start()

    def resume(self, tick: int, mark: tuple[float, ...]) -> None:  # noqa: ARG002  # the mark is a pose
        """Continue from the pose of the latest recorded reading. The odometry must not have been reset."""
        with self._changed:
            self._last = Pose(*mark)
            pose, came = self._pose or (self._last, -math.inf)
            heading = self._last.heading + wrap(pose.heading - self._last.heading)
            self._pose = Pose(pose.x, pose.y, heading), came

    def stop(self) -> None:
        """End the manoeuvre, and publish a Twist of zero."""
        self._end_drive()
        self._rest_since = min(self._rest_since, time.monotonic())
        self._cmd_vel.put(twist(0.0, 0.0))

    def close(self) -> None:
        """Stop the robot and disconnect from the bridge."""
        self.stop()
        self._open.close()

    def _end_drive(self) -> None:
        if not self._command.is_set():
            self._command.set()
            self._publisher.join()

    # --- callbacks, on Zenoh's threads ---

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

    # --- freshness of messages ---

    def _is_all_here(self, since: float) -> bool:
        came = [self._pose[1] if self._pose else 0.0]
        topics = (*self._anchors, *self._peers.values())
        came += [self._ranges[topic][1] for topic in topics if topic in self._ranges]
        return len(came) == 1 + len(topics) and min(came) >= since

    def _fresh(self, topic: str, since: float) -> float | None:
        """Return the range in m that arrived on `topic` since then; None if it is out of range, or missing.

        Raises TimeoutError if it is missing and the mission has no drop-outs.
        """
        rho, came = self._ranges.get(topic, (None, -math.inf))
        if came >= since:
            return rho
        if not self._mission.noise.drop_outs:
            raise TimeoutError(
                f"nothing on {topic} since the robot stopped, and the mission has no drop-outs"
            )
        return None


def _message(payload: bytes, kind: str) -> Any:
    try:
        return _types.deserialize_cdr(payload, kind)
    except Exception as error:  # noqa: BLE001  # the library raises all kinds of errors for malformed bytes
        raise ValueError(f"not a {kind}: {error}") from None
