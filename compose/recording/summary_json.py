"""`summary.json`: the outcome of a run, its parameters, and the claim and counts of each robot."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import msgspec

from compose.extras import version
from compose.recording.claim import Claim, claim, matrix
from compose.recording.run import Recording
from compose.recording.ticks_csv import ticks_csv
from protocol import files
from protocol.messages import FinalReport, Localised, Outcome
from protocol.motion import Pose, wrap
from protocol.output import one_line
from world.sensors import mutual_ranges

Mode = Literal["processes", "in-process"]
SUMMARY = "summary.json"


def summary(recording: Recording, mode: Mode, wall_s: float | None) -> dict[str, Any]:
    """Return the content of `summary.json`; values that do not apply are None.

    `wall_s` is the wall time of the run in s.
    """
    scenario, moments = recording.scenario, recording.ticks
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "mode": mode,
        "outcome": recording.end.outcome if recording.end is not None else "failed",
        "reason": recording.end.reason if recording.end is not None else "the recording breaks off",
        "ticks": moments[-1].truth.tick if moments else 0,
        "wall_s": wall_s,
        "first_contact_tick": first_contact(recording),
        "t_max_s": max(robot.rendezvous.bound for robot in scenario.robots),
        "min_separation_m": min(
            (
                math.hypot(one.x - other.x, one.y - other.y)
                for moment in moments
                for one, other in combinations(moment.truth.poses, 2)
            ),
            default=None,
        ),
        "parameters": {
            **msgspec.to_builtins(scenario.mission),
            "planner": scenario.planner_name,
            "max_ticks": scenario.max_ticks,
        },
        "versions": versions(),
        "robots": {robot.id: _robot_summary(recording, i) for i, robot in enumerate(scenario.robots)},
    }


def first_contact(recording: Recording) -> int | None:
    """Return the first tick at which two peers were in range of each other; None if there is none."""
    pairs = recording.scenario.pairs()
    for moment in recording.ticks:
        if any(mutual is not None for mutual in mutual_ranges(moment.truth, recording.scenario, pairs)):
            return moment.truth.tick
    return None


def first_claim(recording: Recording, place: int) -> Claim | None:
    """Return the first claim of the robot at `place` in the scenario; None if it made none."""
    robot = recording.scenario.robots[place].id
    for moment in recording.ticks:
        command = moment.commands.get(robot)
        if command is not None and isinstance(command.verdict, Localised):
            return claim(moment.truth.tick, command.verdict, moment.truth.poses[place])
    return None


def _robot_summary(recording: Recording, place: int) -> dict[str, Any]:
    robot = recording.scenario.robots[place].id
    final_report = recording.final_reports.get(robot)
    claimed = first_claim(recording, place)
    covariance = claimed.covariance if claimed is not None else None
    return {
        "localised": claimed is not None,
        "localised_tick": claimed.tick if claimed is not None else None,
        "estimate": _listed(claimed.pose) if claimed is not None else None,
        "covariance": matrix(covariance) if covariance is not None else None,
        "truth": _listed(recording.ticks[-1].truth.poses[place]) if recording.ticks else None,
        "position_error_m": claimed.position_error if claimed is not None else None,
        "heading_error_rad": claimed.heading_error if claimed is not None else None,
        "position_sigma_m": covariance.position_sigma if covariance is not None else None,
        "heading_sigma_rad": covariance.heading_sigma if covariance is not None else None,
        "nees": claimed.nees if claimed is not None else None,
        **{field: getattr(final_report, field, None) for field in _COUNTS},
        "no_farewell": None if final_report is not None else _missing_final_report(recording, robot),
        "deadlines_missed": sum([robot not in moment.commands for moment in recording.ticks[:-1]]),
    }


def _missing_final_report(recording: Recording, robot: str) -> str:
    """Return why the world's journal has no FinalReport of `robot`."""
    if recording.end is None:
        return "the recording breaks off"
    latest = max([moment.truth.tick for moment in recording.ticks if robot in moment.commands], default=None)
    if latest is None:
        return "none of its Commands arrived in time"
    if latest < recording.end.tick:
        return f"its last Command that arrived in time is of tick {latest} of {recording.end.tick}"
    return "it did not answer the MissionEnd"


_COUNTS = [field for field in FinalReport.__struct_fields__ if field != "robot"]


def _listed(pose: Pose) -> list[float]:
    return [pose.x, pose.y, wrap(pose.heading)]


@cache
def versions() -> dict[str, str | None]:
    """Return the versions of all packages on which the results of a run can depend."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("tandem-ranging", "eclipse-zenoh", "numpy", "scipy", "msgspec", "msgpack"):
        found[package] = version(package)
    return found


def leave(recording: Recording, summary: Mapping[str, Any], folder: Path) -> None:
    """Write `ticks.csv` and `summary.json` into `folder`."""
    files.write(folder / "ticks.csv", ticks_csv(recording))
    files.write(folder / SUMMARY, msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")


def outcome_line(summary: Mapping[str, Any]) -> str:
    """Return the outcome in one line."""
    return ended(summary["outcome"], summary["ticks"], summary["reason"])


def broken_off(ticks: int) -> str:
    """Return the outcome of a run without an end, in one line."""
    return f"the recording breaks off after {max(0, ticks)} ticks"


def ended(outcome: Outcome, ticks: int, reason: str | None) -> str:
    """Return the outcome of a run that ended, in one line."""
    return f"{outcome} after {ticks} ticks{f' ({one_line(reason)})' if reason else ''}"
