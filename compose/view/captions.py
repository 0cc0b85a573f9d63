"""Captions of a mission: a sentence for each important event, for readers who do not know the method.

Captions follow from the data of a tick and of the one before, as events do. There are far fewer of them,
and each is about a pair of robots. They state what was measured, held, claimed and decided, and no more: a
claim counts as true only once the mission has ended `localised`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import msgspec

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.deliveries import Passage, contact_of
from compose.view.events import metres
from compose.view.pair_data import PairData
from compose.view.run_data import TickData
from compose.view.words import end_reason
from protocol.messages import Estimate, Inconsistent, Localised, MissionEnd, Undecided

CaptionKind = Literal[
    "ranging", "search", "contact", "contact-lost", "configurations", "manoeuvre", "ruled-out", "claim",
    "undecided", "inconsistent", "report-lost", "process", "end",
]  # fmt: skip
COUNTS = (
    "no",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
)
"""Small numbers as words."""
MOST_LINKS = 2
"""The largest number of links that a sentence names."""


class Caption(msgspec.Struct, frozen=True, omit_defaults=True):
    """One caption. Several captions of a tick are shown one after the other."""

    kind: CaptionKind
    text: str
    robots: tuple[str, ...] = ()
    """The pair that the caption is about; empty if it is about all robots."""
    truth: str | None = None
    """A further sentence that follows from the ground truth or the scenario only; None if there is none."""


def captions(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    passages: Sequence[Passage],
    end: MissionEnd | None,
) -> Iterator[Caption]:
    """Yield the captions of the tick of `now`, pair by pair, and at last that of the end of the mission."""
    pairs: list[tuple[RobotSetup, ...]] = [*setup.pairs()]
    paired = {robot.id for pair in pairs for robot in pair}
    groups = [*pairs, *[(robot,) for robot in setup.robots if robot.id not in paired]]
    ended = end if end is not None and end.tick == now.tick else None
    for robots in groups:
        pair = PairData(robots, setup.mission.noise.exact, before, now)
        yield from _ranging(pair, len(groups))
        yield from _searching(pair)
        yield from _meeting(pair)
        yield from _fitting(pair)
        yield from _planning(pair)
        yield from _concluding(pair, ended)
        yield from _losing(pair, passages)
    if ended is not None:
        yield _end(setup, now, ended)


# --- phases 1 and 2 -----------------------------------------------------------------------------------


def _ranging(pair: PairData, pairs: int) -> Iterator[Caption]:
    if pair.before is not None or pair.now.tick != 0:
        return
    found = [pair.now.observations.get(robot) for robot in pair.ids]
    if None in found:
        return
    ranged = [one.robot for one in found if one is not None and one.anchor_range is not None]
    without = [robot for robot in pair.ids if robot not in ranged]
    only = "the distance to one beacon, its anchor. It knows how far away that is, not where."
    if not ranged:
        text = "There is no distance to an anchor yet."
    elif not without:
        text = f"{'Each robot' if len(ranged) > 1 else ranged[0]} measures {only}"
    else:
        text = f"{ranged[0]} measures {only} {without[0]} has no such distance yet."
    if pairs > 1 < len(pair.ids):
        text = f"{_listed(pair.ids)} are one of {pairs} pairs. {text}"
    yield Caption("ranging", text, pair.ids, _attacked(pair, "will report"))


def _attacked(pair: PairData, reports: str) -> str | None:
    """Return a sentence about the attackers; None if there are none. `reports` is its verb."""
    attackers = [robot.id for robot in pair.robots if robot.attack is not None]
    return f"{_listed(attackers)} {reports} false data about itself." if attackers else None


def _searching(pair: PairData) -> Iterator[Caption]:
    commands = [pair.commands(robot) for robot in pair.ids]
    earlier = [before.phase for before, _ in commands if before is not None]
    phases = [now.phase for _, now in commands if now is not None]
    if len(earlier) + len(phases) < 2 * len(pair.ids) or min(phases) < 2 or min(earlier) >= 2:
        return
    parts = []
    if all(_knows_path(pair.held(robot)[1]) for robot in pair.ids):
        subject = "each robot" if len(pair.ids) > 1 else pair.ids[0]
        what = "knows its path" if pair.exact else "has an estimate of its path"
        around = "but turned around the anchor by an unknown angle"
        parts.append(f"After a short drive, {subject} {what} relative to its anchor, {around}.")
    if max(phases) < 3:
        parts.append(_search(pair.robots))
    if parts:
        yield Caption("search", " ".join(parts), pair.ids)


def _search(robots: Sequence[RobotSetup]) -> str:
    moving = [robot for robot in robots if robot.orbit.v != 0.0]
    if len(moving) > 1:
        return "They drive on circles around their anchors to find each other."
    waits = ", which waits near its own" if len(robots) > 1 else ""
    if not moving:
        return f"{robots[0].id} waits near its anchor for {robots[0].peer}."
    return f"{moving[0].id} drives on a circle around its anchor to find {moving[0].peer}{waits}."


def _knows_path(held: Estimate | None) -> bool:
    """Return whether one pose relative to the anchor is left, or more probable than all others together."""
    if held is None or not held.local:
        return False
    return len(held.local) == 1 or (
        not held.world and bool(held.probabilities) and held.probabilities[0] > 0.5
    )


# --- the encounter ------------------------------------------------------------------------------------


def _meeting(pair: PairData) -> Iterator[Caption]:
    now, had = pair.contact(pair.now), pair.contact(pair.before)
    if pair.before is None and pair.now.tick != 0:
        return
    if now is None:
        observed = all(robot in pair.now.observations for robot in pair.ids)
        if had is not None and observed:
            yield Caption("contact-lost", "They have left each other's range.", pair.ids)
        return
    if had is not None:
        return
    commands = [pair.commands(robot)[0] for robot in pair.ids]
    again = any(command is not None and command.phase == 3 for command in commands)
    who = pair.ids if len(pair.ids) > 1 else (pair.ids[0], pair.robots[0].peer)
    if now.range is None:
        measured = "The distance between them is not measured in this tick."
    else:
        measured = f"They measure the distance between them, {metres(now.range)}."
    meet = (
        f"{who[0]} and {who[1]} are in range of each other again."
        if again
        else f"{who[0]} and {who[1]} meet."
    )
    heard = [contact_of(pair.now, robot.id, robot.peer) for robot in pair.robots]
    swap = len(heard) > 1 and all(one is not None and one.heard for one in heard)
    tell = " They exchange reports of their paths." if swap and not again else ""
    yield Caption("contact", f"{meet} {measured}{tell}", pair.ids)


def _fitting(pair: PairData) -> Iterator[Caption]:
    """Yield how many configurations appear, are left, or are added; once if both robots have as many."""
    changes: dict[tuple[int, int], list[str]] = {}
    for robot in pair.ids:
        earlier, held = pair.held(robot)
        if held is None or earlier is None or (held.localised and not earlier.world):
            continue
        if len(earlier.world) != len(held.world):
            changes.setdefault((len(earlier.world), len(held.world)), []).append(robot)
    for (had, has), robots in changes.items():
        for_whom = "" if len(robots) == len(pair.ids) else f"for {robots[0]}, "
        if has == 0:
            text = f"{for_whom}no configuration fits what was measured and reported any more"
            yield Caption("ruled-out", _sentence(text), pair.ids)
        elif has < had:
            yield Caption("ruled-out", _sentence(_left(pair, for_whom, had, has)), pair.ids)
        else:
            now = f" now, instead of {_count(had)}" if had else " what was measured and reported"
            fit = "configuration of the robots fits" if has == 1 else "configurations of the robots fit"
            if not had and has > 1:
                one, other = pair.robots[0].id, pair.robots[0].peer
                fit = f"configurations, each with one pose of {one} and one of {other}, fit"
            text = f"{for_whom}{_count(has)} {fit}{now}{_most_probable(pair, robots[0])}"
            yield Caption("configurations", _sentence(text), pair.ids)


def _left(pair: PairData, for_whom: str, had: int, has: int) -> str:
    contact = pair.contact(pair.now)
    now = ""
    if contact is not None and contact.range is not None:
        now = f"with the distance now measured, {metres(contact.range)}, "
    verb = "is left" if has == 1 else "are left"
    only = "only " if has == 1 else ""
    text = f"{now}{for_whom}{only}{_count(has)} of the {_count(had)} configurations {verb}"
    return text if has > 1 or _verdicts(pair) else f"{text}. It is not claimed yet"


def _most_probable(pair: PairData, robot: str) -> str:
    """Return the probability of the first of several configurations, as the end of a sentence."""
    held = pair.held(robot)[1]
    if held is None or len(held.probabilities) < 2:
        return ""
    return f", the most probable with {math.floor(100 * held.probabilities[0])} %"


def _verdicts(pair: PairData) -> bool:
    commands = [pair.commands(robot)[1] for robot in pair.ids]
    return any(command is not None and command.verdict is not None for command in commands)


def _planning(pair: PairData) -> Iterator[Caption]:
    """Yield the beginning of each last manoeuvre, or of active sensing with several configurations."""
    for robot in pair.ids:
        held = pair.held(robot)[1]
        if held is None or not held.world or not pair.begins(robot, "last-manoeuvre"):
            continue
        if len(held.world) == 1:
            text = f"{robot} makes a manoeuvre to test it with a distance from another place."
        else:
            count = _count(len(held.world))
            text = (
                f"{robot} makes one manoeuvre, chosen so that the {count} predict distances that differ "
                "most: then the next measured distance can tell which one is true."
            )
        yield Caption("manoeuvre", text, pair.ids)
    appeared = [r for r in pair.ids if _appeared(*pair.held(r)) and pair.state(r) == "surveying"]
    if len(appeared) == len(pair.ids) > 1:
        text = "Both drive to where the next distances are expected to distinguish them best."
        yield Caption("manoeuvre", text, pair.ids)


def _appeared(earlier: Estimate | None, held: Estimate | None) -> bool:
    return earlier is not None and held is not None and not earlier.world and len(held.world) > 1


def _losing(pair: PairData, passages: Sequence[Passage]) -> Iterator[Caption]:
    lost = [one.sender for one in passages if one.what == "lost" and one.sender in pair.ids]
    if lost:
        reports = "A report" if len(lost) == 1 else "Reports"
        verb = "is" if len(lost) == 1 else "are"
        yield Caption("report-lost", f"{reports} of {_listed(sorted({*lost}))} {verb} lost.", pair.ids)
    for robot in pair.ids:
        was = pair.before is not None and robot in pair.before.down - pair.before.back
        if robot in pair.now.down and not was:
            yield Caption("process", f"The process of {robot} is gone.", pair.ids)
        if robot in pair.now.back:
            yield Caption("process", f"The process of {robot} runs again.", pair.ids)


# --- verdicts and the end -----------------------------------------------------------------------------


def _concluding(pair: PairData, ended: MissionEnd | None) -> Iterator[Caption]:
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
            case Undecided(reason) if new:
                yield Caption("undecided", f"{robot.id} stops without a claim: {_stopped(reason)}", pair.ids)
            case Inconsistent(what) if new:
                text = f"{robot.id} finds that the reports of {robot.peer} contradict what it measured: "
                text += _stopped(what)
                truth = _attacked(pair, "does report") or "No robot reports false data."
                yield Caption("inconsistent", text, pair.ids, truth)
            case _:
                pass
    if not claiming or (ended is not None and ended.outcome == "localised"):
        return
    everyone = len(claiming) == len(pair.ids) > 1
    text = "Both claim to know their poses." if everyone else f"{claiming[0]} claims to know its pose."
    if not everyone and claimed:
        text = f"{claiming[0]} claims to know its pose, too."
    yield Caption("claim", text, pair.ids)


def _end(setup: RunSetup, now: TickData, end: MissionEnd) -> Caption:
    why = f": {_stopped(end_reason(end.reason))}" if end.reason else "."
    errors = _claim_errors(setup, now)
    largest = f"The largest error of a claim is {_size(max(errors))}." if errors else None
    silent = _silent_links(setup)
    robots = len(setup.robots)
    match end.outcome:
        case "localised":
            who = {1: setup.ids[0], 2: "Both"}.get(robots, f"All {robots} robots")
            return Caption("end", f"{who} {'is' if robots == 1 else 'are'} localised.", truth=largest)
        case "undecided":
            return Caption(
                "end",
                f"The mission ends undecided{why}",
                truth=" ".join(filter(None, [silent, largest])) or None,
            )
        case "inconsistent":
            text = "The mission ends, because measurements and reports contradict each other"
            return Caption("end", _stopped(text) if _just_told(setup, now) else f"{text}{why}", truth=largest)
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
    if len(links) > MOST_LINKS:
        return f"No report arrives on {len(links)} of the {len(setup.robots)} links between robots."
    return f"No report {' or '.join(links)} ever arrives." if links else None


def _claim_errors(setup: RunSetup, now: TickData) -> list[float]:
    """Return the position errors in m of the claims in this tick; empty without the ground truth."""
    errors = []
    for robot in setup.ids:
        command, truth = now.commands.get(robot), now.truth.get(robot)
        if command is not None and truth is not None and isinstance(command.verdict, Localised):
            pose = command.verdict.pose
            errors.append(math.hypot(pose.x - truth.x, pose.y - truth.y))
    return errors


def _size(error: float) -> str:
    return metres(error) if error >= 1e-6 else "less than 1 µm"


# --- words --------------------------------------------------------------------------------------------


def _count(number: int) -> str:
    return COUNTS[number] if number < len(COUNTS) else str(number)


def _listed(robots: Sequence[str]) -> str:
    return " and ".join(robots)


def _stopped(text: str) -> str:
    """Return `text` as the end of a sentence."""
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def _sentence(text: str) -> str:
    return _stopped(text[0].upper() + text[1:])
