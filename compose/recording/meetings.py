"""The meetings of a group: which one each robot is in, tick by tick, as its commands and reports show.

A robot leaves for its next meeting with a command of the state "travelling", once the robot that it has
visited has a verdict. It may travel to the same robot again if it has lost contact with it before. The peer
is the next one of the plan, and after the plan, the nearest one that should be localised by then; robots of
which it has heard that they are localised are left out. Once the two are in contact, the robot sends its log
to no other one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from compose.recording.run import Run
from compose.recording.run_setup import PresentMeeting, RunSetup
from protocol.messages import Command, Localised, Observation
from protocol.motion import Pose

TRAVELLING = "travelling"
"""The state of a robot that drives to the next robot of its group."""

ARRIVED = 0.55
"""The distance from an anchor at which a visit there ends, as a fraction of R: R / 2 and some tolerance."""

Meetings = Mapping[str, PresentMeeting]
"""The meeting of each robot; robots in their first meeting may be absent."""


class GroupTick(msgspec.Struct, frozen=True):
    """The known data of one tick of a group."""

    commands: Mapping[str, Command]
    """The commands by robot."""
    logs: Iterable[tuple[str, str]]
    """The senders and receivers of the reports with a log."""
    heard: Mapping[str, Sequence[str]]
    """The senders of the reports that each robot receives."""
    place: Callable[[str], Pose | None]
    """Returns where a robot is, as far as it is known."""


class PastMeeting(msgspec.Struct, frozen=True):
    """A meeting of a group in a run."""

    a: str
    """The robot of role a: the visitor."""
    b: str
    """The robot of role b."""
    first: int
    """The tick in which the visitor leaves for it; 0 if it is the first one of both robots."""
    last: int
    """The tick before the first of the robots leaves for its next meeting, or the last one of the run."""
    number: int = 1
    """The number of meetings of the two so far, this one included."""
    newcomers: frozenset[str] = frozenset()
    """The robots whose first meeting this is."""


def senders(observation: Observation) -> list[str]:
    """Return the robots of which reports are received in the tick of `observation`."""
    return [one.peer for one in observation.contacts if one.heard or one.heard is None]


def meetings_after(
    setup: RunSetup, meetings: Meetings, earlier: Mapping[str, Command], now: GroupTick
) -> Meetings:
    """Return the meetings in the tick of `now`; `meetings` are those before, `earlier` the last commands.

    Without an earlier command of a robot, for a viewer that has missed the start, its meeting is the first
    one of the plan whose peer has no verdict yet.
    """
    changed: dict[str, PresentMeeting] = {}
    receivers: dict[str, list[str]] = {}
    for sender, receiver in now.logs:
        if receiver in setup.partners and receiver != sender:  # anyone can be named as a receiver
            receivers.setdefault(sender, []).append(receiver)
    for robot, partners in setup.partners.items():
        command, before = now.commands.get(robot), earlier.get(robot)
        if command is None:
            continue
        present = was = meetings.get(robot, PresentMeeting(partners[0], False))
        localised = before is not None and isinstance(before.verdict, Localised)
        if before is None and command.tick > 0 and isinstance(command.verdict, Localised):
            known = frozenset([one for one in setup.ids if _has_verdict(one, now.commands)])
            changed[robot] = PresentMeeting(_next(setup, robot, None, now, known), True, known)
            continue
        known = present.known | {one for one in now.heard.get(robot, ()) if _has_verdict(one, earlier)}
        met = command.state != TRAVELLING or not present.visiting
        if (localised and met and _has_verdict(present.peer, earlier)) or _missed(setup, robot, present, now):
            known |= {present.peer}
        leaves = command.state == TRAVELLING and (not present.visiting or present.peer in known)
        to = receivers.get(robot, [])
        if to and present.peer not in to:
            present = PresentMeeting(to[0], localised)
        elif leaves:
            present = PresentMeeting(_next(setup, robot, present.peer, now, known), True)
        present = present._replace(known=known)
        if present != was:
            changed[robot] = present
    return {**meetings, **changed} if changed else meetings


def _next(setup: RunSetup, robot: str, peer: str | None, now: GroupTick, known: Collection[str]) -> str:
    """Return the robot that `robot` visits after `peer`; the same if there is no other one."""
    partners = setup.partners[robot]
    after = partners[partners.index(peer) + 1 :] if peer in partners else partners[1:]
    planned = [one for one in after if one not in known]
    if planned:
        return planned[0]
    here, time = now.place(robot), now.commands[robot].tick * setup.mission.period
    late = [
        one
        for one in setup.anchored
        if one.id != robot and one.id not in known and setup.bounds_s.get(one.id, time) < time
    ]
    if here is None or not late:
        return peer if peer is not None else partners[-1]
    return min(late, key=lambda one: math.hypot(one.anchor.x - here.x, one.anchor.y - here.y)).id


def _missed(setup: RunSetup, robot: str, present: PresentMeeting, now: GroupTick) -> bool:
    """Return whether a robot with exact sensors has come to where its peer should be, and it is not there."""
    here, anchor = now.place(robot), setup.robot_setup(present.peer).anchor
    if here is None or not (present.visiting and setup.mission.noise.exact):
        return False
    near = math.hypot(anchor.x - here.x, anchor.y - here.y) < ARRIVED * setup.mission.sensing_range
    travels = now.commands[robot].state == TRAVELLING
    return travels and near and present.peer not in now.heard.get(robot, ())


def _has_verdict(robot: str, commands: Mapping[str, Command]) -> bool:
    command = commands.get(robot)
    return command is not None and command.verdict is not None


# --- of a run -----------------------------------------------------------------------------------------


def past_meetings(run: Run) -> tuple[PastMeeting, ...]:
    """Return the meetings of the group in `run` that have begun, in that order; empty for pairs."""
    setup = run.setup
    if setup is None or not setup.visits:
        return ()
    begun = _begun(run, setup)
    found = [
        PastMeeting(one.id, one.peer, 0, _last(begun, one.id, one.peer, 0, run.length))
        for one in setup.anchored
        if one.role == "a" and one.peer in begun and begun[one.peer][0][1].peer == one.id
    ]
    found += [
        PastMeeting(robot, meeting.peer, tick, _last(begun, robot, meeting.peer, tick, run.length))
        for robot, meetings in begun.items()
        for tick, meeting in meetings[1:]
        if meeting.visiting
    ]
    return _numbered(sorted(found, key=lambda one: (one.first, one.last)))


def _numbered(meetings: Sequence[PastMeeting]) -> tuple[PastMeeting, ...]:
    """Return `meetings`, which are in their order, with their numbers and newcomers."""
    found: list[PastMeeting] = []
    times: Counter[frozenset[str]] = Counter()
    met: set[str] = set()
    for one in meetings:
        robots = frozenset((one.a, one.b))
        times[robots] += 1
        found.append(replace(one, number=times[robots], newcomers=robots - met))
        met |= robots
    return tuple(found)


Begun = Mapping[str, list[tuple[int, PresentMeeting]]]
"""The meetings of each robot with the ticks in which they begin."""


def _begun(run: Run, setup: RunSetup) -> Begun:
    begun = {robot: [(0, PresentMeeting(setup.partners[robot][0], False))] for robot in setup.partners}
    meetings: Meetings = {}
    latest: dict[str, Command] = {}
    paths = {robot: run.truth(robot) for robot in setup.ids}
    for tick in range(run.length):
        found = {robot: run.command(robot, tick) for robot in setup.ids}
        commands = {robot: command for robot, command in found.items() if command is not None}
        poses = {robot: path[tick] for robot, path in paths.items() if tick < len(path)}
        heard = {robot: senders(one) for robot, one in run.observations[tick].items()}
        now = GroupTick(commands, _logs(run, tick), heard, poses.get)
        after = meetings_after(setup, meetings, latest, now)
        for robot, meeting in after.items():
            if meeting[:2] != begun[robot][-1][1][:2]:
                begun[robot].append((tick, meeting))
        meetings, latest = after, {**latest, **commands}
    return begun


def _logs(run: Run, tick: int) -> Iterable[tuple[str, str]]:
    for robot, agent in run.agents.items():
        if tick < len(agent.steps):
            step = agent.steps[tick]
            for contact, framed in zip(step.observation.contacts, step.reports, strict=False):
                if framed.report.has_log:
                    yield robot, contact.peer


def _last(begun: Begun, a: str, b: str, first: int, length: int) -> int:
    """Return the last tick of the meeting of `a` and `b` that begins in tick `first`."""
    leaves = [tick for tick, _ in begun[a] if tick > first]
    leaves += [tick for tick, meeting in begun[b] if tick > first and meeting.peer != a]
    return min([length, *leaves]) - 1
