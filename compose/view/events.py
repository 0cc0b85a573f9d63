"""Events of one tick, described in sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Literal

import msgspec

from compose.recording.reasons import plain_reason
from compose.recording.run_setup import ESTIMATED, RobotSetup, RunSetup
from compose.view.deliveries import Passage, contact_of
from compose.view.run_data import TickData
from compose.view.words import doing
from protocol.messages import Command, Inconsistent, Localised, MissionEnd, Observation
from protocol.motion import travelled, wrap

Kind = Literal[
    "anchor", "anchor-lost", "contact", "contact-lost", "phase", "state", "branch", "candidates",
    "claim", "undecided", "inconsistent", "report-lost", "report-damaged", "report-late", "report-doubled",
    "late", "down", "back", "end",
]  # fmt: skip


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """One event of a tick."""

    tick: int
    kind: Kind
    robot: str | None
    """The robot concerned; None for the world or for all robots."""
    text: str
    """The event as a sentence."""
    truth: str | None = None
    """The addition of the ground truth, for views that show it; None if there is none."""

    @property
    def level(self) -> Literal["info", "warning", "error"]:
        """The level at which logs show it."""
        if self.kind == "inconsistent":
            return "error"
        return "warning" if self.kind in ("report-lost", "report-damaged", "late", "undecided") else "info"

    @property
    def whole(self) -> str:
        """The sentence with what the ground truth adds to it."""
        return self.text if self.truth is None else f"{self.text}; {self.truth}"


def events(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    passages: Sequence[Passage],
    end: MissionEnd | None,
) -> Iterator[Event]:
    """Yield the events of the tick of `now`: process events, then those of each robot, then of the radio.

    `before` is the previous tick, if it is known.
    """
    for robot in (None, *setup.ids):
        yield from _presence(robot, before, now)
    for robot_setup in setup.robots:
        yield from _sensing(robot_setup, setup, before, now)
        yield from _deciding(robot_setup, setup, before, now)
        yield from _believing(robot_setup, before, now)
    yield from _radio(now.tick, passages)
    if end is not None and end.tick == now.tick:
        plain = plain_reason(end)
        why = f" ({plain})" if plain else ""
        what = "recording" if setup.mode == ESTIMATED else "mission"
        yield Event(now.tick, "end", None, f"The {what} ends: {end.outcome}{why}")


def _presence(robot: str | None, before: TickData | None, now: TickData) -> Iterator[Event]:
    name = robot or "The world"
    if robot in now.down and (before is None or robot not in before.down - before.back):
        yield Event(now.tick, "down", robot, f"{name} is down: its process is gone")
    if robot in now.back:
        ticks, what = now.replayed.get(robot), "runs again"
        if ticks is not None:
            what = f"replayed {ticks} tick{'' if ticks == 1 else 's'}, identical"
        yield Event(now.tick, "back", robot, f"{name} is back: its process {what}")


def _radio(tick: int, passages: Sequence[Passage]) -> Iterator[Event]:
    received = Counter((one.sender, one.receiver, one.tick) for one in passages if one.what == "heard")
    for one in passages:
        report = f"{one.sender}'s report of tick {one.tick}"
        match one.what:
            case "lost":
                yield Event(tick, "report-lost", one.sender, f"{report} to {one.receiver} is lost")
            case "damaged":
                text = f"{one.receiver} rejects {report}: damaged"
                yield Event(tick, "report-damaged", one.receiver, text)
            case "heard" if one.tick < tick:
                late = f"{tick - one.tick} tick{'s' if tick - one.tick > 1 else ''} late"
                yield Event(tick, "report-late", one.receiver, f"{one.receiver} receives {report}, {late}")
    for (_, receiver, sent), times in received.items():
        if times > 1:
            text = f"{receiver} receives the report of tick {sent} {times} times"
            yield Event(tick, "report-doubled", receiver, text)


def _sensing(
    robot_setup: RobotSetup, setup: RunSetup, before: TickData | None, now: TickData
) -> Iterator[Event]:
    robot, tick = robot_setup.id, now.tick
    observation = now.observations.get(robot)
    if setup.mode == ESTIMATED:  # whoever was in range had no range in most epochs
        return
    earlier = before.observations.get(robot) if before is not None else None
    if observation is None or (before is not None and earlier is None):
        return
    was, ranges = _anchor_ranges(earlier), _anchor_ranges(observation)
    for anchor in [one for one in ranges if one not in was]:
        text = f"{robot} is in {anchor}'s range: {metres(ranges[anchor])}"
        yield Event(tick, "anchor", robot, text)
    for anchor in [one for one in was if one not in ranges]:
        yield Event(tick, "anchor-lost", robot, f"{robot} is out of {anchor}'s range")
    for peer in _contacts_told(robot_setup, setup, now):
        contact = contact_of(now, robot, peer)
        near = before is not None and contact_of(before, robot, peer) is not None
        if contact is not None and not near:
            far = f": {metres(contact.range)}" if contact.range is not None else ""
            yield Event(tick, "contact", robot, f"{robot} and {peer} are in range of each other{far}")
        if contact is None and near:
            yield Event(tick, "contact-lost", robot, f"{robot} and {peer} have lost contact")


def _anchor_ranges(observation: Observation | None) -> dict[str, float]:
    """Return the ranges to anchors, in m, by how a sentence names the anchor."""
    if observation is None:
        return {}
    own = {"its anchor": observation.anchor_range} if observation.anchor_range is not None else {}
    return own | {one.anchor: one.range for one in observation.anchors}


def _contacts_told(robot_setup: RobotSetup, setup: RunSetup, now: TickData) -> Sequence[str]:
    """Return the robots whose contacts with this one are its events; the first robot tells each once."""
    if setup.team:
        ids = setup.ids
        after = ids[ids.index(robot_setup.id) + 1 :]
        return [one for one in ids if one != robot_setup.id and (one in after or one not in now.observations)]
    if robot_setup.peer is None or (robot_setup.role == "b" and robot_setup.peer in now.observations):
        return ()
    return (robot_setup.peer,)


def _deciding(
    robot_setup: RobotSetup, setup: RunSetup, before: TickData | None, now: TickData
) -> Iterator[Event]:
    """Yield the changes of phase, state and verdict. Robots of groups and teams have states after a claim."""
    robot, tick = robot_setup.id, now.tick
    if robot in now.late and robot not in now.down:  # every tick of a robot that is down is late
        yield Event(tick, "late", robot, f"{robot} misses the deadline and stops for this tick")
    if robot in now.without:
        whose = "a" if setup.team else f"{robot_setup.peer}'s"
        text = f"{robot} decides without {whose} report, which missed the deadline"
        yield Event(tick, "late", robot, text)
    command = now.commands.get(robot)
    earlier = before.commands.get(robot) if before is not None else None
    if command is None or (before is not None and earlier is None):
        return
    if not setup.team and (earlier is None or command.phase != earlier.phase):
        name = "" if robot_setup.own_planner else f": {PHASE_NAMES[command.phase]}"
        yield Event(tick, "phase", robot, f"{robot} begins phase {command.phase}{name}")
    active = command.verdict is None or (not setup.in_pairs and command.task != "localised")
    if active and (earlier is None or command.task != earlier.task):
        yield Event(tick, "state", robot, doing(robot_setup, command.phase, command.task, None))
    if command.verdict is None and earlier is not None and earlier.verdict is not None:
        what = "later measurements contradict" if setup.team else "another meeting contradicts"
        yield Event(tick, "undecided", robot, f"{robot} withdraws its claim: {what} it")
    if command.verdict is not None and (earlier is None or earlier.verdict is None):
        yield _verdict(robot_setup, command, now)


def _verdict(robot_setup: RobotSetup, command: Command, now: TickData) -> Event:
    robot = robot_setup.id
    match command.verdict:
        case Localised(pose):
            place = with_minus(f"({pose.x:z.2f}, {pose.y:z.2f}) m, heading {wrap(pose.heading):+z.2f} rad")
            text, truth = f"{robot} claims to be at {place}", now.truth.get(robot)
            error = f"the error is {metres(travelled(pose, truth))}" if truth is not None else None
            return Event(now.tick, "claim", robot, text, error)
        case verdict:
            kind: Kind = "inconsistent" if isinstance(verdict, Inconsistent) else "undecided"
            return Event(now.tick, kind, robot, doing(robot_setup, command.phase, command.task, verdict))


PHASE_NAMES = {1: "localisation relative to its anchor", 2: "search for its peer", 3: "encounter"}
"""The names of the paper's phases, by number."""


def _believing(robot_setup: RobotSetup, before: TickData | None, now: TickData) -> Iterator[Event]:
    robot, tick = robot_setup.id, now.tick
    held = now.estimates.get(robot)
    earlier = before.estimates.get(robot) if before is not None else None
    if held is None or earlier is None:
        return
    if len(held.local) == 1 != len(earlier.local) and not held.world:
        text = f"{robot} has one hypothesis left in its anchor's frame"
        yield Event(tick, "branch", robot, text)
    previous, current = len(earlier.world), len(held.world)
    if previous != current > 0:
        change = "fall" if current < previous else "rise"
        text = f"{robot}'s hypotheses {change} from {previous} to {current}"
        if previous == 0:
            text = f"{robot} has {current} hypothes{'e' if current > 1 else 'i'}s"
        yield Event(tick, "candidates", robot, text)


def metres(length: float) -> str:
    """Return `length`, in m, as text with its unit."""
    return with_minus(f"{length:.2f} m" if 0.095 <= length < 1e5 else f"{length:.2g} m")


def with_minus(numbers: str) -> str:
    """Return `numbers` with minus signs in place of hyphens."""
    return numbers.replace("-", "\N{MINUS SIGN}")
