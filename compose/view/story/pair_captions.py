"""Captions of a pair: ranges, branches and the search; the encounter, and what distinguishes configurations.

Each function yields kinds and texts, and a third element that follows from the ground truth, if there is one.
"""

from __future__ import annotations

from collections.abc import Iterator

from compose.view.deliveries import contact_of
from compose.view.events import metres
from compose.view.pair_data import PairData
from compose.view.story.caption import CaptionKind, attacked, count_word, listed, sentence, without_claim
from protocol.messages import Estimate, Localised

Told = Iterator[tuple[CaptionKind, str] | tuple[CaptionKind, str, str | None]]

# --- phases 1 and 2 ---------------------------------------------------------------------------------


def beginning(pair: PairData, pairs: int, sensing_range: float) -> Told:
    """Yield what the robots of one of `pairs` pairs know before the first tick, and what they can measure."""
    if pair.before is not None or pair.now.tick != 0 or not {*pair.ids} <= pair.now.observations.keys():
        return
    each = "Each robot" if len(pair.ids) > 1 else pair.ids[0]
    moves = "how it moves" if pair.exact else "roughly how it moves"
    text = f"{each} knows where the anchors are and {moves}, but not where it is or which way it heads."
    if pairs > 1 < len(pair.ids):
        text = f"{listed(pair.ids)} are one of {pairs} pairs. {text}"
    yield "rules", text
    without = [robot for robot in pair.ids if pair.now.observations[robot].anchor_range is None]
    measured = "how far away its anchor or the other robot is"
    text = f"A robot measures {measured}, up to {sensing_range:g} m, but not in which direction."
    if len(without) == len(pair.ids):
        text = f"{text} There is no distance to an anchor yet."
    elif without:
        text = f"{text} {without[0]} has no distance to its anchor yet."
    truth = ["The simulated sensors are exact."] if pair.exact else []
    yield "ranging", text, " ".join([*truth, *filter(None, [attacked(pair, "will report")])]) or None


def mirrored(pair: PairData) -> Told:
    """Yield which robots now have two possible poses relative to their anchors, if sensors are exact."""
    robots = [robot for robot, was, held in pair.estimates() if not was.local and len(held.local) == 2]
    if robots and pair.exact:
        who = f"{listed(robots)} each have" if len(robots) > 1 else f"{robots[0]} has"
        relative = f"relative to {'their anchors' if len(robots) > 1 else 'its anchor'}"
        after = "After a straight drive and a second distance"
        yield "mirrored", f"{after}, {who} two possible poses {relative}, mirror images of each other."


def choosing_branch(pair: PairData) -> Told:
    """Yield how each robot that had several possible poses relative to its anchor is left with one."""
    for robot, was, held in pair.estimates():
        if was.world or held.world or len(was.local) < 2 or len(held.local) != 1:
            continue
        had = f"{robot} had {count_word(len(was.local))} possible poses relative to its anchor"
        all_but_one = "one of them" if len(was.local) == 2 else "all but one of them"
        what, observation = "What it has measured since", pair.now.observations.get(robot)
        if observation is not None:
            rho = observation.anchor_range
            what = "That no distance is measured now"
            what = what if rho is None else f"The distance now measured, {metres(rho)},"
        yield "branch", f"{had}. {what} rules out {all_but_one}."


def searching(pair: PairData) -> Told:
    """Yield what the robots know when all of them have begun phase 2, and how they search."""
    commands = [pair.commands(robot) for robot in pair.ids]
    earlier = [before.phase for before, _ in commands if before is not None]
    phases = [now.phase for _, now in commands if now is not None]
    if len(earlier) + len(phases) < 2 * len(pair.ids) or min(phases) < 2 or min(earlier) >= 2:
        return
    if all(_knows_path(pair.held(robot)[1]) for robot in pair.ids):
        subject = "each robot" if len(pair.ids) > 1 else pair.ids[0]
        what = "knows its path" if pair.exact else "has an estimate of its path"
        turned = "but the whole path may be turned around the anchor by any angle."
        yield "path", f"After a short drive, {subject} {what} relative to its anchor, {turned}"
    if max(phases) < 3:
        yield "search", _search(pair)


