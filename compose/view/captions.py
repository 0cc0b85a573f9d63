"""Captions of a mission: a sentence or two for each important event, for readers who do not know the method.

Captions follow from the data of a tick and of the one before, as events do. There are far fewer of them; each
is about a pair, or about robots of a group or a team. They state what was measured,
held, claimed and decided, and no more: a claim counts as true only once the mission has ended `localised`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal

import msgspec

from compose.recording.reasons import plain_reason
from compose.recording.run_setup import ESTIMATED, RobotSetup, RunSetup
from compose.view.deliveries import contact_of
from compose.view.events import Event, metres
from compose.view.pair_data import PairData
from compose.view.run_data import TickData
from compose.view.words import TRAVELLING
from protocol.messages import Estimate, Inconsistent, Localised, MissionEnd
from protocol.motion import travelled

CaptionKind = Literal[
    "rules", "ranging", "mirrored", "branch", "path", "search", "contact", "contact-lost", "configurations",
    "manoeuvre", "measured", "ruled-out", "claim", "undecided", "inconsistent", "down", "back", "late",
    "report-lost", "report-damaged", "report-late", "report-doubled", "cut", "end", "cost",
]  # fmt: skip
FAULTS: dict[CaptionKind, str] = {
    "undecided": "robots do not claim their poses",
    "inconsistent": "robots find contradictions",
    "down": "processes are gone",
    "back": "processes are back",
    "late": "deadlines are missed",
    "report-lost": "reports are lost",
    "report-damaged": "reports arrive damaged",
    "report-late": "reports arrive late",
    "report-doubled": "reports arrive more than once",
}
"""The kinds of captions that tell events: verdicts without a claim, kills and faults; words for several."""
LEAST_GAP_M = 1e-6
"""The least distance in m between a reported and a true position that counts as a difference."""
MOST_TOLD, MOST_LISTED_LINKS, MOST_LISTED_ROBOTS = 2, 2, 4
"""The largest numbers of events of one kind, of links and of robots that a caption tells one by one."""
COUNTS = (
    "no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve",
)  # fmt: skip
"""Small numbers as words."""
STATES_OF_ONE_MOVER = ("straight", "turning", "circling")
"""The states in which one robot drives to get a second mutual range, while the other stands."""


class Caption(msgspec.Struct, frozen=True, omit_defaults=True):
    """One caption. Several captions of a tick are shown one after the other."""

    kind: CaptionKind
    text: str
    """The caption; empty if it is about the ground truth or the scenario only."""
    robots: tuple[str, ...] = ()
    """The robots that the caption is about; empty if it is about all."""
    truth: str | None = None
    """A further sentence that follows from the ground truth or the scenario only; None if there is none."""


Told = Iterator[Caption]


def captions(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    events: Sequence[Event],
    end: MissionEnd | None,
    gaps: Mapping[str, float] | None = None,
) -> Told:
    """Yield the captions of the tick of `now`, and at last that of the end of the mission.

    `events` are those of this tick, `setup` has the present peers of robots, and `gaps` how far from its true
    position in m each attacker reports to be. Claims with which all are localised have no caption: that of
    the end is about them.
    """
    ended = end if end is not None and end.tick == now.tick else None
    pairs: list[Sequence[RobotSetup]] = [*setup.pairs()]
    if setup.visits:
        units = [
            *[(pair, TOLD_OF_MEETINGS) for pair in pairs if before is not None],
            (setup.robots, TOLD_OF_GROUPS),
        ]
    elif setup.team:
        units = [(setup.robots, TOLD_OF_TEAMS)]
    else:
        paired = {robot.id for pair in pairs for robot in pair}
        pairs += [(robot,) for robot in setup.robots if robot.id not in paired]
        units = [(pair, TOLD_OF_PAIRS) for pair in pairs]
    over = ended is not None and ended.outcome == "localised"
    for robots, story in units:
        group = PairData(robots, setup, before, now, events, gaps or {})
        untold = OF_PHASES if group.own_planner else ()
        for tell in story:
            if tell not in untold:
                for caption in tell(group):
                    if not (over and caption.kind == "claim"):
                        yield caption
    yield from cutting(setup, now)
    if not setup.visits:  # of the world
        yield from happening(PairData((), setup, before, now, [one for one in events if one.robot is None]))
    if ended is not None:
        yield _ending(setup, now, ended)


# --- words ------------------------------------------------------------------------------------------


def count_word(number: int) -> str:
    """Return a number as a word, if it is small."""
    return COUNTS[number] if number < len(COUNTS) else str(number)


def listed(names: Sequence[str], what: str = "robots") -> str:
    """Return `names` as a list, or their number if they are many."""
    if len(names) > MOST_LISTED_ROBOTS:
        return f"{len(names)} {what}"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def stopped(text: str) -> str:
    """Return `text` as the end of a sentence."""
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def attacked(group: PairData, reports: str) -> str | None:
    """Return a sentence about the attackers; None if there are none. `reports` is its verb."""
    attackers = [robot.id for robot in group.robots if robot.attack is not None]
    return f"{listed(attackers)} {reports} false data about itself." if attackers else None


def believed(group: PairData) -> str | None:
    """Return how far off the positions would be that attackers report; None if none is off."""
    off = [(robot, gap) for robot in group.ids if (gap := group.gaps.get(robot, 0.0)) >= LEAST_GAP_M]
    places = listed([f"{robot} would be {metres(gap)} off" for robot, gap in off], "robots would be off")
    return f"Believed, {places}." if off else None


# --- phases 1 and 2 ---------------------------------------------------------------------------------


def beginning(pair: PairData) -> Told:
    """Yield what the robots of a pair know before the first tick, and what they can measure."""
    if pair.before is not None or pair.now.tick != 0 or not {*pair.ids} <= pair.now.observations.keys():
        return
    each, pairs = "Each robot" if len(pair.ids) > 1 else pair.ids[0], len(pair.setup.pairs())
    moves = "how it moves" if pair.exact else "roughly how it moves"
    text = f"{each} knows where the anchors are and {moves}, but not where it is or which way it heads."
    if pairs > 1 < len(pair.ids):
        text = f"{listed(pair.ids)} are one of {pairs} pairs. {text}"
    yield Caption("rules", text, pair.ids)
    without = [robot for robot in pair.ids if pair.now.observations[robot].anchor_range is None]
    reach = f"up to {pair.setup.mission.sensing_range:g} m, but not in which direction."
    text = f"A robot measures how far away its anchor or the other robot is, {reach}"
    if len(without) == len(pair.ids):
        text = f"{text} There is no distance to an anchor yet."
    elif without:
        text = f"{text} {without[0]} has no distance to its anchor yet."
    truth = ["The simulated sensors are exact."] if pair.exact else []
    truth += filter(None, [attacked(pair, "will report")])
    yield Caption("ranging", text, pair.ids, " ".join(truth) or None)


def group_beginning(group: PairData) -> Told:
    """Yield who meets first, and what follows."""
    setup = group.setup
    if group.before is not None or group.now.tick != 0:
        return
    visited = {visit.visited for visit in setup.visits}
    first = [f"{one.id} meets {one.peer}" for one in setup.anchored if one.id not in visited]
    meet = f"First, {listed(first, 'pairs meet')}"
    meet += "; then those that are localised drive to the others." if len(first) < len(setup.visits) else "."
    number = count_word(len(setup.robots)).capitalize()
    text = f"{number} robots measure no more than the distance to their own anchor"
    if found := len(setup.robots) - len(setup.anchored):
        text += f", and {found} have none"
        meet += " At last, they cover the area to find those without an anchor."
    yield Caption("ranging", f"{text}. {meet}", truth=attacked(group, "will report"))


def mirrored(pair: PairData) -> Told:
    """Yield which robots now have two hypotheses relative to their anchors, if sensors are exact."""
    robots = [robot for robot, was, held in pair.estimates() if not was.local and len(held.local) == 2]
    if robots and pair.exact:
        who = f"{listed(robots)} each have" if len(robots) > 1 else f"{robots[0]} has"
        relative = f"relative to {'their anchors' if len(robots) > 1 else 'its anchor'}"
        text = f"{who} two hypotheses of the pose {relative}, mirror images of each other."
        yield Caption("mirrored", f"After a straight drive and a second distance, {text}", pair.ids)


def choosing_branch(pair: PairData) -> Told:
    """Yield how each robot that had several hypotheses relative to its anchor is left with one."""
    for robot, was, held in pair.estimates():
        if was.world or held.world or len(was.local) < 2 or len(held.local) != 1:
            continue
        had = f"{robot} had {count_word(len(was.local))} hypotheses of its pose relative to its anchor"
        all_but_one = "one of them" if len(was.local) == 2 else "all but one of them"
        what, observation = "What it has measured since", pair.now.observations.get(robot)
        if observation is not None:
            rho = observation.anchor_range
            what = f"The distance now measured, {metres(rho)}," if rho else "That no distance is measured now"
        yield Caption("branch", f"{had}. {what} rules out {all_but_one}.", pair.ids)


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
        text = f"After a short drive, {subject} {what} relative to its anchor, {turned}"
        yield Caption("path", text, pair.ids)
    if max(phases) < 3:
        yield Caption("search", _search(pair), pair.ids)


def _knows_path(held: Estimate | None) -> bool:
    """Return whether one pose relative to the anchor is left, or more probable than all others together."""
    if held is None or not held.local:
        return False
    return len(held.local) == 1 or (
        not held.world and bool(held.probabilities) and held.probabilities[0] > 0.5
    )


def _search(pair: PairData) -> str:
    moving = sorted([one for one in pair.robots if one.orbit.v != 0.0], key=lambda one: abs(one.orbit.omega))
    if not moving:
        return f"{pair.ids[0]} waits near its anchor for {pair.robots[0].peer}."
    if len(moving) == 1:
        waits = ", which waits near its own" if len(pair.ids) > 1 else ""
        return f"{moving[0].id} drives on a circle around its anchor to find {moving[0].peer}{waits}."
    slow, fast = moving
    text = "They drive on circles around their anchors to find each other"
    if abs(slow.orbit.omega) == abs(fast.orbit.omega):
        return f"{text}."
    both = "so that sooner or later both are near where the circles cross"
    return f"{text}, {slow.id} more slowly than {fast.id}, {both}."


def beginning_again(pair: PairData) -> Told:
    """Yield which robot drives back to its anchor, since it missed its peer or is not localised by it."""
    for robot in pair.robots:
        before, now = pair.commands(robot.id)
        if before is None or now is None or robot.orbit.v == 0.0 or now.task != "homing":
            continue
        failed = f"{robot.id} has not met {robot.peer} on its circle."
        if before.phase == 3:
            failed = f"{robot.id} has not found out where it is from its distances to {robot.peer}."
        if before.phase == 3 or before.task == "orbiting":
            text = f"{failed} It drives back to its anchor to measure its pose again."
            yield Caption("search", text, pair.ids)


def departing(group: PairData) -> Told:
    """Yield the beginnings of sweeps, and of the ways to other robots, in one caption each.

    A sweep that goes on after a stop does not begin.
    """
    commands = {robot: group.commands(robot) for robot in group.ids}
    tasks = {robot: (was.task, now.task) for robot, (was, now) in commands.items() if was and now}
    sweeps = [
        robot for robot, (was, task) in tasks.items() if task == "sweeping" and was not in (task, "looping")
    ]
    if sweeps:
        verb = "covers" if len(sweeps) == 1 else "cover"
        text = f"{listed(sweeps)} {verb} the area to find robots without an anchor."
        yield Caption("search", text, tuple(sweeps))
    leaving = [robot for robot, (was, task) in tasks.items() if task == TRAVELLING != was]
    found = [(robot, peer) for robot in leaving if (peer := group.setup.robot_setup(robot).peer)]
    if found:
        waits = "waits beside its anchor" if len(found) == 1 else "wait beside their anchors"
        ways = listed([f"{robot} drives to {peer}" for robot, peer in found], "robots drive to others")
        yield Caption("search", f"{ways}, which {waits}.", tuple(robot for pair in found for robot in pair))


# --- teams ------------------------------------------------------------------------------------------


def team_beginning(team: PairData) -> Told:
    """Yield what the robots of a team know before the first tick, and what they share."""
    setup, number = team.setup, len(team.ids)
    if team.before is not None or team.now.tick != 0:
        return
    known = sum([one.position is not None for one in setup.anchors])
    places = "There is no anchor"
    if setup.anchors:
        verb = "anchor is" if known == 1 else "anchors are"
        places = f"The positions of {count_word(known)} {verb} known"
        if unknown := len(setup.anchors) - known:
            places += f", {'that' if unknown == 1 else 'those'} of {count_word(unknown)} more not"
    who = f"{setup.ids[0]} does not know" if number == 1 else "No robot knows"
    text = f"{places}. {who} where it is or which way it heads."
    if setup.origin is not None:
        text = f"{places}. All poses are those in the frame in which {setup.origin} starts at the origin."
    yield Caption("rules", text)
    shared = "" if number == 1 else f"{count_word(number).capitalize()} robots share all that they measure. "
    what = ["an anchor"] * bool(setup.anchors) + ["another robot"] * (number > 1)
    reach = "" if setup.mode == ESTIMATED else f", up to {setup.mission.sensing_range:g} m"
    text = f"{shared}A robot measures how far away {' or '.join(what)} is{reach}, but not in which direction."
    yield Caption("ranging", text, truth="The simulated sensors are exact." if team.exact else None)


def locating(team: PairData) -> Told:
    """Yield how many poses are first possible by all measurements, and which robots have one left."""
    new, left = [], []
    for robot, was, held in team.estimates():
        if not was.world and held.world and not held.localised and robot != team.setup.origin:
            new.append((robot, len(held.world)))
        elif len(was.world) > len(held.world) == 1:
            left.append(robot)
    if new:
        what = " hypothesis" if new[0][1] == 1 else " hypotheses"
        poses = [
            f"{count_word(count)}{what if i == 0 else ''} of {one}" for i, (one, count) in enumerate(new)
        ]
        text = f"At first, the distances leave {listed(poses, 'robots a few hypotheses')}."
        yield Caption("configurations", text, tuple([robot for robot, _ in new]))
    if left:
        yield Caption("ruled-out", f"One hypothesis of {listed(left)} is left.", tuple(left))


def leaving(team: PairData) -> Told:
    """Yield which robots begin to drive past another anchor, since one does not tell them their headings."""
    commands = [(robot, *team.commands(robot)) for robot in team.ids]
    robots = [robot for robot, was, now in commands if was and now and now.task == "orbiting" != was.task]
    if robots:
        verb = "drives" if len(robots) == 1 else "drive"
        why = "to where another one is in range: from one alone, the bearing is not known"
        text = f"{listed(robots)} {verb} on a circle around an anchor, {why}."
        yield Caption("search", text, tuple(robots))


# --- phase 3 ----------------------------------------------------------------------------------------


def meeting(pair: PairData) -> Told:
    """Yield that the robots of a pair have come into each other's range, or, outside groups, have left it."""
    now, had = pair.contact(pair.now), pair.contact(pair.before)
    if pair.before is None and pair.now.tick != 0:
        return
    known = all(robot in pair.now.observations for robot in pair.ids)
    if now is None and had is not None and known and not pair.setup.visits:
        yield Caption("contact-lost", "They have left each other's range.", pair.ids)
    if now is None or had is not None:
        return
    commands = [command for robot in pair.ids if (command := pair.commands(robot)[0]) is not None]
    one, other = pair.ids if len(pair.ids) > 1 else (pair.ids[0], pair.robots[0].peer)
    again = not pair.own_planner and any(command.phase == 3 for command in commands)
    text = [f"{one} and {other} meet."]
    if again:
        text = [f"{one} and {other} are in range of each other again."]
    elif any(command.task == TRAVELLING for command in commands):
        text = [f"{one} reaches {other}."]
    measured = "The distance between them is not measured in this tick."
    text += [measured if now.range is None else f"Their distance is {metres(now.range)}."]
    heard = [contact_of(pair.now, robot.id, robot.peer) for robot in pair.robots]
    if len(heard) > 1 and all(contact is not None and contact.heard for contact in heard) and not again:
        text += [f"They exchange reports{'' if pair.own_planner else ' of their paths'}."]
    phases = [command.phase for robot in pair.ids if (command := pair.now.commands.get(robot)) is not None]
    driving, standing = pair.in_state(*STATES_OF_ONE_MOVER), pair.in_state("standing")
    alone = phases == [3, 3] and driving and standing and not pair.own_planner
    if alone and now.range is not None and not pair.setup.visits:
        still = f"while {standing[0]} stands still"
        text += [f"{driving[0]} drives on to measure a second distance, {still}."]
    just_told = any(event.kind == "inconsistent" for event in pair.events)
    yield Caption("contact", " ".join(text), pair.ids, None if just_told else believed(pair))


