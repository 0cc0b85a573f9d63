"""Captions of a mission: a sentence or two for each important event.

Captions follow from the data of a tick and of the one before, as events do. There are far fewer of them; each
is about a pair, or about robots of a group, whose meetings have fewer captions. They state what
was measured, held, claimed and decided, and no more: a claim counts as true only once the mission has ended
`localised`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from compose.recording.reasons import plain_reason
from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.deliveries import contact_of
from compose.view.events import Event, metres
from compose.view.pair_data import PairData
from compose.view.run_data import TickData
from compose.view.story import pair_captions
from compose.view.story.caption import Caption, count_word, faults, stopped, without_claim
from compose.view.words import TRAVELLING
from protocol.messages import Inconsistent, Localised, MissionEnd
from protocol.motion import travelled

MOST_LISTED_LINKS = 2
"""The largest number of links that a sentence names."""
MOST_LISTED_ROBOTS = 4
"""The largest number of robots or meetings that a sentence names."""
TOLD_OF_PAIRS: tuple[tuple[Callable[[PairData], pair_captions.Told], bool], ...] = (
    (pair_captions.mirrored, True),
    (pair_captions.choosing_branch, False),
    (pair_captions.searching, True),
    (pair_captions.beginning_again, True),
    (pair_captions.meeting, False),
    (pair_captions.fitting, False),
    (pair_captions.planning, True),
)
"""The captions of a pair, in order; those that are True need the phases and states of a shipped planner."""


def captions(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    events: Sequence[Event],
    end: MissionEnd | None,
) -> Iterator[Caption]:
    """Yield the captions of the tick of `now`, and at last that of the end of the mission.

    `events` are those of this tick, and `setup` has the present peers of robots.
    """
    ended = end if end is not None and end.tick == now.tick else None
    all_localised = ended is not None and ended.outcome == "localised"
    if setup.visits:
        yield from _of_group(setup, before, now, all_localised)
        yield from faults(events)
    else:
        yield from _of_pairs(setup, before, now, events, all_localised)
    if ended is not None:
        yield _ending(setup, now, ended)


def _of_pairs(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    events: Sequence[Event],
    all_localised: bool,
) -> Iterator[Caption]:
    """Yield the captions pair by pair, and those of faults of no robot."""
    pairs: list[tuple[RobotSetup, ...]] = [*setup.pairs()]
    paired = {robot.id for pair in pairs for robot in pair}
    pairs += [(robot,) for robot in setup.robots if robot.id not in paired]
    for robots in pairs:
        pair = PairData(robots, setup.mission.noise.exact, before, now)
        told = [*pair_captions.beginning(pair, len(pairs), setup.mission.sensing_range)]
        for tell, of_phases in TOLD_OF_PAIRS:
            told += () if of_phases and pair.own_planner else tell(pair)
        told += pair_captions.concluding(pair, all_localised)
        yield from [Caption(kind, text, pair.ids, *truth) for kind, text, *truth in told]
        yield from faults([one for one in events if one.robot in pair.ids], pair.ids)
    yield from faults([one for one in events if one.robot is None])


# --- groups -----------------------------------------------------------------------------------------


def _of_group(
    setup: RunSetup, before: TickData | None, now: TickData, all_localised: bool
) -> Iterator[Caption]:
    """Yield who meets first, who drives to whom, and how many robots claim to know their poses."""
    if before is None:
        if now.tick == 0:
            yield _beginning(setup)
        return
    yield from _meeting(setup, before, now)
    yield from _concluding(setup, before, now, all_localised)
    yield from _departing(setup, before, now)


def _beginning(setup: RunSetup) -> Caption:
    visited = {visit.visited for visit in setup.visits}
    first = [f"{one.id} meets {one.peer}" for one in setup.anchored if one.id not in visited]
    meet = f"First, {_listed(first, 'pairs meet')}"
    meet += "; then those that are localised drive to the others." if len(first) < len(setup.visits) else "."
    number = count_word(len(setup.robots)).capitalize()
    text = f"{number} robots measure no more than the distance to their own anchor"
    if found := len(setup.robots) - len(setup.anchored):
        text += f", and {found} have none"
        meet += " At last, they sweep the area for those without an anchor."
    attackers = [robot.id for robot in setup.robots if robot.attack is not None]
    truth = f"{_listed(attackers, 'robots')} will report false data." if attackers else None
    return Caption("ranging", f"{text}. {meet}", truth=truth)


def _meeting(setup: RunSetup, before: TickData, now: TickData) -> Iterator[Caption]:
    """Yield the first contact of each meeting, and those after contact was lost."""
    for a, b in setup.pairs():
        contact = contact_of(now, a.id, b.id) or contact_of(now, b.id, a.id)
        if contact is None or contact_of(before, a.id, b.id) or contact_of(before, b.id, a.id):
            continue
        far = f" Their distance is {metres(contact.range)}." if contact.range is not None else ""
        command = before.commands.get(a.id)
        if command is not None and command.phase == 3:
            text = f"{a.id} and {b.id} are in range of each other again."
        else:
            visits = command is not None and command.task == TRAVELLING
            text = f"{a.id} reaches {b.id}." if visits else f"{a.id} and {b.id} meet."
        yield Caption("contact", text + far, (a.id, b.id))


def _concluding(setup: RunSetup, before: TickData, now: TickData, all_localised: bool) -> Iterator[Caption]:
    """Yield the new verdicts, but not claims with which all are localised: the last caption is about them."""
    claiming = []
    for robot in setup.robots:
        command, earlier = now.commands.get(robot.id), before.commands.get(robot.id)
        pair, had = (robot.id, robot.peer), earlier is not None and earlier.verdict is not None
        if command is not None and command.verdict is None and had:
            text = f"{robot.id} withdraws its claim, because its meeting with {robot.peer} contradicts it."
            yield Caption("undecided", text, pair)
        if command is None or command.verdict is None or had:
            continue
        match command.verdict:
            case Localised():
                claiming.append(robot.id)
            case verdict:
                kind, text, _ = without_claim(robot, verdict)
                yield Caption(kind, text, pair)
    if not claiming or all_localised:
        return
    known = sum([isinstance(one.verdict, Localised) for one in now.commands.values()])
    many = len(claiming) > 1
    claim = "claim to know their poses" if many else "claims to know its pose"
    text = f"{_listed(claiming, 'robots')} {claim}"
    yield Caption("claim", f"{text}: {known} of {len(setup.robots)} robots now do.", tuple(claiming))


def _departing(setup: RunSetup, before: TickData, now: TickData) -> Iterator[Caption]:
    """Yield the beginnings of sweeps, and of the ways to other robots, in one caption each.

    A sweep that goes on after a stop does not begin.
    """
    tasks = {
        one.id: (earlier.task, command.task)
        for one in setup.robots
        if (earlier := before.commands.get(one.id)) and (command := now.commands.get(one.id))
    }
    sweeps = [
        robot for robot, (was, task) in tasks.items() if task == "sweeping" and was not in (task, "looping")
    ]
    if sweeps:
        verb = "sweeps" if len(sweeps) == 1 else "sweep"
        text = f"{_listed(sweeps, 'robots')} {verb} the area for robots without an anchor."
        yield Caption("search", text, tuple(sweeps))
    leaving = [robot for robot, (was, task) in tasks.items() if task == TRAVELLING != was]
    found = [(robot, setup.robot_setup(robot).peer) for robot in leaving]
    if not found:
        return
    waits = "waits beside its anchor" if len(found) == 1 else "wait beside their anchors"
    ways = [f"{robot} drives to {peer}" for robot, peer in found]
    robots = tuple(robot for pair in found for robot in pair)
    yield Caption("search", f"{_listed(ways, 'robots drive to others')}, which {waits}.", robots)


def _listed(names: Sequence[str], what: str) -> str:
    """Return `names` as a list, or their number if they are many."""
    if len(names) > MOST_LISTED_ROBOTS:
        return f"{len(names)} {what}"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


# --- the end ----------------------------------------------------------------------------------------


def _ending(setup: RunSetup, now: TickData, end: MissionEnd) -> Caption:
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