def _knows_path(held: Estimate | None) -> bool:
    """Return whether one pose relative to the anchor is left, or more probable than all others together."""
    if held is None or not held.local:
        return False
    return len(held.local) == 1 or (
        not held.world and bool(held.probabilities) and held.probabilities[0] > 0.5
    )


def _search(pair: PairData) -> str:
    moving = [robot for robot in pair.robots if robot.orbit.v != 0.0]
    if len(moving) > 1:
        slow, fast = sorted(moving, key=lambda robot: abs(robot.orbit.omega))
        text = "They drive on circles around their anchors to find each other"
        if abs(slow.orbit.omega) == abs(fast.orbit.omega):
            return f"{text}."
        both = "so that sooner or later both are near where the circles cross"
        return f"{text}, {slow.id} more slowly than {fast.id}, {both}."
    waits = ", which waits near its own" if len(pair.ids) > 1 else ""
    if not moving:
        return f"{pair.ids[0]} waits near its anchor for {pair.robots[0].peer}."
    return f"{moving[0].id} drives on a circle around its anchor to find {moving[0].peer}{waits}."


def beginning_again(pair: PairData) -> Told:
    """Yield which robot drives back to its anchor, since it missed its peer or is not localised by it."""
    for robot in pair.robots:
        before, now = pair.commands(robot.id)
        if before is None or now is None or robot.orbit.v == 0.0 or now.task != "homing":
            continue
        if before.phase == 3:
            failed = f"{robot.id} has not found out where it is from its distances to {robot.peer}."
        elif before.task == "orbiting":
            failed = f"{robot.id} has not met {robot.peer} on its circle."
        else:
            continue
        yield "search", f"{failed} It drives back to its anchor to measure its pose again."


# --- phase 3 ----------------------------------------------------------------------------------------

STATES_OF_ONE_MOVER = ("straight", "turning", "circling")
"""The states in which one robot drives to get a second mutual range, while the other stands."""


def meeting(pair: PairData) -> Told:
    """Yield that the robots have come into each other's range, or have left it."""
    now, had = pair.contact(pair.now), pair.contact(pair.before)
    if pair.before is None and pair.now.tick != 0:
        return
    if now is None:
        if had is not None and all(robot in pair.now.observations for robot in pair.ids):
            yield "contact-lost", "They have left each other's range."
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
        yield "contact", f"{meet}. The distance between them is not measured in this tick."
    elif swap and not again:
        reports = "reports" if pair.own_planner else "reports of their paths"
        yield "contact", f"{meet}, {metres(now.range)} apart, and exchange {reports}.{_alone(pair)}"
    else:
        measure = f"They measure the distance between them, {metres(now.range)}."
        yield "contact", f"{meet}. {measure}{_alone(pair)}"


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


def fitting(pair: PairData) -> Told:
    """Yield how many configurations appear, are left, or are added; once if both robots have as many."""
    changes: dict[tuple[int, int], list[str]] = {}
    for robot, was, held in pair.estimates():
        if len(was.world) != len(held.world) and (was.world or not held.localised):
            changes.setdefault((len(was.world), len(held.world)), []).append(robot)
    for (had, has), robots in changes.items():
        for_whom = "" if len(robots) == len(pair.ids) else f"for {robots[0]}, "
        if has < had:
            yield "measured", _ruling_out(pair, had - has)
            yield "ruled-out", sentence(_left(pair, for_whom, had, has))
        else:
            text = f"{for_whom}{_fit(pair, had, has)}{_most_probable(pair, robots[0])}"
            distances = _two_distances(pair) if pair.exact and not had and has > 1 else ""
            yield "configurations", f"{distances}{sentence(text)}"


