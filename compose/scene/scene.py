"""What there is to see of one tick. A scene follows from what is known of the tick and of the one before."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Literal

import msgspec

from compose.scene.facts import Facts
from compose.scene.stage import Seat, Stage
from compose.scene.words import doing
from protocol.messages import Alarm, Contact, Drive, End, Localised, Odds, Phase, Verdict, Word
from protocol.motion import Controls, Covariance, Pose, wrap

Kind = Literal[
    "anchor", "anchor-lost", "contact", "contact-lost", "phase", "state", "branch", "candidates",
    "claim", "undecided", "alarm", "report-lost", "report-damaged", "report-late", "report-doubled",
    "late", "end",
]  # fmt: skip
Passing = Literal["sent", "heard", "damaged", "lost"]


class Event(msgspec.Struct, frozen=True):
    """Something that happens in a tick, in a sentence."""

    tick: int
    kind: Kind
    robot: str | None
    """whom it concerns, first; none at the end"""
    text: str


class Sent(msgspec.Struct, frozen=True):
    """A report that a robot says to its peer."""

    bytes: int
    phase: Phase
    state: Word
    through: int
    """its log covers the manoeuvres through this tick"""
    heard: int
    """it knows the peer's through this one"""


class Decision(msgspec.Struct, frozen=True):
    """What a robot does until the next tick."""

    v: float
    omega: float
    phase: Phase
    state: Word
    verdict: Verdict | None = None


class Held(msgspec.Struct, frozen=True):
    """What a robot holds possible."""

    local: tuple[Pose, ...]
    """in the frame of its own anchor; `Seat.frame` says where that lies"""
    world: tuple[Pose, ...]
    odds: tuple[Odds, ...]
    """of each of `world`, or, while there is none, of `local`; none where each is equally possible"""
    covariance: Covariance | None
    """of the first of `world`"""
    localised: bool


class Player(msgspec.Struct, frozen=True, omit_defaults=True):
    """One robot in one tick; none is what did not happen, or is not known."""

    robot: str
    doing: str
    """in a sentence"""
    pose: Pose | None = None
    """the true one; its heading is wrapped"""
    sensed: bool = False
    """whether its Sense is known; if not, no range tells nothing"""
    executed: Controls | None = None
    """until this tick, as its odometry measured it"""
    anchor_range: float | None = None
    contacts: tuple[Contact, ...] = ()
    sent: Sent | None = None
    drive: Decision | None = None
    held: Held | None = None


class Passage(msgspec.Struct, frozen=True):
    """What becomes of a report in this tick; a report that is under way is nowhere."""

    sender: str
    receiver: str
    tick: int
    """in which it was sent"""
    what: Passing
    """`lost` is told by the world's journal only"""


class Scene(msgspec.Struct, frozen=True):
    """One tick."""

    tick: int
    players: tuple[Player, ...]
    """in the order of the stage"""
    passages: tuple[Passage, ...]
    events: tuple[Event, ...]

    def player(self, robot: str) -> Player:
        """Raises KeyError if nobody is called that."""
        for player in self.players:
            if player.robot == robot:
                return player
        raise KeyError(robot)


def scene(stage: Stage, before: Facts | None, now: Facts, end: End | None = None) -> Scene:
    """What there is to see in the tick of `now`; `before` is the tick before, if it is known."""
    passages = tuple(_passages(stage, before, now))
    events = [event for seat in stage.robots for event in _events(seat, before, now)]
    events += _radio_events(now.tick, passages)
    if end is not None and end.tick == now.tick:
        why = f" ({end.reason})" if end.reason else ""
        events.append(Event(now.tick, "end", None, f"The mission ends: {end.outcome}{why}"))
    return Scene(now.tick, tuple([_player(seat, now) for seat in stage.robots]), passages, tuple(events))