def fitting(pair: PairData) -> Told:
    """Yield how many hypotheses appear, are left, or are added; once if both robots have as many."""
    changes: dict[tuple[int, int], list[str]] = {}
    for robot, was, held in pair.estimates():
        if len(was.world) != len(held.world) and (was.world or not held.localised):
            changes.setdefault((len(was.world), len(held.world)), []).append(robot)
    for (had, has), robots in changes.items():
        whom = "" if len(robots) == len(pair.ids) else f"for {robots[0]}, "
        if has < had:
            yield Caption("measured", _ruling_out(pair, had - has), pair.ids)
            yield Caption("ruled-out", _sentence(whom + _left(pair, had, has)), pair.ids)
        else:
            text, latest = whom + _fit(pair, had, has), pair.held(robots[0])[1]
            if latest is not None and len(latest.probabilities) > 1:
                share = 100.0 * latest.probabilities[0]
                text += f", the most probable with {'more than 99' if share > 99.0 else round(share)} %"
            distances = _two_distances(pair) if pair.exact and not had and has > 1 else ""
            yield Caption("configurations", f"{distances}{_sentence(text)}", pair.ids)


def _sentence(text: str) -> str:
    return stopped(text[0].upper() + text[1:])


def _fit(pair: PairData, had: int, has: int) -> str:
    """Return that `has` hypotheses fit, instead of `had`, as a clause."""
    if had:
        fit = "hypothesis fits" if has == 1 else "hypotheses fit"
        return f"{count_word(has)} {fit} now, instead of {count_word(had)}"
    if has == 1:
        return "one hypothesis fits what was measured and reported"
    pose = "one angle, and so one pose," if pair.exact else "one pose"
    poses = f"each with {pose} of {pair.ids[0]} and one of {pair.robots[0].peer}"
    return f"{count_word(has)} hypotheses fit, {poses}"


