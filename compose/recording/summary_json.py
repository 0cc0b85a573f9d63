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
from msgspec.structs import astuple

from compose.extras import version
from compose.recording.closest_approach import nearest
from compose.recording.corrected_bounds import corrected_bounds
from compose.recording.group_localisation import MeetingResult, SearchResult, meeting_results, search_results
from compose.recording.reasons import of_it, outcome_after, reason_for
from compose.recording.rows import parts, ticks_csv
from compose.recording.run import Run
from protocol import files
from protocol.messages import FinalReport
from protocol.motion import Pose, travelled, wrap
from world.referee import not_localised

Mode = Literal["processes", "in-process"]
SUMMARY_JSON = "summary.json"

BOUND_SIGMAS = 3.0
"""The bound of the error of an anchor's position, in its sigmas.

The error exceeds it with a probability of 1e-4 if it is the same in all directions, and of 0.003 at most.
"""


def summary(run: Run, mode: Mode | None, wall_s: float | None) -> dict[str, Any]:
    """Return the content of `summary.json`; values that do not apply or are unknown are None.

    `wall_s` is the wall time of the run in s.
    """
    scenario, ticks = run.scenario, run.ticks
    found: dict[str, Any] = {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "mode": mode,
        "outcome": run.end.outcome if run.end is not None else "failed",
        "reason": reason_for(run.end) if run.end is not None else "the recording breaks off",
        "ticks": ticks[-1].truth.tick if ticks else 0,
        "wall_s": wall_s,
        "first_contact_tick": first_contact(run),
        "t_max_s": scenario.t_max,
        "min_separation_m": min(
            (travelled(*two) for tick in ticks for two in combinations(tick.truth.poses, 2)), default=None
        ),
        "nearest_m": nearest(run) if scenario.mission.safety_distance else None,
        "parameters": {
            **msgspec.to_builtins(scenario.mission),
            "planner": scenario.planner_name,
            "planner_options": scenario.planner_options,
            "max_ticks": scenario.max_ticks,
            "world_noise": msgspec.to_builtins(scenario.world_noise),
            "world_range": msgspec.to_builtins(scenario.range_model),
            "world_radio": msgspec.to_builtins(scenario.radio_model),
        },
        "versions": versions(),
        "robots": {robot: _robot_summary(run, robot) for robot in run.robots},
    }
    if scenario.in_pairs:
        return found
    return {
        **found,
        **(
            {"group": _group(run) | _lost(run)}
            if scenario.meetings
            else {"team": {"anchors": _surveyed(run), **_lost(run)}}
        ),
    }


def _lost(run: Run) -> dict[str, Any]:
    """Return why each robot that is not localised is not, and the ticks from which on robots are dead."""
    left = not_localised(run.scenario, run.verdicts(), run.length - 1)
    return {
        "not_localised": {robot: of_it(cause) for robot, cause in left.items()},
        "deaths": {one.robot: one.tick for one in run.scenario.deaths},
    }


def _surveyed(run: Run) -> dict[str, Any]:
    """Return where each anchor that is not surveyed stands, by the robot that claimed its pose last."""
    claims = [
        (one.tick, -k, name) for k, name in enumerate(run.robots) if (one := run.claim(name)) is not None
    ]
    tick, _, last = max(claims, default=(0, 0, ""))
    estimate, team = run.claim_estimate(last, tick), run.scenario.team
    true = {one.told.id: one.place for one in team.anchors} if team is not None else {}
    return {
        one.id: {
            "position": [one.position.x, one.position.y],
            "sigma_m": one.sigma,
            "bound_m": BOUND_SIGMAS * one.sigma,
            "error_m": math.dist(astuple(one.position), astuple(true[one.id])),
        }
        for one in (estimate.anchors if estimate is not None else ())
    }


def _group(run: Run) -> dict[str, Any]:
    """Return the bound until all robots of the group are localised, its meetings, and its searches."""
    meetings, searches = list(meeting_results(run)), list(search_results(run))
    results: list[MeetingResult | SearchResult] = [*meetings, *searches]
    ticks = [one.localised_tick for one in results]
    return {
        "bound_s": max(one.bound_s for one in results),
        "bound_ticks": max(one.bound_ticks for one in results),
        "least_bound_s": run.scenario.least_bound,
        "localised_tick": max(tick for tick in ticks if tick is not None) if None not in ticks else None,
        "corrected_bounds": msgspec.to_builtins(list(corrected_bounds(run))),
        "meetings": msgspec.to_builtins(meetings),
        **({"without_anchor": msgspec.to_builtins(searches)} if searches else {}),
    }


def first_contact(run: Run) -> int | None:
    """Return the first tick at which two robots were in range of each other; None if there is none.

    Robots of different pairs do not count.
    """
    return next((tick.truth.tick for tick in run.ticks if tick.world.contacts), None)


def _robot_summary(run: Run, robot: str) -> dict[str, Any]:
    final_report, claimed, truth = run.final_reports.get(robot), run.claim(robot), run.truth(robot)
    pose, covariance = parts(claimed, "pose", "covariance")
    at_claim = {"truth_at_claim": _listed(truth[claimed.tick]) if claimed is not None else None}
    names = ("position_error_m", "heading_error_rad", "position_sigma_m", "heading_sigma_rad", "nees")
    errors = parts(claimed, "position_error", "heading_error")
    errors += [*parts(covariance, "position_sigma", "heading_sigma"), *parts(claimed, "nees")]
    return {
        "localised": claimed is not None,
        "localised_tick": claimed.tick if claimed is not None else None,
        "estimate": _listed(pose) if pose is not None else None,
        "covariance": covariance.matrix if covariance is not None else None,
        "truth": _listed(truth[-1]) if truth else None,
        **({} if run.scenario.in_pairs else at_claim),
        **dict(zip(names, errors, strict=True)),
        **dict(zip(_FINAL_REPORT_COUNTS, parts(final_report, *_FINAL_REPORT_COUNTS), strict=True)),
        "no_farewell": None if final_report is not None else _missing_final_report(run, robot),
        "deadlines_missed": sum([robot not in tick.commands for tick in run.ticks[:-1]]),
    }


def _missing_final_report(run: Run, robot: str) -> str:
    """Return why the world's journal has no FinalReport of `robot`."""
    if run.end is None:
        return "the recording breaks off"
    latest = max([tick.truth.tick for tick in run.ticks if robot in tick.commands], default=None)
    if latest is None:
        return "none of its Commands arrived in time"
    if latest < run.end.tick:
        return f"its last Command that arrived in time is of tick {latest} of {run.end.tick}"
    return "it did not answer the MissionEnd"


_FINAL_REPORT_COUNTS = [field for field in FinalReport.__struct_fields__ if field != "robot"]


def _listed(pose: Pose) -> list[float]:
    return [pose.x, pose.y, wrap(pose.heading)]


@cache
def versions() -> dict[str, str | None]:
    """Return the versions of all packages on which the results of a run can depend."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("tandem-ranging", "eclipse-zenoh", "numpy", "scipy", "msgspec", "msgpack"):
        found[package] = version(package)
    return found


def leave(run: Run, summary: Mapping[str, Any], folder: Path) -> None:
    """Write `ticks.csv` and `summary.json` into `folder`."""
    files.write(folder / "ticks.csv", ticks_csv(run))
    files.write(folder / SUMMARY_JSON, msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")


def outcome_line(summary: Mapping[str, Any]) -> str:
    """Return the outcome in one line."""
    return outcome_after(summary["outcome"], summary["ticks"], summary["reason"])