def _player(seat: Seat, now: Facts) -> Player:
    robot = seat.id
    pose, sense, said = now.truth.get(robot), now.senses.get(robot), now.reports.get(robot)
    drive, estimate = now.drives.get(robot), now.estimates.get(robot)
    sentence = f"{robot} has not answered"
    if drive is not None:
        sentence = doing(seat, drive.phase, drive.state, drive.verdict)
    elif robot in now.late:
        sentence = f"{robot} has not answered in time, and stands still"
    return Player(
        robot=robot,
        doing=sentence,
        pose=Pose(pose.x, pose.y, wrap(pose.heading)) if pose is not None else None,
        sensed=sense is not None,
        executed=sense.executed if sense is not None else None,
        anchor_range=sense.anchor_range if sense is not None else None,
        contacts=sense.contacts if sense is not None else (),
        sent=(
            Sent(said.bytes, said.report.phase, said.report.state, said.report.through, said.report.heard)
            if said is not None
            else None
        ),
        drive=(
            Decision(drive.v, drive.omega, drive.phase, drive.state, drive.verdict)
            if drive is not None
            else None
        ),
        held=(
            Held(estimate.local, estimate.world, estimate.odds, estimate.covariance, estimate.localised)
            if estimate is not None
            else None
        ),
    )


# --- the radio --------------------------------------------------------------------------------------


def _passages(stage: Stage, before: Facts | None, now: Facts) -> Iterator[Passage]:
    """Of every link, in the order of its sender: what is sent, what comes, and what is lost."""
    for seat in stage.robots:
        link = seat.id, seat.peer
        sent = seat.id in now.reports or _contact(now, seat.id, seat.peer) is not None
        if sent:
            yield Passage(*link, now.tick, "sent")
        contact = _contact(now, seat.peer, seat.id)
        heard, damaged = (contact.heard, contact.damaged) if contact is not None else ((), ())
        yield from [Passage(*link, tick, "heard") for tick in heard]
        yield from [Passage(*link, tick, "damaged") for tick in damaged]
        if link in now.under_way and (before is None or link in before.under_way):
            earlier = before.under_way[link] if before is not None else ()
            left = Counter(heard) + Counter(damaged) + Counter(now.under_way[link])
            for tick in sorted({*earlier, *((now.tick,) if sent else ())} - set(left)):
                yield Passage(*link, tick, "lost")


def _contact(now: Facts, robot: str, peer: str) -> Contact | None:
    """With `peer`, of `robot`, if they are in range and that is known."""
    sense = now.senses.get(robot)
    return next((one for one in sense.contacts if one.peer == peer), None) if sense is not None else None


def _radio_events(tick: int, passages: tuple[Passage, ...]) -> Iterator[Event]:
    came = Counter((one.receiver, one.tick) for one in passages if one.what == "heard")
    for one in passages:
        whose = f"{one.sender}'s report of tick {one.tick}"
        match one.what:
            case "lost":
                yield Event(tick, "report-lost", one.sender, f"{whose} to {one.receiver} is lost")
            case "damaged":
                yield Event(tick, "report-damaged", one.receiver, f"{one.receiver} refuses {whose}: damaged")
            case "heard" if one.tick < tick:
                late = f"{tick - one.tick} tick{'s' if tick - one.tick > 1 else ''} late"
                yield Event(tick, "report-late", one.receiver, f"{one.receiver} hears {whose}, {late}")
    for (receiver, sent), times in came.items():
        if times > 1:
            text = f"{receiver} hears the report of tick {sent} {times} times"
            yield Event(tick, "report-doubled", receiver, text)


# --- what happens to a robot ------------------------------------------------------------------------


def _events(seat: Seat, before: Facts | None, now: Facts) -> Iterator[Event]:
    yield from _sensing(seat, before, now)
    yield from _deciding(seat, before, now)
    yield from _believing(seat, before, now)


