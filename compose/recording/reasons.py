"""The text for a user of the end of a mission, and of the reasons for it."""

from __future__ import annotations

from collections.abc import Sequence

from protocol.messages import MAX_TEXT, Cause, MissionEnd, Outcome
from protocol.output import one_line

NAMED, LISTED = 4, 8
"""The most robots that a clause names, the summary of a run has all of them; the most names in a list."""


def ended(end: MissionEnd | None, ticks: int) -> str:
    """Return the outcome of a run of `ticks`, in one line; `end` is None if its recording breaks off."""
    if end is None:
        return f"the recording breaks off after {max(0, ticks)} ticks"
    return outcome_after(end.outcome, ticks, reason_for(end))


def outcome_after(outcome: Outcome, ticks: int, why: str | None) -> str:
    """Return the outcome of a run of `ticks`, and `why` it is not another one, in one line."""
    return f"{outcome} after {ticks} ticks{f' ({one_line(why)})' if why else ''}"


def reason_for(end: MissionEnd) -> str | None:
    """Return the reason for the outcome in `end`; None if it is `localised`."""
    return "; ".join([_clause(one) for one in end.causes])[:MAX_TEXT] or None


def plain_reason(end: MissionEnd) -> str | None:
    """Return the same without the names of fields, for sentences."""
    causes = [_time_is_up(one.robots) if one.code == "max-ticks" else _clause(one) for one in end.causes]
    return "; ".join(causes) or None


def of_it(cause: Cause) -> str:
    """Return `cause`, of one robot, as a clause with the subject "it"."""
    statement = _statement(cause)
    return statement if cause.code in ("undecided", "inconsistent") else f"it {statement}"


def _clause(cause: Cause) -> str:
    robots = ", ".join(cause.robots)
    match cause.code:
        case "undecided":
            return f"{robots}: {_statement(cause)}"
        case "inconsistent":
            robot, *peer = cause.robots
            return f"{robot}: {peer[0] if peer else 'its peer'} reports {cause.text}"
        case "max-ticks":
            return f"max_ticks: {robots} not localised by then"
        case "others":
            verb = "is" if len(cause.robots) == 1 else "are"
            return f"{listed(cause.robots, NAMED)} {verb} not localised either"
        case "waiting":
            return f"{robots} is localised"
        case "no-result":
            return f"no result of {robots} received"
        case "failed":
            return cause.text or "failed"
        case _:
            return f"{robots} {_statement(cause)}"


def _statement(cause: Cause) -> str:
    """Return what `cause` says of its robot, without a subject."""
    values = cause.values
    match cause.code:
        case "wrong":
            position, heading, *sigmas = values
            off = f"claims a pose that is {position:.3g} m and {heading:.3g} rad off"
            return f"{off}, with sigmas {sigmas[0]:.3g} m and {sigmas[1]:.3g} rad" if sigmas else off
        case "inconsistent":
            return f"its peer reports {cause.text}"
        case "position":
            return f"claims a position known to {values[0]:.3g} m, required {values[1]:g}"
        case "heading":
            return f"claims a heading known to {values[0]:.3g} rad, required {values[1]:g}"
        case "dead":
            return f"is dead from tick {values[0]:.0f} on"
        case "max-ticks":
            return "has no result by then"
        case _:
            return cause.text or ""


def _time_is_up(robots: Sequence[str]) -> str:
    names = " and ".join([", ".join(robots[:-1]), robots[-1]] if len(robots) > 1 else robots)
    if len(robots) > NAMED:
        names = f"{len(robots)} robots"
    return f"the time is up, and {names} {'are' if len(robots) > 1 else 'is'} not localised"


def listed(names: Sequence[str], most: int = LISTED, what: str = "more") -> str:
    """Return `names` in one line: the first ones, `most` at most, and the number of the others."""
    others = len(names) - most
    return ", ".join(names[:most]) + (f" and {others} {what}" if others > 0 else "")
