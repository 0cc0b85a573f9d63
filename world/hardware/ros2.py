"""A driver for robots with ROS 2, through zenoh-bridge-ros2dds or rmw_zenoh.

Messages are in CDR (see `ros2_topics`). The driver publishes
geometry_msgs/Twist or TwistStamped, and what the robot knows: its pose, the transform from the frame of the
anchors to that of its odometry, and diagnostics. It subscribes to nav_msgs/Odometry and sensor_msgs/Range,
and decides by
the time of arrival whether a message is fresh, and ignores the stamps, so the clocks need not be
synchronised. It needs the extra `ros`.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from protocol.messages import Estimate, RobotConfig
from protocol.motion import ORIGIN, Controls, Covariance, Pose, compose, heading_of, inverse, relative, wrap
from protocol.network import session
from protocol.network.endpoints import at
from world.hardware.driver import SENSING, Reading
from world.hardware.ros2_topics import HUMBLE, RosTopics, decoded

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
ODOMETRY, RANGE = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Range"
POSE, TRANSFORM = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARNING = 0, 1
"""The levels of a diagnostic_msgs/DiagnosticStatus: with a pose, and without."""
BRIDGE_S = 10.0
"""The time in s to wait for the bridge."""
REPEATS = 10
"""The number of Twists in a manoeuvre. A mobile base stops if it receives none for a while, as it should."""
TOO_CLOSE = -math.inf
"""The range to a sensor that is too close to measure it, as in REP 117."""
SINGLE = 1e-6
"""The relative rounding error of the single-precision numbers of a sensor_msgs/Range, and some margin."""


class TooClose(ValueError):
    """A sensor_msgs/Range of a sensor that is too close to measure a range. It is in range, however."""


def twist(v: float, omega: float, *, stamped: bool = False) -> bytes:
    """Return the geometry_msgs/Twist with `v` m/s and `omega` rad/s, in CDR; a TwistStamped if `stamped`."""
    types = HUMBLE.types
    vector = types["geometry_msgs/msg/Vector3"]
    message = types[TWIST](linear=vector(v, 0.0, 0.0), angular=vector(0.0, 0.0, omega))
    if not stamped:
        return bytes(HUMBLE.serialize_cdr(message, TWIST))
    return bytes(HUMBLE.serialize_cdr(types[STAMPED](_header("", NO_STAMP), message), STAMPED))


def claimed(pose: Pose, covariance: Covariance | None, frame: str, stamp: Any) -> bytes:
    """Return the geometry_msgs/PoseWithCovarianceStamped of `pose`, in CDR.

    The covariance is 0 where it is unknown, as for exact sensors, and for z, roll and pitch.
    """
    types, matrix = HUMBLE.types, np.zeros((6, 6))
    if covariance is not None:
        matrix[np.ix_((0, 1, 5), (0, 1, 5))] = covariance.matrix
    at = types["geometry_msgs/msg/Point"](pose.x, pose.y, 0.0)
    with_covariance = types["geometry_msgs/msg/PoseWithCovariance"](
        types["geometry_msgs/msg/Pose"](at, _turned(pose.heading)), matrix.ravel()
    )
    return bytes(HUMBLE.serialize_cdr(types[POSE](_header(frame, stamp), with_covariance), POSE))


def transform(pose: Pose, frame: str, child: str, stamp: Any) -> bytes:
    """Return the tf2_msgs/TFMessage that has the frame `child` at `pose` in `frame`, in CDR."""
    types = HUMBLE.types
    moved = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](pose.x, pose.y, 0.0), _turned(pose.heading)
    )
    one = types["geometry_msgs/msg/TransformStamped"](_header(frame, stamp), child, moved)
    return bytes(HUMBLE.serialize_cdr(types[TRANSFORM]([one]), TRANSFORM))


def diagnostics(estimate: Estimate, stamp: Any) -> bytes:
    """Return the diagnostic_msgs/DiagnosticArray about an Estimate, in CDR: OK with a claimed pose."""
    types, possible = HUMBLE.types, estimate.world or estimate.local
    sigma = estimate.covariance.position_sigma if estimate.covariance is not None else ""
    values = {
        "tick": estimate.tick,
        "hypotheses": len(possible),
        "frame": "world" if estimate.world else "local",
        "probability": estimate.probabilities[0] if estimate.probabilities else "",
        "position_sigma_m": sigma,
    }
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=OK if estimate.localised else WARNING,
        name="tandem: localisation",
        message="localised" if estimate.localised else f"{len(possible)} hypotheses",
        hardware_id=estimate.robot,
        values=[types["diagnostic_msgs/msg/KeyValue"](name, str(one)) for name, one in values.items()],
    )
    return bytes(HUMBLE.serialize_cdr(types[DIAGNOSTICS](_header("", stamp), [status]), DIAGNOSTICS))


def _header(frame: str, stamp: Any) -> Any:
    return HUMBLE.types["std_msgs/msg/Header"](stamp, frame)


def _turned(heading: float) -> Any:
    half = 0.5 * heading
    return HUMBLE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(half), math.cos(half))


NO_STAMP = HUMBLE.types["builtin_interfaces/msg/Time"](0, 0)
"""The stamp of a TwistStamped, which controllers replace by the time of arrival, in their own clock."""


def odometry(message: Any) -> Pose:
    """Return the pose in a nav_msgs/Odometry: m, m, and rad in (-pi, pi].

    Raises ValueError if a value is not finite, or the orientation is none of an upright robot.
    """
    at, q = message.pose.pose.position, message.pose.pose.orientation
    if not all(map(math.isfinite, (at.x, at.y, q.x, q.y, q.z, q.w))):
        raise ValueError("a pose that is not finite")
    return Pose(float(at.x), float(at.y), heading_of(q.x, q.y, q.z, q.w))


def ranged(message: Any, reach: float) -> float | None:
    """Return the range in a sensor_msgs/Range, in m; None beyond `reach` m or max_range, and for +inf.

    A min_range or max_range of 0 is no limit. Raises TooClose for -inf or a range below min_range, and
    ValueError if the range or a limit is invalid.
    """
    rho, least, most = float(message.range), float(message.min_range), float(message.max_range)
    if math.isnan(rho):
        raise ValueError("a range that is not a number")
    if not (0.0 <= least < math.inf and (most == 0.0 or least <= most)):
        raise ValueError(f"limits that are none: min_range {least:.6g} m, max_range {most:.6g} m")
    if rho == TOO_CLOSE:
        raise TooClose("too close to measure (-inf)")
    if rho <= 0.0:
        raise ValueError(f"a range of {rho:.6g} m, which no radio measures")
    if rho < least:
        raise TooClose(f"too close to measure: {rho:.6g} m, min_range is {least:.6g} m")
    return rho if rho <= min(most or math.inf, reach) else None


def executed(before: Pose, after: Pose, period: float) -> Controls:
    """Return the constant controls that lead from `before` to `after` in `period` s: the inverse of eq. (1a).

    Headings must not be wrapped. Lateral slip is ignored.
    """
    turn = after.heading - before.heading
    course = before.heading + 0.5 * turn
    ahead = relative(Pose(before.x, before.y, course), after).x
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
        stamped: str = "false",
        pose: str = "pose",
        tf: str = "tf",
        diagnostics: str = "diagnostics",
        map_frame: str = "map",
        domain: str = "",
    ) -> None:
        """Connect to the bridge at the Zenoh endpoint `connect`. The other options are names of topics.

        In a group or a team, the range to robot ID is on the topic `peer_range`/ID, in a team that to the
        anchor ID on `anchor_range`/ID. If `stamped` is "true", messages on
        `cmd_vel` are TwistStamped, otherwise Twist. `map_frame` is the name of the frame of the anchors.
        With a ROS domain, `domain`, it talks to rmw_zenoh by the router at `connect`, in place of a bridge.

        Raises TimeoutError if there is no bridge within BRIDGE_S, and ValueError.
        """
        if stamped not in ("true", "false"):
            raise ValueError(f"stamped: '{stamped}', expected true or false")
        self._stamped = stamped == "true"
        self._mission, self._manoeuvre_s = config.mission, manoeuvre_s
        self._changed = threading.Condition()
        self._pose: tuple[Pose, float] | None = None
        """The latest pose, with its heading not wrapped, and the time of its arrival."""
        self._ranges: dict[str, tuple[float | None, float]] = {}
        """The latest range by topic, and the time of its arrival; TOO_CLOSE only if there are drop-outs."""
        self._refused: dict[str, tuple[str, float]] = {}
        """The reason by topic why the latest invalid message was refused, and the time of its arrival."""
        self._frames: tuple[str, str] | None = None
        """The frames of the odometry: that of the pose, and that of the robot."""
        self._map_frame, self._tick, self._stamp = map_frame, -1, NO_STAMP
        """The frame of the anchors, the tick of the latest reading, and the stamp of the latest odometry."""
        self._odometry_in_map: Pose | None = None
        """The frame of the odometry in that of the anchors; None while the robot does not claim its pose."""
        self._unsuitable: str | None = None
        """The reason why a sensor cannot serve this mission; None if it can."""
        self._last: Pose | None = None
        """The pose at the previous reading."""
        self._rest_since = time.monotonic()
        """The time at which the robot stops, or has stopped."""
        self._command = threading.Event()
        """The event that ends the current manoeuvre."""
        self._command.set()  # there is no manoeuvre yet
        several = bool(config.members) or config.team is not None
        self._anchor = None if config.given_anchor is None else anchor_range
        """The topic of the range to the robot's own anchor, if it has one."""
        self._anchors = {one: f"{anchor_range}/{one}" for one in config.ranges}
        """The topic of the range to each anchor of the team."""
        self._peers = {one: f"{peer_range}/{one}" if several else peer_range for one in config.others}
        """The topic of the range to each other robot."""
        self._open = ExitStack()
        give_up = time.monotonic() + BRIDGE_S

        def unanswered() -> None:
            if time.monotonic() >= give_up:
                raise TimeoutError(f"no bridge at {connect}")
            time.sleep(0.05)

        link = self._open.enter_context(session.open_client(at(connect), unanswered))
        self._node = RosTopics(link, f"tandem_{config.robot}".replace("-", "_"), domain)
        out = ((cmd_vel, STAMPED if self._stamped else TWIST), (pose, POSE), (tf, TRANSFORM))
        self._cmd_vel, self._claimed, self._tf, self._diagnostics = [
            self._node.publisher(topic, kind) for topic, kind in (*out, (diagnostics, DIAGNOSTICS))
        ]
        self._odom = odom
        self._node.subscribe(odom, ODOMETRY, self._on_odometry)
        own = () if self._anchor is None else (self._anchor,)
        self._topics = (*own, *self._anchors.values(), *self._peers.values())
        for topic in self._topics:
            self._node.subscribe(topic, RANGE, self._on_range(topic))

    def sense(self, tick: int) -> Reading:
        """Return the messages that have arrived since the robot stopped.

        Raises TimeoutError if odometry is missing, or a range without drop-outs in the mission; ValueError if
        a sensor is unsuitable.
        """
        now = time.monotonic()
        since = min(self._rest_since, now)
        give_up = now + (SENSING * self._manoeuvre_s if tick else BRIDGE_S)
        with self._changed:
            self._changed.wait_for(lambda: self._unsuitable or self._is_all_here(since), give_up - now)
            if self._unsuitable is not None:
                raise ValueError(self._unsuitable)
            if self._pose is None or self._pose[1] < since:
                raise TimeoutError(f"no odometry since the robot stopped{self._why(self._odom, since)}")
            pose, _ = self._pose
            driven = executed(self._last or pose, pose, self._mission.period)
            self._last, self._tick = pose, tick
            anchor_range = self._fresh(self._anchor, since) if self._anchor is not None else None
            anchors = {one: self._fresh(topic, since) for one, topic in self._anchors.items()}
            mutual = [(robot, self._fresh(topic, since)) for robot, topic in self._peers.items()]
            return Reading(
                driven,
                _measured(anchor_range),
                mark=(pose.x, pose.y, pose.heading),
                mutual_ranges={robot: _measured(rho) for robot, rho in mutual if rho is not None},
                anchors={one: _measured(rho) for one, rho in anchors.items()},
            )

    def drive(self, v: float, omega: float) -> None:
        """Start to publish the velocities repeatedly for the duration of a manoeuvre, and then zero."""
        self._end_drive()
        ended = self._command = threading.Event()
        faster = self._mission.period / self._manoeuvre_s  # 1 in real time
        payload, until = self._twist(v * faster, omega * faster), time.monotonic() + self._manoeuvre_s
        self._rest_since = until

        def publish() -> None:
            while not ended.is_set() and (left := until - time.monotonic()) > 0.0:
                self._cmd_vel(payload)
                ended.wait(min(left, self._manoeuvre_s / REPEATS))
            self._cmd_vel(self._twist(0.0, 0.0))

        self._publisher = threading.Thread(target=publish, daemon=True)
        self._publisher.start()

    def estimated(self, estimate: Estimate) -> None:
        """Publish diagnostics, and a claimed pose; its transform follows with each odometry."""
        with self._changed:
            if estimate.tick != self._tick or self._last is None:
                return  # the robot has moved since
            pose = estimate.world[0] if estimate.localised and estimate.world else None
            self._odometry_in_map = compose(pose, inverse(self._last)) if pose is not None else None
            stamp = self._stamp
        if pose is not None:
            self._claimed(claimed(pose, estimate.covariance, self._map_frame, stamp))
        self._diagnostics(diagnostics(estimate, stamp))

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
        self._cmd_vel(self._twist(0.0, 0.0))

    def close(self) -> None:
        """Stop the robot and disconnect from the bridge."""
        self.stop()
        self._open.close()

    def _twist(self, v: float, omega: float) -> bytes:
        return twist(v, omega, stamped=self._stamped)

    def _end_drive(self) -> None:
        if not self._command.is_set():
            self._command.set()
            self._publisher.join()

    # --- callbacks, on Zenoh's threads ---

    def _on_odometry(self, payload: bytes) -> None:
        try:
            message = decoded(payload, ODOMETRY)
            pose, frames = odometry(message), (message.header.frame_id, message.child_frame_id)
            if self._frames not in (None, frames):
                raise ValueError(f"frames {frames}, expected {self._frames}: is there another publisher?")
        except ValueError as error:
            self._refuse(self._odom, error)
            return
        with self._changed:
            self._frames, self._stamp = frames, message.header.stamp
            in_map = self._odometry_in_map
            before = self._pose[0] if self._pose is not None else ORIGIN
            heading = before.heading + wrap(pose.heading - before.heading)
            self._pose = Pose(pose.x, pose.y, heading), time.monotonic()
            self._changed.notify_all()
        if in_map is not None:
            self._tf(transform(in_map, self._map_frame, frames[0], message.header.stamp))

    def _on_range(self, topic: str) -> Callable[[bytes], None]:
        reach, drop_outs = self._mission.sensing_range, self._mission.noise.drop_outs

        def take(payload: bytes) -> None:
            unsuitable = None
            try:
                message = decoded(payload, RANGE)
                rho = ranged(message, reach)
                if 0.0 < message.max_range < reach * (1.0 - SINGLE):
                    unsuitable = f"{topic}: max_range is {message.max_range:.6g} m, less than the mission's "
                    unsuitable += f"sensing_range of {reach:g} m: reduce that"
            except ValueError as error:
                if not (drop_outs and isinstance(error, TooClose)):
                    self._refuse(topic, error)
                    return
                rho = TOO_CLOSE
            with self._changed:
                self._unsuitable = self._unsuitable or unsuitable
                self._ranges[topic] = rho, time.monotonic()
                self._changed.notify_all()

        return take

    def _refuse(self, topic: str, error: ValueError) -> None:
        with self._changed:
            self._refused[topic] = str(error), time.monotonic()

    # --- freshness of messages ---

    def _is_all_here(self, since: float) -> bool:
        came = [self._pose[1] if self._pose else 0.0]
        came += [self._ranges[topic][1] for topic in self._topics if topic in self._ranges]
        return len(came) == 1 + len(self._topics) and min(came) >= since

    def _fresh(self, topic: str, since: float) -> float | None:
        """Return the range in m that arrived on `topic` since then; None if it is out of range, or missing.

        It is TOO_CLOSE if there is none for that reason, and the mission has drop-outs.

        Raises TimeoutError if it is missing and the mission has no drop-outs.
        """
        rho, came = self._ranges.get(topic, (None, -math.inf))
        if came >= since:
            return rho
        if not self._mission.noise.drop_outs:
            why = self._why(topic, since)
            what = f"{'no range' if why else 'nothing'} on {topic} since the robot stopped"
            raise TimeoutError(f"{what}, and the mission has no drop-outs{why}")
        return None

    def _why(self, topic: str, since: float) -> str:
        """Return why the latest invalid message on `topic` since then was refused; "" if there is none."""
        why, came = self._refused.get(topic, ("", -math.inf))
        return f": {why}" if came >= since else ""


def _measured(rho: float | None) -> float | None:
    return None if rho == TOO_CLOSE else rho
