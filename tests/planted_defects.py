"""Defects, each of which `tests.expected` must find: `python -m tests.planted_defects DEFECT [ARGUMENTS]`.

The command plants a defect in this process, from which those of the trials are forked, and runs
`tests.expected` with the arguments. The exit status is 1 if it was found.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import numpy as np
from msgspec.structs import replace

from agent.estimation import judged, posterior
from agent.estimation.gaussian import mission_measurements, search
from agent.estimation.gaussian.range_weights import Weighing
from agent.planning import phase3_last_manoeuvre
from compose.scenario import group_meetings
from protocol.mission import Mission
from protocol.noise import Noise
from tests.expected.__main__ import main
from world import channel
from world.random_streams import uniform
from world.sensor_model import SensorModel


def wrapped(owner: Any, name: str, change: Callable[..., Any]) -> None:
    """Replace the function `name` of `owner` by `change`, which gets it as its first argument."""
    before = getattr(owner, name)
    setattr(owner, name, wraps(before)(lambda *given, **named: change(before, *given, **named)))


def sigma() -> None:
    """Ranges are weighted with 0.8 of their sigma."""

    def scaled(before: Any, *given: Any, **named: Any) -> Any:
        found = before(*given, **named)
        return replace(found, ranges=replace(found.ranges, sigma=0.8 * found.ranges.sigma))

    wrapped(mission_measurements, "near_anchors", scaled)


def confidence() -> None:
    """The confidence of a claim is 0.99."""
    setattr(Mission, "confidence", property(lambda _: 0.99))  # noqa: B010


def gate() -> None:
    """The gate of outliers is twice as wide."""

    before = Weighing.of

    def wide(*given: Any, **named: Any) -> Weighing:
        by = before(*given, **named)
        farther = [by.inlier + 4.0 * (share - by.inlier) for share in (by.outlier, by.stray)]
        return by._replace(outlier=farther[0], stray=farther[1])

    setattr(Weighing, "of", staticmethod(wide))  # noqa: B010  # mypy takes it for a method


def hypothesis() -> None:
    """One hypothesis in fifty is dropped."""

    def fewer(before: Any, found: Sequence[Any], measured: Any) -> Any:
        return before([one for one in found if zlib.crc32(one.guess.tobytes()) % 50], measured)

    for module in (posterior, search):
        wrapped(module, "hypotheses_of", fewer)


def prior() -> None:
    """The prior of the scale of odometry is left out."""
    before = vars(Noise)["priors"].func
    setattr(  # noqa: B010
        Noise, "priors", property(lambda noise: before(noise)._replace(wheel_scale=0.0))
    )


def loss() -> None:
    """One report in a hundred is lost."""

    def lossy(before: Any, links: Any, bursts: Any, active: Any, seed: int, tick: int, delay: int = 0) -> Any:
        lost = uniform(seed, "planted", links.name, tick) < 0.01
        return [] if lost else before(links, bursts, active, seed, tick, delay)

    wrapped(channel, "_sent", lossy)


def manoeuvre() -> None:
    """The last manoeuvre is the second best of those compared."""

    def second(before: Any, value: Any) -> Any:
        less = value.copy()
        less[before(value)] = -np.inf
        return before(less)

    wrapped(phase3_last_manoeuvre, "_best", second)


def bound() -> None:
    """The bound of groups is 20 % short."""

    def short(before: Any, visitor: str, visited: str, ends: float, *given: Any) -> Any:
        return before(visitor, visited, 0.8 * ends, *given)

    wrapped(group_meetings, "PlannedMeeting", short)


def bias() -> None:
    """Simulated ranges are 0.02 m too long."""

    def longer(before: Any, *given: Any) -> Any:
        rho = before(*given)
        return None if rho is None else rho + 0.02

    wrapped(SensorModel, "measured", longer)


def consistency() -> None:
    """The test of consistency never alarms."""
    wrapped(
        judged, "consistency_test", lambda before, *given: before(*given)._replace(sigmas=0.0, p_value=1.0)
    )


DEFECTS: dict[str, Callable[[], None]] = {
    one.__name__: one
    for one in (
        sigma,
        confidence,
        gate,
        hypothesis,
        prior,
        loss,
        manoeuvre,
        bound,
        bias,
        consistency,
    )
}

if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in DEFECTS:
        sys.exit(f"{__doc__}\n" + "\n".join([f"{name}: {one.__doc__}" for name, one in DEFECTS.items()]))
    DEFECTS[sys.argv[1]]()
    sys.exit(main(sys.argv[2:]))