def _two_distances(pair: PairData) -> str:
    """Return a sentence on the distances of the tick before and of this one; empty if they are equal."""
    found = [pair.contact(pair.before), pair.contact(pair.now)]
    lengths = [metres(one.range) for one in found if one is not None and one.range is not None]
    return f"The distance was {lengths[0]} and is {lengths[1]} now. " if len({*lengths}) > 1 else ""


def _ruling_out(pair: PairData, count: int) -> str:
    """Return what rules `count` hypotheses out, before it says how many are left."""
    contact = pair.contact(pair.now)
    if contact is None or contact.range is None:
        return "What was measured and reported since rules hypotheses out."
    why = "predicted another distance" if pair.exact else "does not fit it" if count == 1 else "do not fit it"
    others = f"The hypothesis that {why} is ruled out."
    if count > 1:
        others = f"Hypotheses that {why} are ruled out, one by one."
    return f"The distance is {metres(contact.range)} now. {others}"


def _left(pair: PairData, had: int, has: int) -> str:
    if has == 0:
        return "no hypothesis fits what was measured and reported any more"
    verb, only = ("is left", "only ") if has == 1 else ("are left", "")
    text = f"{only}{count_word(has)} of the {count_word(had)} hypotheses {verb}"
    commands = [pair.now.commands.get(robot) for robot in pair.ids]
    ended = any(command is not None and command.verdict is not None for command in commands)
    return text if has > 1 or ended else f"{text}. It is not claimed yet"


