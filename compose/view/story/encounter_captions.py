"""Captions of phase 3: the encounter, the configurations that fit, and what distinguishes them."""

from __future__ import annotations

from collections.abc import Iterator

from compose.view.deliveries import contact_of
from compose.view.events import metres
from compose.view.pair_data import PairData
from compose.view.story.caption import Caption, count_word, sentence
from protocol.messages import Estimate

STATES_OF_ONE_MOVER = ("straight", "turning", "circling")
"""The states in which one robot drives to get a second mutual range, while the other stands."""


def meeting(pair: PairData) -> Iterator[Caption]:
    """Yield that the robots have come into each other's range, or have left it."""
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
    again = not pair.own_planner and any(one is not None and one.phase == 3 for one in commands)
    one, other = pair.ids if len(pair.ids) > 1 else (pair.ids[0], pair.robots[0].peer)
    heard = [contact_of(pair.now, robot.id, robot.peer) for robot in pair.robots]
    swap = len(heard) > 1 and all(one is not None and one.heard for one in heard)
    meet = f"{one} and {other} are in range of each other again" if again else f"{one} and {other} meet"
    if now.range is None:
        text = f"{meet}. The distance between them is not measured in this tick."
    elif swap and not again:
        reports = "reports" if pair.own_planner else "reports of their paths"
        text = f"{meet}, {metres(now.range)} apart, and exchange {reports}.{_alone(pair)}"
    else:
        text = f"{meet}. They measure the distance between them, {metres(now.range)}.{_alone(pair)}"
    yield Caption("contact", text, pair.ids)


def _alone(pair: PairData) -> str:
    """Return a sentence about a robot that drives alone to measure a second distance; empty if none does."""
    commands = [pair.now.commands.get(robot) for robot in pair.ids]
    if pair.own_planner or len(commands) < 2 or any(one is None or one.phase != 3 for one in commands):
        return ""
    driving = [robot for robot in pair.ids if pair.state(robot) in STATES_OF_ONE_MOVER]
    standing = [robot for robot in pair.ids if pair.state(robot) == "standing"]
    if not driving or not standing:
        return ""
    return f" {driving[0]} drives on to measure a second distance, while {standing[0]} stands still."


def fitting(pair: PairData) -> Iterator[Caption]:
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
        if has < had:
            yield Caption("measured", _ruling_out(pair, had - has), pair.ids)
            yield Caption("ruled-out", sentence(_left(pair, for_whom, had, has)), pair.ids)
        else:
            text = f"{for_whom}{_fit(pair, had, has)}{_most_probable(pair, robots[0])}"
            distances = _two_distances(pair) if pair.exact and not had and has > 1 else ""
            yield Caption("configurations", f"{distances}{sentence(text)}", pair.ids)


def _fit(pair: PairData, had: int, has: int) -> str:
    """Return that `has` configurations fit, instead of `had`, as a clause."""
    if had:
        fit = "configuration of the robots fits" if has == 1 else "configurations of the robots fit"
        return f"{count_word(has)} {fit} now, instead of {count_word(had)}"
    if has == 1:
        return "one configuration of the robots fits what was measured and reported"
    one, other = pair.robots[0].id, pair.robots[0].peer
    pose = "one angle, and so one pose," if pair.exact else "one pose"
    poses = f"each with {pose} of {one} and one of {other}"
    return f"{count_word(has)} configurations fit, {poses}"


def _two_distances(pair: PairData) -> str:
    """Return a sentence on the distances of the tick before and of this one; empty if they are equal."""
    found = [pair.contact(pair.before), pair.contact(pair.now)]
    lengths = [metres(one.range) for one in found if one is not None and one.range is not None]
    if len(set(lengths)) < 2:
        return ""
    return f"The distance was {lengths[0]} and is {lengths[1]} now. "


def _ruling_out(pair: PairData, count: int) -> str:
    """Return what rules `count` configurations out, before it says how many are left."""
    contact = pair.contact(pair.now)
    if contact is None or contact.range is None:
        return "What was measured and reported since rules configurations out."
    if count == 1:
        others = (
            f"The configuration that {'predicted another distance' if pair.exact else 'does not fit it'} is"
        )
    else:
        others = f"Configurations that {'predicted another distance' if pair.exact else 'do not fit it'} are"
    one_by_one = ", one by one" if count > 1 else ""
    return f"The distance is {metres(contact.range)} now. {others} ruled out{one_by_one}."


def _left(pair: PairData, for_whom: str, had: int, has: int) -> str:
    if has == 0:
        return f"{for_whom}no configuration fits what was measured and reported any more"
    verb = "is left" if has == 1 else "are left"
    only = "only " if has == 1 else ""
    text = f"{for_whom}{only}{count_word(has)} of the {count_word(had)} configurations {verb}"
    return text if has > 1 or _verdicts(pair) else f"{text}. It is not claimed yet"


def _most_probable(pair: PairData, robot: str) -> str:
    """Return the probability of the first of several configurations, as the end of a sentence."""
    held = pair.held(robot)[1]
    if held is None or len(held.probabilities) < 2:
        return ""
    return f", the most probable with {min(round(100 * held.probabilities[0]), 99)} %"


def _verdicts(pair: PairData) -> bool:
    commands = [pair.commands(robot)[1] for robot in pair.ids]
    return any(command is not None and command.verdict is not None for command in commands)


def planning(pair: PairData) -> Iterator[Caption]:
    """Yield the beginning of each last manoeuvre, or of active sensing with several configurations."""
    for robot in pair.ids:
        held = pair.held(robot)[1]
        if held is None or not held.world or not pair.begins(robot, "last-manoeuvre"):
            continue
        if len(held.world) == 1:
            text = f"{robot} makes a manoeuvre to test it with a distance from another place."
        else:
            count = count_word(len(held.world))
            text = (
                f"{_turn(pair, robot)} to where the {count} predict distances that differ most: "
                "then the next measured distance can tell which one is true."
            )
        yield Caption("manoeuvre", text, pair.ids)
    appeared = [r for r in pair.ids if _appeared(*pair.held(r)) and pair.state(r) == "surveying"]
    if len(appeared) == len(pair.ids) > 1:
        text = "Both drive to where the next distances are expected to distinguish them best."
        yield Caption("manoeuvre", text, pair.ids)


def _turn(pair: PairData, robot: str) -> str:
    """Return that `robot` drives, and that its peer stands still if it does, as a clause."""
    still = [other for other in pair.ids if other != robot and pair.state(other) in ("waiting", "standing")]
    return f"Now {still[0]} stands still and {robot} drives" if still else f"{robot} drives"


def _appeared(earlier: Estimate | None, held: Estimate | None) -> bool:
    return earlier is not None and held is not None and not earlier.world and len(held.world) > 1
