"""The table at the end of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from compose.recording.reasons import listed
from compose.recording.summary_json import outcome_line
from compose.terminal import tables, text_width
from compose.terminal.text_width import tell
from protocol.output import say

TRUTH, ESTIMATE, ERROR, SIGMA = "true x, y, heading", "estimate", "error m", "sigma m"
TICK_COLUMN = "tick"
RANGES, REPORTS, LATE = "ranges", "reports", "late"
TRUTH_AT_CLAIM = "true at the claim"
TABLE_NOTES = (
    (TICK_COLUMN, "tick: of the claim; the robot may have driven on"),
    (SIGMA, "sigma: claimed, of the position"),
    (LATE, "late: ticks in which the robot stopped because its command was late"),
    (ERROR, "poses in m and rad"),
    (RANGES, "ranges to anchors + to other robots"),
    (REPORTS, "reports sent / received"),
)
"""The footnotes, each with its column."""
RESULT_COLUMNS = (TICK_COLUMN, TRUTH, TRUTH_AT_CLAIM, ESTIMATE, ERROR, SIGMA, RANGES, REPORTS, LATE)
"""All columns: but in pairs, robots drive on after their claims; SIGMA and LATE are not shown if empty."""
NARROWER: tuple[tuple[str, ...], ...] = ((TRUTH, TRUTH_AT_CLAIM), (ESTIMATE,), (RANGES, REPORTS))
"""The columns that are left out one after the other until the table fits."""
MOST_ROBOTS_AS_LIST = 4
"""The largest number of robots of which all columns are shown, as a list if the table does not fit."""
MOST_NAMED_ROBOTS = 10
"""The largest number of robots named in a sentence."""


def result(summary: Mapping[str, Any], rate: float | None = None) -> None:
    """Print the table at the end of a run at `rate`, and the number of missed deadlines.

    `summary` is the content of `summary.json`; `rate` is the speed relative to real time, None for lockstep.
    """
    robots: Mapping[str, Any] = summary["robots"]
    group: Mapping[str, Any] | None = summary.get("group")
    exact = all(robot["covariance"] is None for robot in robots.values())
    late = {name: missed for name, robot in robots.items() if (missed := robot["deadlines_missed"])}
    omitted = {*([SIGMA] if exact else []), *([] if late else [LATE])}
    in_pairs = group is None and "team" not in summary
    omitted |= {TICK_COLUMN, TRUTH_AT_CLAIM} if in_pairs else {TRUTH}
    choices = [[column for column in RESULT_COLUMNS if column not in omitted]]
    for narrower in NARROWER if len(robots) > MOST_ROBOTS_AS_LIST else ():
        choices.append([column for column in choices[-1] if column not in narrower])
    rows = [([name], _cells(robot)) for name, robot in robots.items()]
    lines, columns = tables.widest(["robot"], choices, rows)
    tell(f"{summary['scenario']}: {outcome_line(summary)}")
    say("", *lines, "", *text_width.notes(TABLE_NOTES, columns))
    if group is not None:
        say(*text_width.wrapped(_bound(group, robots)))
    for name, anchor in summary.get("team", {}).get("anchors", {}).items():
        x, y = anchor["position"]
        say(f"anchor {name}: {x:.2f} {y:.2f}, within {anchor['bound_m']:.2g} m (3 sigma)")
    if late:
        say(*text_width.wrapped(_missed(late, summary["ticks"], rate)))
    claiming = [set(one["unverified_anchors"] or ()) for one in robots.values() if one["localised"]]
    if claiming and (anchors := sorted(set.intersection(*claiming))):
        say(*text_width.wrapped(unverified(anchors, "summary.json")))


def _bound(group: Mapping[str, Any], robots: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the sentence on when robots of a group were localised, its computed bound and corrections."""
    bound = f"the computed bound is {group['bound_ticks']} ticks"
    for one in group["corrected_bounds"]:
        were = "was" if len(one["late"]) == 1 else "were"
        late = f", as {', '.join(one['late'])} {were} late" if len(one["late"]) <= MOST_NAMED_ROBOTS else ""
        bound += f", corrected in tick {one['tick']} to {one['bound_ticks']}{late}"
    ticks = {name: one["localised_tick"] for name, one in robots.items()}
    left = [name for name, tick in ticks.items() if tick is None]
    last = max([tick for tick in ticks.values() if tick is not None], default=None)
    if not left:
        return f"all robots were localised by tick {last}; {bound}"
    if last is None:
        return f"no robot is localised; {bound}"
    return f"all robots but {listed(left, MOST_NAMED_ROBOTS)} were localised by tick {last}; {bound}"


def unverified(anchors: Sequence[str], file: str) -> str:
    """Return the sentence on the anchors of which no range tells whether they stand as far off as `accuracy`.

    `file` is the name of the file that tells more.
    """
    named = listed(anchors, MOST_NAMED_ROBOTS, "more anchors")
    stand = "stand" if len(anchors) > 1 else "stands"
    what = f"no range tells whether {named} {stand} off by the accuracy of a claim"
    return f"{what}; {file} of --out has the directions"


def _missed(late: Mapping[str, int], ticks: int, rate: float | None) -> str:
    """Return the sentence on missed deadlines: the number of each robot, and the advice."""
    worst = sorted(late.items(), key=lambda one: -one[1])
    missed = [f"{name} {ticks_missed}" for name, ticks_missed in worst]
    names = listed(missed, MOST_NAMED_ROBOTS, "more robots")
    slower = f", such as --rate {rate / 2:g}," if rate is not None else ""
    return f"deadlines missed, of {ticks}: {names}; a lower --rate{slower} gives each robot more time"


def _cells(robot: Mapping[str, Any]) -> dict[str, str]:
    """Return the cells of the robot's row, by column."""
    return {
        TRUTH: _pose(robot["truth"]),
        TICK_COLUMN: _number(robot["localised_tick"]),
        TRUTH_AT_CLAIM: _pose(robot.get("truth_at_claim")),
        ESTIMATE: _pose(robot["estimate"]),
        ERROR: _number(robot["position_error_m"], ".1e"),
        SIGMA: _number(robot["position_sigma_m"], ".1e"),
        RANGES: f"{_number(robot['anchor_ranges'])} + {_number(robot['mutual_ranges'])}",
        REPORTS: f"{_number(robot['reports_sent'])} / {_number(robot['reports_heard'])}",
        LATE: _number(robot["deadlines_missed"]),
    }


def _pose(pose: list[float] | None) -> str:
    return f"{pose[0]:.2f} {pose[1]:.2f} {pose[2]:+.2f}" if pose else "-"


def _number(value: float | None, form: str = "") -> str:
    return "-" if value is None else format(value, form)
