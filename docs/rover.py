"""A robot that is nowhere but in its own process: a driver to copy from, and the ranging between two of them.

    uv run docs/rover.py --port 4747 --reach 3                # the beacon: ranges one robot from the other
    uv run tandem robot a --mission paper-1 --driver docs.rover:Rover --rate 4 --listen tcp/127.0.0.1:7447 \
        --option start=2.4,-1.2,4.8 --option beacon=127.0.0.1:4747
    uv run tandem robot b --mission paper-1 --driver docs.rover:Rover --rate 4 --connect tcp/127.0.0.1:7447 \
        --option start=11.3,-0.4,3.6 --option beacon=127.0.0.1:4747

There is no world: each robot moves by its own kinematics, and only the beacon, which stands for an
ultra-wideband exchange between the two, hears from both where they are. Nobody tells the agents.
"""

from __future__ import annotations

import argparse
import json
import math
import socket
import time
from contextlib import suppress
from pathlib import Path

import msgspec

from protocol.messages import RobotConfig
from protocol.motion import REST, Controls, Pose, step, wrap
from world.hardware.driver import Reading

ASK_AGAIN_S = 0.05
"""a datagram may be lost"""


class Rover:
    """Wheels, odometry, an anchor's range and the peer's, all without error."""

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
        """`start` is x,y,heading in <W>, which no agent is told; `beacon` HOST:PORT, or there is no peer.

        `state` is a file that stands for the robot's body, which outlasts this process: where it is, and what
        its wheels are at. `timeout` (s) bounds the wait for the peer to stand in the same tick: this robot
        has no drop-outs, and rather than call silence what is none, it gives up.
        """
        self._config = config
        self._manoeuvre_s = manoeuvre_s
        anchor = config.anchor
        self.pose = (
            Pose(*[float(word) for word in start.split(",")])
            if start
            else Pose(anchor.x + 0.1, anchor.y - 0.2, 0.7)
        )
        """where it truly was at the last reading"""
        self._controls = REST
        self._began = 0.0
        self._done = 1.0
        """how much of the manoeuvre is in `pose`"""
        self._driven = REST
        """since the last reading"""
        self._executed = REST
        """what that told"""
        self._tick = 0
        self._give_up_s = float(timeout)
        self._state = Path(state) if state else None
        self._found = self._state is not None and self._state.exists()
        """whether where the body is has been found, and not made up"""
        if self._state is not None and self._found:
            self._load(self._state)
        host, _, port = beacon.rpartition(":")
        self._radio = socket.socket(socket.AF_INET, socket.SOCK_DGRAM) if beacon else None
        if self._radio is not None:
            self._radio.settimeout(ASK_AGAIN_S)
            self._radio.connect((host, int(port)))

    def sense(self, tick: int) -> Reading:
        """Where it has come to, and what is in range there."""
        self._settle()
        executed, self._driven = self._driven, REST
        self._tick, self._executed = tick, executed
        self._save()
        anchor, reach = self._config.anchor, self._config.mission.sensing_range
        rho = math.hypot(self.pose.x - anchor.x, self.pose.y - anchor.y)
        return Reading(executed, rho if rho <= reach else None, self._mutual_range(tick))

    def drive(self, v: float, omega: float) -> None:
        """Hold them for a manoeuvre; what was left of the one before is not driven any more."""
        self._settle()
        self._controls, self._began, self._done = Controls(v, omega), time.monotonic(), 0.0
        self._save()

    def resume(self, tick: int, mark: tuple[float, ...]) -> None:  # noqa: ARG002  # the state tells enough
        """Take back a reading that nobody has put on record. Raises RuntimeError if there was no `state`."""
        if not self._found:
            raise RuntimeError("where the body was is not known without --option state=FILE")
        if self._tick > tick:
            self._driven = Controls(
                self._executed.v + self._driven.v, self._executed.omega + self._driven.omega
            )

    def stop(self) -> None:
        """Stand, and stay in range of whoever ranges it."""
        self._settle()
        if self._done < 1.0:
            self._controls, self._done = REST, 1.0
        self._save()
        self._tell(self._tick, parked=True)

    def close(self) -> None:
        """Nobody else will say where it was."""
        if self._radio is not None:
            self._radio.close()
        x, y, heading = self.pose.x, self.pose.y, wrap(self.pose.heading)
        print(f"{self._config.robot}: truly at {x:.9f} {y:.9f} {heading:+.9f}", flush=True)

    def _settle(self) -> None:
        """Move `pose` to where the wheels have come by now, and count what took it there."""
        share = min(1.0, (time.monotonic() - self._began) / self._manoeuvre_s) - self._done
        self._done += share
        v, omega = self._controls.v * share, self._controls.omega * share
        self.pose = step(self.pose, v, omega, self._config.mission.period)
        self._driven = Controls(self._driven.v + v, self._driven.omega + omega)

    def _save(self) -> None:
        """Put on file where the body is, and what its wheels are at, whole or not at all."""
        if self._state is not None:
            wheels = self._controls, self._began, self._done
            body = self.pose, *wheels, self._driven, self._executed, self._tick
            draft = self._state.with_suffix(".draft")
            draft.write_bytes(msgspec.json.encode(body))
            draft.replace(self._state)

    def _load(self, state: Path) -> None:
        kinds = tuple[Pose, Controls, float, float, Controls, Controls, int]
        body = msgspec.json.decode(state.read_bytes(), type=kinds)
        self.pose, self._controls, self._began, self._done, self._driven, self._executed, self._tick = body

    def _mutual_range(self, tick: int) -> float | None:
        """m; none if the peer, standing in the same tick, is out of range. Raises TimeoutError."""
        give_up = time.monotonic() + self._give_up_s
        while self._radio is not None and time.monotonic() < give_up:
            self._tell(tick)
            try:
                said = json.loads(self._radio.recv(1024))
            except TimeoutError:
                continue
            except ConnectionRefusedError:  # there is no beacon; to be told so takes no time
                time.sleep(ASK_AGAIN_S)
                continue
            if said["tick"] == tick:
                return said["range"] if said["range"] is None else float(said["range"])
        if self._radio is None:
            return None
        raise TimeoutError(f"no answer of the beacon for {self._give_up_s:g} s")

    def _tell(self, tick: int, *, parked: bool = False) -> None:
        where = {"robot": self._config.robot, "peer": self._config.peer, "tick": tick, "parked": parked}
        if self._radio is not None:
            with suppress(ConnectionRefusedError):  # what was sent before found no beacon
                self._radio.send(json.dumps(where | {"x": self.pose.x, "y": self.pose.y}).encode())


