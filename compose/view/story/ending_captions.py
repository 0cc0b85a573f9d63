"""Captions of verdicts and of the end of a mission."""

from __future__ import annotations

from collections.abc import Iterator

from compose.recording.reasons import plain_reason
from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.events import metres
from compose.view.pair_data import PairData
from compose.view.run_data import TickData
from compose.view.story.caption import Caption, attacked, stopped
from protocol.messages import Inconsistent, Localised, MissionEnd, Undecided
from protocol.motion import travelled

MOST_LISTED_LINKS = 2
"""The largest number of links that a sentence names."""


def concluding(pair: PairData, ended: MissionEnd | None) -> Iterator[Caption]:
    """Yield the new verdicts. Claims with which the mission ends `localised` are left to its last caption."""
    claiming: list[str] = []
    claimed: list[str] = []
    for robot in pair.robots:
        earlier, command = pair.commands(robot.id)
        if command is None or command.verdict is None:
            continue
        new = earlier is None or earlier.verdict is None
        match command.verdict:
            case Localised():
                (claiming if new else claimed).append(robot.id)
            case verdict if new:
                truth = attacked(pair, "does report") or "No robot reports false data."
                yield without_claim(robot, verdict, pair.ids, truth)
    if not claiming or (ended is not None and ended.outcome == "localised"):
        return
    everyone = len(claiming) == len(pair.ids) > 1
    text = "Both claim to know their poses." if everyone else f"{claiming[0]} claims to know its pose."
    if not everyone and claimed:
        text = f"{claiming[0]} claims to know its pose, too."
    yield Caption("claim", text, pair.ids)


def without_claim(
    robot: RobotSetup, verdict: Undecided | Inconsistent, robots: tuple[str, ...], truth: str | None = None
) -> Caption:
    """Return the caption of a robot that ends without a claim; `truth` is added to a contradiction."""
    match verdict:
        case Undecided(reason):
            return Caption("undecided", f"{robot.id} stops without a claim: {stopped(reason)}", robots)
        case Inconsistent(what):
            text = f"{robot.id} finds that the reports of {robot.peer} contradict what it measured: "
            return Caption("inconsistent", text + stopped(what), robots, truth)


def ending(setup: RunSetup, now: TickData, end: MissionEnd) -> Caption:
    """Return the caption of the end of the mission."""
    plain = plain_reason(end)
    why = f": {stopped(plain)}" if plain else "."
    errors = _claim_errors(now)
    largest = _off(errors, setup.mission.noise.exact) if errors else None
    robots = len(setup.robots)
    match end.outcome:
        case "localised":
            who = {1: setup.ids[0], 2: "Both"}.get(robots, f"All {robots} robots")
            are, each = ("is", "it") if robots == 1 else ("are", "each")
            text = f"{who} {are} localised: {each} knows its position and its heading."
            return Caption("end", text, truth=largest)
        case "undecided":
            truth = " ".join(filter(None, [_silent_links(setup), largest])) or None
            return Caption("end", f"The mission ends undecided{why}", truth=truth)
        case "inconsistent":
            text = "The mission ends, because measurements and reports contradict each other"
            return Caption("end", stopped(text) if _just_told(setup, now) else f"{text}{why}", truth=largest)
        case "wrong":
            return Caption("end", f"The mission ends with a wrong claim{why}", truth=largest)
        case _:
            return Caption("end", f"The mission fails{why}", truth=largest)


def _just_told(setup: RunSetup, now: TickData) -> bool:
    """Return whether a robot of the only pair has found the contradiction: its caption has the reason."""
    verdicts = [now.commands[robot].verdict for robot in setup.ids if robot in now.commands]
    return len(setup.robots) == 2 and any(isinstance(verdict, Inconsistent) for verdict in verdicts)


def _silent_links(setup: RunSetup) -> str | None:
    """Return a sentence about the links that deliver nothing all the time; None if there are none."""
    dead = [
        fault
        for fault in setup.faults
        if (fault.partition or not fault.let_through) and fault.ticks is None and fault.contact_ticks is None
    ]
    links = [
        f"from {robot.id} to {robot.peer}"
        for robot in setup.robots
        if any(fault.on(robot.id, robot.peer) for fault in dead)
    ]
    if len(links) > MOST_LISTED_LINKS:
        return f"No report arrives on {len(links)} of the {len(setup.robots)} links between robots."
    return f"No report {' or '.join(links)} ever arrives." if links else None


def _claim_errors(now: TickData) -> list[float]:
    """Return the position errors in m of robots that claim theirs; empty without the ground truth."""
    return [
        travelled(truth, estimate.world[0])
        for robot, estimate in now.estimates.items()
        if estimate.localised and estimate.world and (truth := now.truth.get(robot)) is not None
    ]


def _off(errors: list[float], exact: bool) -> str:
    """Return a sentence about the errors of claims, in m, of robots whose sensors are exact or not."""
    claims = "claimed position is" if len(errors) == 1 else "claimed positions are"
    if max(errors) < 1e-6:
        return f"The {claims} off by less than 1 µm{': the simulated sensors are exact' if exact else ''}."
    return f"The {claims} off by {'' if len(errors) == 1 else 'at most '}{metres(max(errors))}."