def planning(pair: PairData) -> Told:
    """Yield the beginning of each last manoeuvre, or of active sensing with several hypotheses."""
    for robot, held in [(robot, pair.held(robot)[1]) for robot in pair.ids]:
        if held is None or not held.world or not pair.begins(robot, "last-manoeuvre"):
            continue
        text = f"{robot} makes a manoeuvre to test it with a distance from another place."
        if len(held.world) > 1:
            stands = [one for one in pair.in_state("waiting", "standing") if one != robot]
            drives = f"Now {stands[0]} stands still and {robot} drives" if stands else f"{robot} drives"
            where = f"to where the {count_word(len(held.world))} predict distances that differ most"
            text = f"{drives} {where}: then the next measured distance can tell which one is true."
        yield Caption("manoeuvre", text, pair.ids)
    new = {robot for robot, was, held in pair.estimates() if not was.world and len(held.world) > 1}
    if len(new.intersection(pair.in_state("surveying"))) == len(pair.ids) > 1:
        text = "Both drive to where the next distances are expected to distinguish them best."
        yield Caption("manoeuvre", text, pair.ids)


# --- verdicts, faults and the end -------------------------------------------------------------------


def concluding(group: PairData) -> Told:
    """Yield the new claims in one caption; events tell other verdicts, and claims that are withdrawn."""
    commands = {robot: group.commands(robot) for robot in group.ids}
    decided = [robot for robot, (before, _) in commands.items() if before and before.verdict is not None]
    claims = [robot for robot, (_, now) in commands.items() if now and isinstance(now.verdict, Localised)]
    claiming = [robot for robot in claims if robot not in decided]
    if claiming and (group.before is not None or not group.setup.visits):
        known = sum([isinstance(one.verdict, Localised) for one in group.now.commands.values()])
        robots, many = len(group.setup.robots), len(claiming) > 1
        text = "Both" if many and robots == 2 else listed(claiming)
        text += " claim to know their poses" if many else " claims to know its pose"
        text += f": {known} of {robots} robots now do." if robots > 2 else "."
        yield Caption("claim", text, group.ids if group.setup.in_pairs else tuple(claiming))


