"""Checks that a driver conforms to the contract of world/hardware/driver.py, from an exercise.

The checks have no ground truth. They compare the odometry with the commands, and the ranges to the anchor
with the path from the odometry. The docstring of a check is its line in the output of `tandem check-driver`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import median

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares  # type: ignore[import-untyped]

from compose.hardware.exercise import FIRST_HALF, SECOND_HALF, STOPPED_HALF_WAY, ExerciseRun, Try
from compose.terminal.finding import Finding, checked
from protocol.mission import Mission
from protocol.motion import ORIGIN, REST, Controls, Pose, step
from world.hardware.driver import SENSING

PROMPT = 0.05
"""The part of a manoeuvre that `drive` may take to return."""
LIKE = 0.25
"""The relative difference allowed between measured and commanded speeds, because wheels accelerate."""
REST_SPEED = 0.02
"""The part of the maximum speeds below which a robot is at rest."""
EXACT_TOLERANCE = 1e-6
"""The tolerance in m with which ranges without noise must agree with the path."""
CONFORMING_SIGMAS = 6.0
"""The number of standard deviations by which ranges with noise may differ from the path."""


Check = Callable[[Mission, Sequence[Try]], str | None]


def prompt(_: Mission, tries: Sequence[Try]) -> str | None:
    """sense and drive return in time"""
    sensing, driving = median(one.sensing_s for one in tries), median(one.driving_s for one in tries)
    if sensing > SENSING:
        return f"sense takes {sensing:.2g} of a manoeuvre, expected at most {SENSING:g}"
    if driving > PROMPT:
        return f"drive takes {driving:.2g} of a manoeuvre, expected at most {PROMPT:g}: it must not wait"
    return None


def stands(mission: Mission, tries: Sequence[Try]) -> str | None:
    """without a command, the robot is at rest"""
    for tick, one in enumerate(tries):
        if one.asked == REST and tick > 0 and not _still(one.reading.executed, mission):
            return f"tick {tick}, {one.what}: it drove {_text(one.reading.executed)}, expected rest"
    return None


def drives(mission: Mission, tries: Sequence[Try]) -> str | None:
    """manoeuvres are as commanded, in m/s and rad/s, and measured in their own tick"""
    wrong: list[str] = []
    for tick, one in enumerate(tries):
        if one.asked == REST or one.share < 1.0 or one.what == SECOND_HALF:
            continue
        done, before = one.reading.executed, tries[tick - 1].asked
        if _like(done, one.asked, mission):
            continue
        if before not in (one.asked, REST) and _like(done, before, mission):
            return f"tick {tick}, {one.what}: it reports what was driven in tick {tick - 1}"
        hint = ""
        if one.asked.omega and abs(done.omega / one.asked.omega - math.degrees(1.0)) < 10.0:
            hint = ": degrees?"
        elif _still(done, mission):
            hint = ": it has not moved"
        wrong.append(f"tick {tick}, {one.what}: it drove {_text(done)}, expected {_text(one.asked)}{hint}")
    return wrong[0] if wrong else None


def lasts(_: Mission, tries: Sequence[Try]) -> str | None:
    """half of a manoeuvre takes half of its time"""
    return _off_share(
        tries, (FIRST_HALF, SECOND_HALF), "{:.2f} of the manoeuvre was driven in {:.2f} of its time"
    )


def stops(_: Mission, tries: Sequence[Try]) -> str | None:
    """stop ends a manoeuvre, and odometry measures what was driven, not what was commanded"""
    says = "it reports {:.2f} of a manoeuvre that was stopped after {:.2f} of its time"
    return _off_share(tries, (STOPPED_HALF_WAY,), says)


def _off_share(tries: Sequence[Try], which: Sequence[str], says: str) -> str | None:
    """Return the first of the ticks `which` in which the part that was driven is not that of the time."""
    for tick, one in enumerate(tries):
        if one.what in which and abs((part := one.reading.executed.v / one.asked.v) - one.share) > LIKE:
            return f"tick {tick}, {one.what}: {says.format(part, one.share)}"
    return None


def fresh(mission: Mission, tries: Sequence[Try]) -> str | None:
    """each range is measured in its own tick"""
    for tick in range(1, len(tries)):
        before, now = tries[tick - 1].reading, tries[tick].reading
        if now.anchor_range is None or abs(now.executed.v) < 0.2 * mission.first_straight / mission.period:
            continue
        if now.anchor_range == before.anchor_range:
            return f"tick {tick}: {now.anchor_range:.9g} m is the range of tick {tick - 1}, to the bit"
    return None


def ranges(mission: Mission, tries: Sequence[Try]) -> str | None:
    """ranges to the anchor are in metres, and agree with the path from the odometry"""
    path, tolerance = _path(tries, mission)
    ranged = [(pose, one.reading.anchor_range) for pose, one in zip(path, tries, strict=True)]
    some = [(pose, rho) for pose, rho in ranged if rho is not None]
    if len(some) < 6:
        return f"{len(some)} ranges to the anchor, expected at least 6: start near the anchor"
    anchor, scale = _fit(some, scaled=False)
    worst = _worst(some, anchor, scale, mission)
    if worst <= tolerance:
        return None
    anchor, scale = _fit(some, scaled=True)
    if _worst(some, anchor, scale, mission) <= tolerance:
        return f"ranges are {scale:.4g} times as long as on the path from the odometry"
    return f"no anchor position agrees with them: {worst:.3g} m off, expected at most {tolerance:.3g} m"


def reach(mission: Mission, tries: Sequence[Try]) -> str | None:
    """there is a range within R, except for drop-outs, and none beyond R"""
    path, tolerance = _path(tries, mission)
    most = mission.sensing_range + tolerance
    for tick, one in enumerate(tries):
        ranged = {"the anchor": one.reading.anchor_range, "the peer": one.reading.mutual_range}
        for what, rho in (ranged | dict(one.reading.mutual_ranges)).items():
            if rho is not None and rho > most and not mission.noise.outliers:
                return f"tick {tick}: {rho:.6g} m to {what}, beyond R = {mission.sensing_range:g} m"
    some = [
        (pose, one.reading.anchor_range)
        for pose, one in zip(path, tries, strict=True)
        if one.reading.anchor_range is not None
    ]
    if len(some) < 6:
        return "there are too few ranges for this check"
    anchor, _ = _fit(some, scaled=True)
    for tick, (pose, one) in enumerate(zip(path, tries, strict=True)):
        rho = math.dist((pose.x, pose.y), anchor)
        absent, within = one.reading.anchor_range is None, rho < mission.sensing_range - tolerance
        if absent and within and not mission.noise.drop_outs:
            return f"tick {tick}: no range, {rho:.6g} m from the anchor, and the mission has no drop-outs"
        if not absent and rho > most:
            return (
                f"tick {tick}: a range, {rho:.6g} m from the anchor, beyond R = {mission.sensing_range:g} m"
            )
    return None


CHECKS: tuple[Check, ...] = (prompt, stands, drives, lasts, stops, fresh, ranges, reach)


def check_results(trial: ExerciseRun) -> list[Finding]:
    """Return the result of each check of an exercise."""
    return [checked(str(check.__doc__), check(trial.config.mission, trial.tries)) for check in CHECKS]


def _text(controls: Controls) -> str:
    return f"({controls.v:.4g} m/s, {controls.omega:.4g} rad/s)"


def _slack(mission: Mission) -> tuple[float, float]:
    """Return the speeds in m/s and rad/s up to which a robot is at rest, odometry noise included."""
    v, omega = mission.noise.standstill_bound
    return REST_SPEED * mission.max_speed + v, REST_SPEED * mission.max_turn_rate + omega


def _still(done: Controls, mission: Mission) -> bool:
    v, omega = _slack(mission)
    return abs(done.v) <= v and abs(done.omega) <= omega


def _like(done: Controls, asked: Controls, mission: Mission) -> bool:
    v, omega = _slack(mission)
    return (
        abs(done.v - asked.v) <= LIKE * abs(asked.v) + v
        and abs(done.omega - asked.omega) <= LIKE * abs(asked.omega) + omega
    )


def _path(tries: Sequence[Try], mission: Mission) -> tuple[list[Pose], float]:
    """Return the dead-reckoned pose of each tick, and the tolerance in m of ranges from these poses."""
    path, along, across, farthest = [ORIGIN], 0.0, 0.0, 0.0
    for one in tries[1:]:
        driven = one.reading.executed
        path.append(step(path[-1], driven.v, driven.omega, mission.period))
        v, omega = mission.noise.odometry.variances(driven.v, driven.omega)
        along, across = along + v, across + omega
        farthest = max(farthest, math.hypot(path[-1].x, path[-1].y))
    sigma = mission.period * math.sqrt(along + across * farthest * farthest)
    return path, EXACT_TOLERANCE + CONFORMING_SIGMAS * math.hypot(mission.noise.anchor_sigma, sigma)


def _fit(some: Sequence[tuple[Pose, float]], *, scaled: bool) -> tuple[tuple[float, float], float]:
    """Return the anchor position in the odometry frame that fits best, and the scale of the ranges.

    The scale is 1 unless `scaled`.
    """
    xy = np.array([(pose.x, pose.y) for pose, _ in some])
    rho = np.array([rho for _, rho in some])
    span = float(np.max(rho)) or 1.0

    def off(guess: NDArray[np.float64]) -> NDArray[np.float64]:
        residuals: NDArray[np.float64] = np.hypot(*(xy - guess[:2]).T) * (guess[2] if scaled else 1.0) - rho
        return residuals

    guesses = [
        np.array([xy[0, 0] + span * math.cos(t), xy[0, 1] + span * math.sin(t), 1.0])
        for t in np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False)
    ]
    fits = [least_squares(off, guess, xtol=1e-15, ftol=1e-15, gtol=1e-15) for guess in guesses]
    x, y, scale = min(fits, key=lambda fit: float(fit.cost)).x
    return (float(x), float(y)), float(scale) if scaled else 1.0


def _worst(
    some: Sequence[tuple[Pose, float]], anchor: tuple[float, float], scale: float, mission: Mission
) -> float:
    """Return the largest residual in m, after dropping three times the expected number of outliers."""
    off = sorted([abs(scale * math.dist((pose.x, pose.y), anchor) - rho) for pose, rho in some])
    return off[max(0, len(off) - 1 - math.ceil(3.0 * mission.noise.outliers * len(off)))]
