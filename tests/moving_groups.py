"""Facts of simulated groups for tests: robots that move, with noise, ranges to anchors and to each other.

A fact is known by its robot, its tick and its kind, and those of a list are in any order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.facts import AnchorPlace, Manoeuvre, MeasuredRange, MeasuredRow, StartPose
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.measured_rows import of_rows
from agent.estimation.gaussian.odometry_noise import STRAY_DISTANCE, STRAY_TURN, track
from protocol.motion import Pose, step
from protocol.noise import Noise, VelocityNoise

Array = NDArray[np.float64]

PERIOD_S = 1.0
NOISE = Noise(
    0.05,
    0.05,
    odometry=VelocityNoise(v=0.02, omega=0.02, v_floor=0.005, omega_floor=0.005),
    gyro_bias=0.002,
)


class FactKey(NamedTuple):
    """The key of a fact."""

    robot: str
    """The robot, or the anchor of the kind `anchor`. Of a mutual range, the smaller of the two names."""
    tick: int
    kind: str
    other: str = ""
    """The other robot of a mutual range, or the anchor of an anchor range."""


class Fact(NamedTuple):
    """A key with its value."""

    key: FactKey
    value: Manoeuvre | MeasuredRange | AnchorPlace | StartPose


def anchor(name: str, x: float, y: float, sigma: float = 0.0) -> Fact:
    """Return the fact that an anchor is at x, y (m), with a `sigma` (m); infinite: it is not known where."""
    unknown = sigma == math.inf
    return Fact(FactKey(name, 0, "anchor"), AnchorPlace(0.0 if unknown else x, 0.0 if unknown else y, sigma))


def anchor_range(robot: str, name: str, tick: int, rho: float, sigma: float) -> Fact:
    """Return the range `rho` (m) of `robot` to an anchor."""
    return Fact(FactKey(robot, tick, "anchor range", name), MeasuredRange(rho, sigma))


def mutual_range(robot: str, other: str, tick: int, rho: float, sigma: float) -> Fact:
    """Return the range `rho` (m) that `robot` has measured to another one."""
    first, second = sorted((robot, other))
    return Fact(FactKey(first, tick, "mutual range", second), MeasuredRange(rho, sigma, robot == second))


def manoeuvre(robot: str, tick: int, measured: Manoeuvre) -> Fact:
    """Return the motion that `robot` has `measured` from `tick` to the next."""
    return Fact(FactKey(robot, tick, "manoeuvre"), measured)


def start_pose(robot: str, x: float, y: float, heading: float) -> Fact:
    """Return the pose of `robot` at tick 0, in m and rad."""
    return Fact(FactKey(robot, 0, "start"), StartPose(x, y, heading))


def joint_measurements(
    facts: Sequence[Fact], noise: Noise, period: float, reach: float = math.inf
) -> JointMeasurements:
    """Return the measurements in `facts`. The path of a robot reaches to its first unknown manoeuvre."""
    places = {key.robot: value for key, value in facts if isinstance(value, AnchorPlace)}
    starts = {key.robot: value for key, value in facts if isinstance(value, StartPose)}
    steps: dict[str, list[Manoeuvre]] = {name: [] for name in robots_of(facts)}
    for key, value in sorted(facts, key=lambda one: one.key):
        if isinstance(value, Manoeuvre) and key.tick == len(steps[key.robot]):
            steps[key.robot].append(value)
    rows = [
        MeasuredRow(key.kind == "mutual range", key.robot, key.other, key.tick, value)
        for key, value in facts
        if isinstance(value, MeasuredRange)
    ]
    return of_rows(places, starts, steps, rows, noise, period, reach)


def robots_of(facts: Sequence[Fact]) -> list[str]:
    """Return the names of all robots with a manoeuvre, a range or a start, in their order."""
    names = {key.robot for key, _ in facts if key.kind != "anchor"}
    return sorted(names | {key.other for key, _ in facts if key.kind == "mutual range"})


class MovingGroup(NamedTuple):
    """The facts of a group, and the truth."""

    facts: list[Fact]
    noise: Noise
    starts: Array
    """The true pose of each robot at tick 0; shape (n, 3)."""
    ends: Array
    """The true pose of each robot at the last tick; shape (n, 3)."""
    paths: Array
    """The true x and y of each robot at each tick; shape (n, 2, k + 1)."""
    delay: float
    """The delay of all ranges in s."""
    share: float
    """The share of depth in all ranges, along the heading of the robot that has measured."""

    @property
    def robots(self) -> list[str]:
        """The names of the robots."""
        return robots_of(self.facts)

    @property
    def anchors(self) -> list[Fact]:
        """The places of the anchors, in the order of their names."""
        return sorted([one for one in self.facts if one.key.kind == "anchor"])


def moving_group(
    robots: int,
    seed: int,
    *,
    ticks: int = 40,
    noise: Noise = NOISE,
    unanchored: Sequence[int] = (),
    neighbours: int | None = None,
    outliers: float = 0.0,
) -> MovingGroup:
    """Return `robots` that move beside their anchors, with a range in every second tick.

    Those in `unanchored` have ranges to no anchor. Each ranges with the next `neighbours`; None: with all.
    All errors are drawn from the model that `noise` tells, and a fraction of `outliers` is 0.5 to 1.5 m long.
    """
    draw, priors = np.random.default_rng((robots, seed)), noise.priors
    side = 4.0 * math.sqrt(robots)
    names = [f"r{i:02}" for i in range(robots)]
    centres = draw.uniform(0.0, side, (robots, 2))
    bias, scale = priors.range_bias * draw.normal(), priors.range_scale * draw.normal()
    delay = priors.range_delay * draw.normal() if priors.range_delay else 0.0
    shares = np.random.default_rng((robots, seed, robots)).normal(size=2)
    share, side = priors.range_depth * shares[0], priors.range_aside * shares[1]
    headings = np.empty((robots, ticks + 1))
    late: list[Array] = []
    pair_bias: dict[frozenset[str], float] = {}
    known: list[Fact] = []
    starts, ends, paths = np.empty((robots, 3)), np.empty((robots, 3)), np.empty((robots, 2, ticks + 1))
    for i, name in enumerate(names):
        phase = draw.uniform(0.0, math.tau)
        v = 0.3 + 0.1 * np.sin(0.5 * np.arange(ticks) + phase)
        omega = 0.45 * np.sign(np.sin(0.3 * np.arange(ticks) + phase)) + 0.1 * draw.normal(size=ticks)
        starts[i] = *(centres[i] + draw.normal(0.0, 1.0, 2)), draw.uniform(-math.pi, math.pi)
        path = track(v, omega, PERIOD_S)
        c, s = math.cos(starts[i, 2]), math.sin(starts[i, 2])
        paths[i] = starts[i, :2, None] + np.stack((c * path.x - s * path.y, s * path.x + c * path.y))
        ends[i] = *paths[i, :, -1], starts[i, 2] + path.heading[-1]
        turns = headings[i] = starts[i, 2] + path.heading
        at = [Pose(x, y, heading) for x, y, heading in zip(*paths[i], turns, strict=True)]
        before = map(step, at, -np.append(0.0, v), -np.append(0.0, omega), [delay] * len(at))
        late.append(np.array([(pose.x, pose.y) for pose in before]).T)
        of_v, of_omega, of_gyro = draw.normal(size=3) * (
            priors.wheel_scale,
            priors.wheel_scale,
            priors.gyro_bias,
        )
        sigmas = np.sqrt([noise.odometry.variances(a, b) for a, b in zip(v, omega, strict=True)])
        measured_v = v / (1.0 + of_v) + sigmas[:, 0] * draw.normal(size=ticks)
        measured_omega = (omega - of_gyro) / (1.0 + of_omega) + sigmas[:, 1] * draw.normal(size=ticks)
        strays = np.random.default_rng((robots, seed, i))
        stray = strays.uniform(size=ticks) < noise.odometry_strays
        measured_v *= 1.0 + STRAY_DISTANCE * stray * strays.normal(size=ticks)
        measured_omega += STRAY_TURN / PERIOD_S * stray * strays.normal(size=ticks)
        known += [
            manoeuvre(name, tick, Manoeuvre(a, b))
            for tick, (a, b) in enumerate(zip(measured_v.tolist(), measured_omega.tolist(), strict=True))
        ]

    def measured(names: tuple[str, str], true: float) -> float:
        own = pair_bias.setdefault(frozenset(names), priors.pair_bias * draw.normal())
        more = draw.uniform(0.5, 1.5) if draw.uniform() < outliers else 0.0
        return max(true * (1.0 + scale) + bias + own + noise.mutual_sigma * draw.normal() + more, 0.0)

    def seen(i: int, tick: int, away: Array) -> float:
        """Return the distance of what is `away` from robot i, in part what its camera measures instead."""
        c, s = math.cos(headings[i, tick]), math.sin(headings[i, tick])
        ahead, left = c * away[0] + s * away[1], c * away[1] - s * away[0]
        return float((1.0 - share) * np.hypot(*away) + share * ahead + side * left)

    for i, name in enumerate(names):
        if i in unanchored:
            continue
        known.append(anchor(f"M{name}", *centres[i].tolist()))
        for tick in range(0, ticks + 1, 2):
            rho = measured((name, "anchor"), seen(i, tick, centres[i] - late[i][:, tick]))
            known.append(anchor_range(name, f"M{name}", tick, rho, noise.anchor_sigma))
    for i, j in combinations(range(robots), 2):
        if neighbours is not None and min(j - i, robots - j + i) > neighbours:
            continue
        for tick in range(1, ticks + 1, 2):
            one, other = (i, j) if tick % 4 == 1 else (j, i)
            away = late[other][:, tick] - late[one][:, tick]
            rho = measured((names[i], names[j]), seen(one, tick, away))
            known.append(mutual_range(names[one], names[other], tick, rho, noise.mutual_sigma))
    return MovingGroup(sorted(known, key=lambda one: one.key), noise, starts, ends, paths, delay, share)