def happening(group: PairData) -> Told:
    """Yield a caption for each kind of events in FAULTS; it is about their robots, or about their pair."""
    if not group.events:
        return
    attackers = attacked(group, "does report") or "No robot reports false data."
    attackers = " ".join(filter(None, [attackers, believed(group)]))
    mine = None if group.setup.visits else group.ids or None
    for kind, several in FAULTS.items():
        found = [one for one in group.events if one.kind == kind and (mine is None or one.robot in mine)]
        if found:
            many = f"{count_word(len(found)).capitalize()} {several}."
            text = many if len(found) > MOST_TOLD else " ".join([stopped(one.text) for one in found])
            whom = tuple(sorted({one.robot for one in found if one.robot is not None}))
            yield Caption(kind, text, mine or whom, attackers if kind == "inconsistent" else None)


def cutting(setup: RunSetup, now: TickData) -> Told:
    """Yield the partitions that begin in this tick, which only the scenario tells."""
    for fault in setup.faults:
        if fault.partition and fault.ticks is not None and fault.ticks[0] == now.tick:
            whose = ""
            if (link := fault.link) is not None:
                between, and_ = ("between", "and") if link.both else ("from", "to")
                whose = f" {between} {link.sender} {and_} {link.receiver}"
            yield Caption(
                "cut", "", truth=f"From now on, no report{whose} arrives before tick {fault.ticks[1]}."
            )