def _fit(pair: PairData, had: int, has: int) -> str:
    """Return that `has` configurations fit, instead of `had`, as a clause."""
    if had:
        fit = "configuration of the robots fits" if has == 1 else "configurations of the robots fit"
        return f"{count_word(has)} {fit} now, instead of {count_word(had)}"
    if has == 1:
        return "one configuration of the robots fits what was measured and reported"
    pose = "one angle, and so one pose," if pair.exact else "one pose"
    poses = f"each with {pose} of {pair.ids[0]} and one of {pair.robots[0].peer}"
    return f"{count_word(has)} configurations fit, {poses}"


def _two_distances(pair: PairData) -> str:
    """Return a sentence on the distances of the tick before and of this one; empty if they are equal."""
    found = [pair.contact(pair.before), pair.contact(pair.now)]
    lengths = [metres(one.range) for one in found if one is not None and one.range is not None]
    return f"The distance was {lengths[0]} and is {lengths[1]} now. " if len(set(lengths)) > 1 else ""


def _ruling_out(pair: PairData, count: int) -> str:
    """Return what rules `count` configurations out, before it says how many are left."""
    contact = pair.contact(pair.now)
    if contact is None or contact.range is None:
        return "What was measured and reported since rules configurations out."
    if count == 1:
        why = "predicted another distance" if pair.exact else "does not fit it"
        others = f"The configuration that {why} is ruled out."
    else:
        why = "predicted another distance" if pair.exact else "do not fit it"
        others = f"Configurations that {why} are ruled out, one by one."
    return f"The distance is {metres(contact.range)} now. {others}"


def _left(pair: PairData, for_whom: str, had: int, has: int) -> str:
    if has == 0:
        return f"{for_whom}no configuration fits what was measured and reported any more"
    verb, only = ("is left", "only ") if has == 1 else ("are left", "")
    text = f"{for_whom}{only}{count_word(has)} of the {count_word(had)} configurations {verb}"
    commands = [pair.now.commands.get(robot) for robot in pair.ids]
    ended = any(command is not None and command.verdict is not None for command in commands)
    return text if has > 1 or ended else f"{text}. It is not claimed yet"


def _most_probable(pair: PairData, robot: str) -> str:
    """Return the probability of the first of several configurations, as the end of a sentence."""
    held = pair.held(robot)[1]
    if held is None or len(held.probabilities) < 2:
        return ""
    return f", the most probable with {min(round(100 * held.probabilities[0]), 99)} %"


def planning(pair: PairData) -> Told:
    """Yield the beginning of each last manoeuvre, or of active sensing with several configurations."""
    for robot in pair.ids:
        held = pair.held(robot)[1]
        if held is None or not held.world or not pair.begins(robot, "last-manoeuvre"):
            continue
        if len(held.world) == 1:
            yield "manoeuvre", f"{robot} makes a manoeuvre to test it with a distance from another place."
            continue
        stands = [one for one in pair.ids if one != robot and pair.state(one) in ("waiting", "standing")]
        drives = f"Now {stands[0]} stands still and {robot} drives" if stands else f"{robot} drives"
        where = f"to where the {count_word(len(held.world))} predict distances that differ most"
        yield "manoeuvre", f"{drives} {where}: then the next measured distance can tell which one is true."
    new = [robot for robot, was, held in pair.estimates() if not was.world and len(held.world) > 1]
    if len([robot for robot in new if pair.state(robot) == "surveying"]) == len(pair.ids) > 1:
        yield "manoeuvre", "Both drive to where the next distances are expected to distinguish them best."


def concluding(pair: PairData, all_localised: bool) -> Told:
    """Yield the new verdicts, but not claims with which all are localised: the last caption is about them."""
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
                yield without_claim(robot, verdict, truth)
    if not claiming or all_localised:
        return
    if len(claiming) == len(pair.ids) > 1:
        yield "claim", "Both claim to know their poses."
    else:
        yield "claim", f"{claiming[0]} claims to know its pose{', too' if claimed else ''}."
