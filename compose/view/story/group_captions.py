"""Captions of a group: who meets first, who drives to whom, and how many robots claim to know their poses.

They are fewer than those of a pair, whose meeting has captions of its own (see `compose.view.story`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from compose.recording.run_setup import RunSetup
from compose.view.deliveries import contact_of
from compose.view.events import Event, metres
from compose.view.run_data import TickData
from compose.view.story.caption import Caption, count_word, faults
from compose.view.story.ending_captions import ending, without_claim
from compose.view.words import TRAVELLING
from protocol.messages import Localised, MissionEnd

MOST_LISTED_ROBOTS = 4
"""The largest number of robots or meetings that a sentence names."""


def group_captions(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    events: Sequence[Event],
    end: MissionEnd | None,
) -> Iterator[Caption]:
    """Yield the captions of the tick of `now` with its `events`; `setup` has the present peers of robots."""
    ended = end if end is not None and end.tick == now.tick else None
    if before is None and now.tick == 0:
        yield _beginning(setup)
    if before is not None:
        yield from _meeting(setup, before, now)
        yield from _concluding(setup, before, now, ended)
        yield from _departing(setup, before, now)
    yield from faults(events)
    if ended is not None:
        yield ending(setup, now, ended)


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


def _concluding(
    setup: RunSetup, before: TickData, now: TickData, ended: MissionEnd | None
) -> Iterator[Caption]:
    """Yield the new verdicts. Claims with which the mission ends `localised` are left to its last caption."""
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
                yield without_claim(robot, verdict, pair)
    if not claiming or (ended is not None and ended.outcome == "localised"):
        return
    known = sum([isinstance(one.verdict, Localised) for one in now.commands.values()])
    many = len(claiming) > 1
    claim = "claim to know their poses" if many else "claims to know its pose"
    text = f"{_listed(claiming, 'robots')} {claim}"
    yield Caption("claim", f"{text}: {known} of {len(setup.robots)} robots now do.", tuple(claiming))


def _departing(setup: RunSetup, before: TickData, now: TickData) -> Iterator[Caption]:
    """Yield the beginnings of sweeps, and of the ways to other robots, in one caption each."""
    sweeps = [one.id for one in setup.robots if _begins(one.id, "sweeping", before, now)]
    if sweeps:
        verb = "sweeps" if len(sweeps) == 1 else "sweep"
        text = f"{_listed(sweeps, 'robots')} {verb} the area for robots without an anchor."
        yield Caption("search", text, tuple(sweeps))
    found = []
    for one in setup.robots:
        command, earlier = now.commands.get(one.id), before.commands.get(one.id)
        leaves = command is not None and command.task == TRAVELLING
        if leaves and earlier is not None and earlier.task != TRAVELLING:
            found.append((one.id, one.peer))
    if not found:
        return
    robots = tuple(robot for pair in found for robot in pair)
    if len(found) == 1:
        ((robot, peer),) = found
        yield Caption("search", f"{robot} drives to {peer}, which waits beside its anchor.", robots)
    else:
        ways = [f"{robot} drives to {peer}" for robot, peer in found]
        text = _listed(ways, "robots drive to others")
        yield Caption("search", f"{text}, which wait beside their anchors.", robots)


def _begins(robot: str, state: str, before: TickData, now: TickData) -> bool:
    """Return whether `robot` begins a sweep in the tick of `now`, but not whether it goes on after a stop."""
    command, earlier = now.commands.get(robot), before.commands.get(robot)
    if command is None or earlier is None:
        return False
    return command.task == state and earlier.task not in (state, "looping")


def _listed(names: Sequence[str], what: str) -> str:
    """Return `names` as a list, or their number if they are many."""
    if len(names) > MOST_LISTED_ROBOTS:
        return f"{len(names)} {what}"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