def main() -> None:
    """The beacon: answers a robot once its peer stands in the same tick, or is parked."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--reach", type=float, required=True, help="R, in m")
    options = parser.parse_args()
    air = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    air.bind(("127.0.0.1", options.port))
    print(f"ranging at 127.0.0.1:{air.getsockname()[1]}", flush=True)
    told: dict[tuple[str, str], tuple[float, float]] = {}
    senders: dict[str, tuple[str, int]] = {}
    latest: dict[str, int] = {}
    while True:
        message, sender = air.recvfrom(1024)
        one = json.loads(message)
        robot, peer, tick = one["robot"], one["peer"], one["tick"]
        senders[robot] = sender
        told.pop((robot, "parked"), None)  # it goes on, or is parked elsewhere
        for again in range(tick, latest.get(robot, tick)):  # it begins anew
            told.pop((robot, str(again + 1)), None)
            told.pop((robot, str(again)), None)
        latest[robot] = tick
        place = told.setdefault((robot, "parked" if one["parked"] else str(tick)), (one["x"], one["y"]))
        other = told.get((peer, str(tick)), told.get((peer, "parked")))
        if other is not None and not one["parked"]:
            rho = math.dist(place, other)
            answer = json.dumps({"tick": tick, "range": rho if rho <= options.reach else None}).encode()
            for name in {robot, peer} & senders.keys():
                air.sendto(answer, senders[name])
        elif latest.get(peer, tick) > tick:  # and will not stand in this one any more
            air.sendto(json.dumps({"tick": tick, "range": None}).encode(), sender)


if __name__ == "__main__":
    main()