def _sensing(seat: Seat, before: Facts | None, now: Facts) -> Iterator[Event]:
    robot, peer, tick = seat.id, seat.peer, now.tick
    sense = now.senses.get(robot)
    earlier = before.senses.get(robot) if before is not None else None
    if sense is None or (before is not None and earlier is None):
        return
    was = earlier.anchor_range if earlier is not None else None
    if was is None and sense.anchor_range is not None:
        text = f"{robot} is in its anchor's range: {metres(sense.anchor_range)}"
        yield Event(tick, "anchor", robot, text)
    if was is not None and sense.anchor_range is None:
        yield Event(tick, "anchor-lost", robot, f"{robot} has no range to its anchor any more")
    if seat.role == "b" and peer in now.senses:  # of a pair, a tells it
        return
    contact = _contact(now, robot, peer)
    near = before is not None and _contact(before, robot, peer) is not None
    if contact is not None and not near:
        far = f": {metres(contact.range)}" if contact.range is not None else ""
        yield Event(tick, "contact", robot, f"{robot} and {peer} are in range of each other{far}")
    if contact is None and near:
        yield Event(tick, "contact-lost", robot, f"{robot} and {peer} have lost contact")


def _deciding(seat: Seat, before: Facts | None, now: Facts) -> Iterator[Event]:
    robot, tick = seat.id, now.tick
    if robot in now.late:
        yield Event(tick, "late", robot, f"{robot}'s answer did not come in time; it stands still")
    if robot in now.without:
        yield Event(
            tick, "late", robot, f"{robot} goes without {seat.peer}'s report, which did not come in time"
        )
    drive = now.drives.get(robot)
    earlier = before.drives.get(robot) if before is not None else None
    if drive is None or (before is not None and earlier is None):
        return
    if earlier is None or drive.phase != earlier.phase:
        yield Event(tick, "phase", robot, f"{robot} begins phase {drive.phase}: {PHASES[drive.phase]}")
    if (earlier is None or drive.state != earlier.state) and drive.verdict is None:
        yield Event(tick, "state", robot, doing(seat, drive.phase, drive.state, None))
    if drive.verdict is not None and (earlier is None or earlier.verdict is None):
        yield _verdict(seat, drive, now)


def _verdict(seat: Seat, drive: Drive, now: Facts) -> Event:
    robot = seat.id
    match drive.verdict:
        case Localised(pose):
            x, y, heading = pose.x, pose.y, wrap(pose.heading)
            text = f"{robot} claims to be at ({x:.2f}, {y:.2f}) m, heading {heading:+.2f} rad"
            truth = now.truth.get(robot)
            if truth is not None:
                text += f"; it is {metres(math.hypot(x - truth.x, y - truth.y))} off"
            return Event(now.tick, "claim", robot, text)
        case verdict:
            kind: Kind = "alarm" if isinstance(verdict, Alarm) else "undecided"
            return Event(now.tick, kind, robot, doing(seat, drive.phase, drive.state, verdict))


PHASES = {1: "its own anchor", 2: "the search for its peer", 3: "the encounter"}


def _believing(seat: Seat, before: Facts | None, now: Facts) -> Iterator[Event]:
    robot, tick = seat.id, now.tick
    held = now.estimates.get(robot)
    earlier = before.estimates.get(robot) if before is not None else None
    if held is None or earlier is None:
        return
    if len(held.local) == 1 != len(earlier.local) and not held.world:
        yield Event(tick, "branch", robot, f"{robot} has chosen its branch: it knows where its anchor is")
    many, few = len(earlier.world), len(held.world)
    if many == 0 < few:
        ways = "one placement of the two is" if few == 1 else f"{few} placements of the two are"
        yield Event(tick, "candidates", robot, f"for {robot}, {ways} possible")
    elif many != few > 0:
        change = "fall" if few < many else "rise"
        yield Event(tick, "candidates", robot, f"{robot}'s candidates {change} from {many} to {few}")


def metres(length: float) -> str:
    """A length as one reads it."""
    return f"{length:.2f} m" if 0.095 <= length < 1e5 else f"{length:.2g} m"