Teller = Callable[[PairData], Told]
OF_PHASES: tuple[Teller, ...] = (mirrored, searching, beginning_again, planning)
"""The captions that need the phases and states of a shipped planner."""
TOLD_OF_PAIRS: tuple[Teller, ...] = (
    beginning, mirrored, choosing_branch, searching, beginning_again, meeting, fitting, planning, concluding,
    happening,
)  # fmt: skip
TOLD_OF_MEETINGS: tuple[Teller, ...] = (meeting,)
TOLD_OF_GROUPS: tuple[Teller, ...] = (group_beginning, concluding, departing, happening)
TOLD_OF_TEAMS: tuple[Teller, ...] = (team_beginning, leaving, locating, concluding, happening)
"""The captions of a pair, of the present meetings of a group, of the whole group, and of a team, in order."""


def _ending(setup: RunSetup, now: TickData, end: MissionEnd) -> Caption:
    """Return the caption of the end of the mission."""
    plain, robots = plain_reason(end), len(setup.robots)
    why = f": {stopped(plain)}" if plain else "."
    truth = _claim_errors(setup, now)
    match end.outcome:
        case "localised":
            who = {1: setup.ids[0], 2: "Both"}.get(robots, f"All {robots} robots")
            are, each = ("is", "it") if robots == 1 else ("are", "each")
            text = f"{who} {are} localised: {each} knows its position and its heading."
        case "undecided":
            text = f"The {'recording' if setup.mode == ESTIMATED else 'mission'} ends undecided{why}"
            truth = " ".join(filter(None, [_silent_links(setup), truth])) or None
        case "inconsistent":
            verdicts = [now.commands[robot].verdict for robot in setup.ids if robot in now.commands]
            just_told = robots == 2 and any(isinstance(verdict, Inconsistent) for verdict in verdicts)
            text = f"The mission ends inconsistent{'.' if just_told else why}"
        case "wrong":
            text = f"The mission ends with a wrong claim{why}"
        case _:
            text = f"The mission fails{why}"
    return Caption("end", text, truth=truth)


