"""What there is to see of one tick. A scene follows from what is known of the tick and of the one before."""

from __future__ import annotations

import msgspec

from compose.view.cast import Seat, Stage
from compose.view.deliveries import Passage, passages
from compose.view.events import Event, events
from compose.view.facts import Facts
from compose.view.words import doing
from protocol.messages import Contact, MissionEnd, Phase, Probability, Verdict, Word
from protocol.motion import Controls, Covariance, Pose, wrap


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


class HeldPoses(msgspec.Struct, frozen=True):
    """What a robot holds possible."""

    local: tuple[Pose, ...]
    """in the frame of its own anchor; `Seat.frame` says where that lies"""
    world: tuple[Pose, ...]
    probability: tuple[Probability, ...]
    """of each of `world`, or, while there is none, of `local`; none where each is equally possible"""
    covariance: Covariance | None
    """of the first of `world`"""
    localised: bool


class Player(msgspec.Struct, frozen=True, omit_defaults=True):
    """One robot in one tick; none is what did not happen, or is not known."""

    robot: str
    mode_name: str
    """in a sentence"""
    pose: Pose | None = None
    """the true one; its heading is wrapped"""
    sensed: bool = False
    """whether its Observation is known; if not, no range tells nothing"""
    down: bool = False
    """whether its process was seen to be gone, and has not been seen again"""
    executed: Controls | None = None
    """until this tick, as its odometry measured it"""
    anchor_range: float | None = None
    contacts: tuple[Contact, ...] = ()
    sent: Sent | None = None
    command: Decision | None = None
    held: HeldPoses | None = None


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


def scene(stage: Stage, before: Facts | None, now: Facts, end: MissionEnd | None = None) -> Scene:
    """What there is to see in the tick of `now`; `before` is the tick before, if it is known."""
    players = tuple([_player(seat, now) for seat in stage.robots])
    flying = tuple(passages(stage, before, now))
    return Scene(now.tick, players, flying, tuple(events(stage, before, now, flying, end)))


def _player(seat: Seat, now: Facts) -> Player:
    robot = seat.id
    pose, observation, said = now.truth.get(robot), now.observations.get(robot), now.reports.get(robot)
    command, estimate = now.commands.get(robot), now.estimates.get(robot)
    sentence = f"{robot} has not answered"
    down = robot in now.down - now.back
    if down:
        sentence = f"{robot} is down: its process is gone"
    elif command is not None:
        sentence = doing(seat, command.phase, command.state, command.verdict)
    elif robot in now.late:
        sentence = f"{robot} has not answered in time, and stands still"
    return Player(
        robot=robot,
        mode_name=sentence,
        pose=Pose(pose.x, pose.y, wrap(pose.heading)) if pose is not None else None,
        sensed=observation is not None,
        down=down,
        executed=observation.executed if observation is not None else None,
        anchor_range=observation.anchor_range if observation is not None else None,
        contacts=observation.contacts if observation is not None else (),
        sent=(
            Sent(said.bytes, said.report.phase, said.report.state, said.report.through, said.report.heard)
            if said is not None
            else None
        ),
        command=(
            Decision(command.v, command.omega, command.phase, command.state, command.verdict)
            if command is not None
            else None
        ),
        held=(
            HeldPoses(
                estimate.local,
                estimate.world,
                estimate.probabilities,
                estimate.covariance,
                estimate.localised,
            )
            if estimate is not None
            else None
        ),
    )
