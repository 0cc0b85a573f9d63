"""A driver of one's own: a simulated cart whose wheels slip and whose ranges are noisy.

`uv run docs/examples/own_driver.py` checks it against the contract of docs/driver.md.
"""

from __future__ import annotations

import math
import random
import subprocess
import sys
import time

from protocol.messages import RobotConfig
from protocol.motion import REST, Controls, Pose, step
from world.hardware.driver import Reading

SLIP = 0.01
"""The part by which the cart moves less than its wheels turn."""
SIGMA_M = 0.02
"""The standard deviation of a range in m."""


class Cart:
    """A cart that starts at a fixed place near its anchor. Nothing here reports its true pose."""

    def __init__(self, config: RobotConfig, manoeuvre_s: float, *, seed: str = "1") -> None:
        """`manoeuvre_s` is the time in s that a manoeuvre takes; `seed` is given by `--option seed=N`."""
        self._config, self._manoeuvre_s = config, manoeuvre_s
        self._random = random.Random(seed)
        self._pose = Pose(config.anchor.x + 2.4, config.anchor.y - 1.2, 4.8)
        self._controls, self._began, self._part = REST, 0.0, 1.0
        self._odometry = REST

    def sense(self, tick: int) -> Reading:  # noqa: ARG002  # the contract has it
        """Return what the wheels have turned since the last reading, and the range to the anchor."""
        self._advance()
        executed, self._odometry = self._odometry, REST
        anchor = self._config.anchor
        distance = math.hypot(self._pose.x - anchor.x, self._pose.y - anchor.y)
        in_range = distance <= self._config.mission.sensing_range
        measured = max(0.0, self._random.gauss(distance, SIGMA_M)) if in_range else None
        return Reading(executed, measured, None, False)

    def drive(self, v: float, omega: float) -> None:
        """Begin a manoeuvre at `v` m/s and `omega` rad/s."""
        self._advance()
        self._controls, self._began, self._part = Controls(v, omega), time.monotonic(), 0.0

    def stop(self) -> None:
        """Stop at once."""
        self._advance()
        self._controls, self._part = REST, 1.0

    def close(self) -> None:
        """Do nothing: there is no hardware to release."""

    def _advance(self) -> None:
        """Move the cart to where its wheels have taken it by now."""
        part = min(1.0, (time.monotonic() - self._began) / self._manoeuvre_s) - self._part
        self._part += part
        v, omega = self._controls.v * part, self._controls.omega * part
        self._pose = step(self._pose, (1.0 - SLIP) * v, omega, self._config.mission.period)
        self._odometry = Controls(self._odometry.v + v, self._odometry.omega + omega)


def main() -> None:
    """Run `tandem check-driver` on the cart, in a mission that tells robots this noise."""
    driver = ("check-driver", "docs.examples.own_driver:Cart", "--mission", "noisy", "--rate", "10")
    subprocess.run([sys.executable, "-m", "tandem", *driver], check=True)


if __name__ == "__main__":
    main()
