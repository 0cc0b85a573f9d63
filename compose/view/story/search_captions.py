"""Captions of phases 1 and 2: ranges to the anchors, branches, paths, and the search for the peer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from compose.recording.run_setup import RobotSetup
from compose.view.events import metres
from compose.view.pair_data import PairData
from compose.view.story.caption import Caption, attacked, count_word, listed
from protocol.messages import Estimate


def rules(pair: PairData, pairs: int) -> Iterator[Caption]:
    """Yield what the robots know before the first tick. `pairs` is the number of pairs."""
    if not _first(pair):
        return
    each = "Each robot" if len(pair.ids) > 1 else pair.ids[0]
    moves = "how it moves" if pair.exact else "roughly how it moves"
    text = f"{each} knows where the anchors are and {moves}, but not where it is or which way it heads."
    if pairs > 1 < len(pair.ids):
        text = f"{listed(pair.ids)} are one of {pairs} pairs. {text}"
    yield Caption("rules", text, pair.ids)


def ranging(pair: PairData, sensing_range: float) -> Iterator[Caption]:
    """Yield what the robots can measure, up to the sensing range in m, and what they do in the first tick."""
    if not _first(pair):
        return
    ranged = [robot for robot in pair.ids if pair.now.observations[robot].anchor_range is not None]
    without = [robot for robot in pair.ids if robot not in ranged]
    measured = "how far away its anchor or the other robot is"
    text = f"A robot measures {measured}, up to {sensing_range:g} m, but not in which direction."
    if not ranged:
        text = f"{text} There is no distance to an anchor yet."
    elif without:
        text = f"{text} {without[0]} has no distance to its anchor yet."
    truth = ["The simulated sensors are exact."] if pair.exact else []
    truth += filter(None, [attacked(pair, "will report")])
    yield Caption("ranging", text, pair.ids, " ".join(truth) or None)


def _first(pair: PairData) -> bool:
    return pair.before is None and pair.now.tick == 0 and {*pair.ids} <= pair.now.observations.keys()


def mirrored(pair: PairData) -> Iterator[Caption]:
    """Yield which robots now have two possible poses relative to their anchors, if sensors are exact."""
    robots = []
    for robot in pair.ids if pair.exact else ():
        earlier, held = pair.held(robot)
        if earlier is not None and held is not None and not earlier.local and len(held.local) == 2:
            robots.append(robot)
    if robots:
        who = f"{listed(robots)} each have" if len(robots) > 1 else f"{robots[0]} has"
        relative = f"relative to {'their anchors' if len(robots) > 1 else 'its anchor'}"
        after = "After a straight drive and a second distance"
        text = f"{after}, {who} two possible poses {relative}, mirror images of each other."
        yield Caption("mirrored", text, pair.ids)


def choosing_branch(pair: PairData) -> Iterator[Caption]:
    """Yield how each robot that had several possible poses relative to its anchor is left with one."""
    for robot in pair.ids:
        earlier, held = pair.held(robot)
        if earlier is None or held is None or earlier.world or held.world:
            continue
        if len(earlier.local) < 2 or len(held.local) != 1:
            continue
        had = f"{robot} had {count_word(len(earlier.local))} possible poses relative to its anchor"
        all_but_one = "one of them" if len(earlier.local) == 2 else "all but one of them"
        yield Caption("branch", f"{had}. {_measured_now(pair, robot)} rules out {all_but_one}.", pair.ids)


def _measured_now(pair: PairData, robot: str) -> str:
    """Return what the robot has measured in this tick, as the subject of a sentence."""
    observation = pair.now.observations.get(robot)
    if observation is None:
        return "What it has measured since"
    if observation.anchor_range is None:
        return "That no distance is measured now"
    return f"The distance now measured, {metres(observation.anchor_range)},"


def searching(pair: PairData) -> Iterator[Caption]:
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
        yield Caption(
            "path", f"After a short drive, {subject} {what} relative to its anchor, {turned}", pair.ids
        )
    if max(phases) < 3:
        yield Caption("search", _search(pair.robots), pair.ids)


def beginning_again(pair: PairData) -> Iterator[Caption]:
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
        yield Caption("search", f"{failed} It drives back to its anchor to measure its pose again.", pair.ids)


def _search(robots: Sequence[RobotSetup]) -> str:
    moving = [robot for robot in robots if robot.orbit.v != 0.0]
    if len(moving) > 1:
        slow, fast = sorted(moving, key=lambda robot: abs(robot.orbit.omega))
        text = "They drive on circles around their anchors to find each other"
        if abs(slow.orbit.omega) == abs(fast.orbit.omega):
            return f"{text}."
        both = "so that sooner or later both are near where the circles cross"
        return f"{text}, {slow.id} more slowly than {fast.id}, {both}."
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
