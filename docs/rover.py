"""A simulated robot as a driver to copy from, and a process that measures the ranges between such robots.

    uv run docs/rover.py --port 4747 --reach 3                # the beacon: measures mutual ranges
    uv run tandem robot a --mission paper-1 --driver docs.rover:Rover --rate 4 --listen tcp/127.0.0.1:7447 \
        --option start=2.4,-1.2,4.8 --option beacon=127.0.0.1:4747
    uv run tandem robot b --mission paper-1 --driver docs.rover:Rover --rate 4 --connect tcp/127.0.0.1:7447 \
        --option start=11.3,-0.4,3.6 --option beacon=127.0.0.1:4747

There is no simulator process: each robot moves by its own kinematics. Only the beacon, which takes the place
of ultra-wideband exchanges between them, receives their positions. The agents receive none. The robots may be
those of a group or a team.
"""

from __future__ import annotations

import argparse
import json
import math
import socket
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from protocol.messages import RobotConfig
from protocol.mission import Anchor
from protocol.motion import REST, Controls, Pose, step, wrap
from world.hardware.driver import Reading

ASK_AGAIN_S = 0.05
"""s: the interval at which a datagram is repeated, because one may be lost."""
BODY = tuple[Pose, Controls, float, float, Controls, Controls, int]
"""The content of the file `state`: the pose; the command, when it began (s), and the fraction that is driven;
the motion since the last reading; the motion that the last reading reported, and its tick."""


class Rover:
    """A driver whose wheels, odometry and ranges are exact (see `world.hardware.driver.Driver`)."""

    def __init__(
        self,
        config: RobotConfig,
        manoeuvre_s: float,
        *,
        start: str = "",
        beacon: str = "",
        state: str = "",
        timeout: str = "10",
    ) -> None:
        """Place the robot at `start`, "x,y,heading" in <W>, and connect to the `beacon` at "HOST:PORT".

        No agent receives `start`. `state` is a file with the pose and the wheels' motion, which outlast this
        process like a robot's body. `timeout` (s) bounds the wait until all others stand in the same tick.
        After it the driver raises: this robot has no drop-outs, so it must not report a missing range.
        """
        self._config = config
        self._manoeuvre_s = manoeuvre_s
        self.pose = (
            Pose(*[float(word) for word in start.split(",")])
            if start
            else Pose(config.anchor.x + 0.1, config.anchor.y - 0.2, 0.7)
        )
        """The true pose, up to the part of the manoeuvre that `_done` counts."""
        self._controls = REST
        self._began = 0.0
        self._done = 1.0
        """The fraction of the current manoeuvre that is in `pose`, from 0 to 1."""
        self._driven = REST
        """The motion since the last reading."""
        self._executed = REST
        """The motion that the last reading reported."""
        self._tick = 0
        self._is_under_way = False
        """True once this process has taken or resumed a reading."""
        self._give_up_s = float(timeout)
        self._state = Path(state) if state else None
        self._found = self._state is not None and self._state.exists()
        """True if the pose comes from the file `state`."""
        if self._state is not None and self._found:
            self._load(self._state)
        host, _, port = beacon.rpartition(":")
        self._radio = socket.socket(socket.AF_INET, socket.SOCK_DGRAM) if beacon else None
        if self._radio is not None:
            self._radio.settimeout(ASK_AGAIN_S)
            self._radio.connect((host, int(port)))

    def sense(self, tick: int) -> Reading:
        """Return the motion since the last reading, and the ranges at the pose now."""
        self._settle()
        executed, self._driven = self._driven, REST
        self._tick, self._executed, self._is_under_way = tick, executed, True
        self._save()
        config = self._config
        return Reading(
            executed,
            self._range_to(config.given_anchor),
            mutual_ranges=self._mutual_ranges(tick),
            anchors={
                one.id: self._range_to(one.position)
                for one in (config.team.anchors if config.team is not None else ())
                if one.id in config.ranges
            },
        )

    def drive(self, v: float, omega: float) -> None:
        """Hold `v` and `omega` for a manoeuvre. The rest of the previous manoeuvre is not driven."""
        self._settle()
        self._controls, self._began, self._done = Controls(v, omega), time.monotonic(), 0.0
        self._save()

    def resume(self, tick: int, mark: tuple[float, ...]) -> None:  # noqa: ARG002  # `state` has it all
        """Report an unrecorded reading again, from the same pose. Raises RuntimeError without a `state`."""
        if not self._found:
            raise RuntimeError("where the body was is not known without --option state=FILE")
        self._is_under_way = True
        if self._tick > tick:
            self._driven = Controls(
                self._executed.v + self._driven.v, self._executed.omega + self._driven.omega
            )
            self._controls, self._done = REST, 1.0  # the beacon has the pose of that reading already

    def stop(self) -> None:
        """Stop, and stay available for mutual ranges of others once the mission has ended.

        After a restart others have to wait instead: they must not pass ticks in which this robot moves on.
        """
        self._settle()
        if self._done < 1.0:
            self._controls, self._done = REST, 1.0
        self._save()
        if self._is_under_way:
            self._send(self._tick, parked=True)

    def close(self) -> None:
        """Print the true pose, which no other process knows."""
        if self._radio is not None:
            self._radio.close()
        x, y, heading = self.pose.x, self.pose.y, wrap(self.pose.heading)
        print(f"{self._config.robot}: truly at {x:.9f} {y:.9f} {heading:+.9f}", flush=True)

    def _settle(self) -> None:
        """Move `pose` by what the wheels have driven up to now, and add that to `_driven`."""
        share = min(1.0, (time.monotonic() - self._began) / self._manoeuvre_s) - self._done
        self._done += share
        v, omega = self._controls.v * share, self._controls.omega * share
        self.pose = step(self.pose, v, omega, self._config.mission.period)
        self._driven = Controls(self._driven.v + v, self._driven.omega + omega)

    def _save(self) -> None:
        """Write pose and motion to the file `state`, atomically."""
        if self._state is not None:
            wheels = self._controls, self._began, self._done
            body = self.pose, *wheels, self._driven, self._executed, self._tick
            draft = self._state.with_suffix(".draft")
            draft.write_bytes(msgspec.json.encode(body))
            draft.replace(self._state)

    def _load(self, state: Path) -> None:
        body = msgspec.json.decode(state.read_bytes(), type=BODY)
        self.pose, self._controls, self._began, self._done, self._driven, self._executed, self._tick = body

    def _range_to(self, anchor: Anchor | None) -> float | None:
        """Return the range (m) to an anchor; None if it is beyond R, or its position is unknown."""
        if anchor is None:
            return None
        rho = math.hypot(self.pose.x - anchor.x, self.pose.y - anchor.y)
        return rho if rho <= self._config.mission.sensing_range else None

    def _mutual_ranges(self, tick: int) -> dict[str, float | None]:
        """Return the range (m) to each robot within R in the same tick. Raises TimeoutError."""
        give_up = time.monotonic() + self._give_up_s
        while self._radio is not None and time.monotonic() < give_up:
            self._send(tick)
            try:
                answer = json.loads(self._radio.recv(65536))
            except TimeoutError:
                continue
            except ConnectionRefusedError:  # there is no beacon, and the refusal came at once
                time.sleep(ASK_AGAIN_S)
                continue
            if answer["tick"] == tick:
                return dict(answer["ranges"])
        if self._radio is None:
            return {}
        raise TimeoutError(f"no answer of the beacon for {self._give_up_s:g} s")

    def _send(self, tick: int, *, parked: bool = False) -> None:
        where = {"robot": self._config.robot, "others": self._config.others, "tick": tick, "parked": parked}
        if self._radio is not None:
            with suppress(ConnectionRefusedError):  # of an earlier datagram: there is no beacon
                self._radio.send(json.dumps(where | {"x": self.pose.x, "y": self.pose.y}).encode())