def _silent_links(setup: RunSetup) -> str | None:
    """Return a sentence about the links that deliver nothing all the time; None if there are none."""
    dead = [
        fault
        for fault in setup.faults
        if (fault.partition or not fault.let_through) and fault.ticks is None and fault.contact_ticks is None
    ]
    pairs = [(robot.id, robot.peer) for robot in setup.robots if robot.peer is not None]
    links = [f"from {one} to {peer}" for one, peer in pairs if any(fault.on(one, peer) for fault in dead)]
    if len(links) > MOST_LISTED_LINKS:
        return f"No report arrives on {len(links)} of the {len(setup.robots)} links between robots."
    return f"No report {' or '.join(links)} ever arrives." if links else None


def _claim_errors(setup: RunSetup, now: TickData) -> str | None:
    """Return a sentence about the position errors of claims; None without claims or the ground truth."""
    errors = [
        travelled(truth, estimate.world[0])
        for robot, estimate in now.estimates.items()
        if estimate.localised and estimate.world and (truth := now.truth.get(robot)) is not None
    ]
    if not errors:
        return None
    claims = "claimed position is" if len(errors) == 1 else "claimed positions are"
    if max(errors) < 1e-6:
        exact = ": the simulated sensors are exact" if setup.mission.noise.exact else ""
        return f"The {claims} off by less than 1 µm{exact}."
    return f"The {claims} off by {'' if len(errors) == 1 else 'at most '}{metres(max(errors))}."