class Beacon:
    """The positions of all robots, by tick: what is measured depends on no robot's process."""

    def __init__(self, reach: float, lost_s: float) -> None:
        """`reach` is R in m. A robot that has sent nothing for `lost_s` has no radio any more."""
        self._reach = reach
        self._lost_s = lost_s
        self._began = time.monotonic()
        self._positions: dict[tuple[str, int | None], tuple[float, float]] = {}
        """The position of a robot in each tick; under None, where it is parked."""
        self._latest: dict[str, int] = {}
        """The latest tick of each robot."""
        self._heard: dict[str, float] = {}
        """The time at which each robot was heard last."""

    def take(self, message: Any) -> None:
        """Note where the robot of `message` is."""
        robot, tick = message["robot"], message["tick"]
        self._heard[robot] = time.monotonic()
        self._positions.pop((robot, None), None)  # it moves again, or is parked elsewhere
        for again in range(tick, self._latest.get(robot, tick)):  # it starts from an earlier tick again
            self._positions.pop((robot, again + 1), None)
            self._positions.pop((robot, again), None)
        self._latest[robot] = tick
        self._positions.setdefault((robot, None if message["parked"] else tick), (message["x"], message["y"]))

    def ranges(self, message: Any) -> dict[str, float] | None:
        """Return the ranges within R of the robot of `message`; None while another may come to its tick."""
        found: dict[str, float] = {}
        robot, tick = message["robot"], message["tick"]
        for other in message["others"]:
            place = self._positions.get((other, tick), self._positions.get((other, None)))
            if place is None and self._latest.get(other, -1) <= tick and not self._is_lost(other):
                return None
            if place is not None:
                rho = math.dist(self._positions[robot, tick], place)
                found |= {other: rho} if rho <= self._reach else {}
        return found

    def _is_lost(self, robot: str) -> bool:
        return time.monotonic() - self._heard.get(robot, self._began) > self._lost_s


def main() -> None:
    """Run the beacon: it answers a robot once all others are in its tick, have left it, or are parked."""
    parser = argparse.ArgumentParser(description=main.__doc__, allow_abbrev=False)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--reach", type=float, required=True, help="the sensing range R, in m")
    parser.add_argument("--lost", type=float, default=math.inf, help="s after which a silent robot is lost")
    options = parser.parse_args()
    radio = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    radio.bind(("127.0.0.1", options.port))
    print(f"ranging at 127.0.0.1:{radio.getsockname()[1]}", flush=True)
    beacon = Beacon(options.reach, options.lost)
    asked: dict[str, tuple[Any, tuple[str, int]]] = {}
    while True:
        message, sender = radio.recvfrom(65536)
        one = json.loads(message)
        beacon.take(one)
        asked.pop(one["robot"], None)
        if not one["parked"]:
            asked[one["robot"]] = one, sender
        for robot, (waiting, where) in list(asked.items()):
            ranges = beacon.ranges(waiting)
            if ranges is not None:
                radio.sendto(json.dumps({"tick": waiting["tick"], "ranges": ranges}).encode(), where)
                asked.pop(robot)


if __name__ == "__main__":
    main()
