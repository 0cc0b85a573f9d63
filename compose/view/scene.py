"""A scene: the visible data of one tick, derived from the data of that tick and of the previous one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.captions import Caption, captions
from compose.view.configurations import Configurations, configurations
from compose.view.deliveries import Passage, passages
from compose.view.events import Event, events
from compose.view.outlines import Point, arc, ellipse
from compose.view.run_data import TickData
from compose.view.words import doing
from protocol.messages import (
    Contact,
    Localised,
    MissionEnd,
    NamedRange,
    Phase,
    Probability,
    SurveyedAnchor,
    Verdict,
    Word,
)
from protocol.mission import Role
from protocol.motion import Controls, Covariance, Pose, travelled, wrap


class Decision(msgspec.Struct, frozen=True):
    """A robot's command until the next tick: v in m/s and omega in rad/s, with phase, state and verdict."""

    v: float
    omega: float
    phase: Phase
    state: Word
    verdict: Verdict | None = None


class HeldPoses(msgspec.Struct, frozen=True, omit_defaults=True):
    """The hypotheses of a robot, as poses."""

    local: tuple[Pose, ...]
    """The poses in the frame of the robot's anchor; see `RobotSetup.frame`."""
    world: tuple[Pose, ...]
    """The poses in the world frame; empty before the robot has placed its anchor frame in it."""
    probability: tuple[Probability, ...]
    """The probability of each pose in `world`, or in `local` if `world` is empty.

    Empty if all poses are equally possible.
    """
    covariance: Covariance | None
    """The covariance of the first pose in `world`."""
    localised: bool
    arc: tuple[Point, ...] = ()
    """The outline in m of where the first pose in `world` is, if along an arc; empty if in an ellipse."""
    anchors: tuple[SurveyedAnchor, ...] = ()
    """The anchors of a team that are not surveyed, as far as the robot has located them."""

    @property
    def poses(self) -> tuple[Pose, ...]:
        """The poses in the world frame or, while there are none, in that of the anchor."""
        return self.world or self.local

    @property
    def shares(self) -> tuple[Probability, ...]:
        """The probability of each of `poses`."""
        return self.probability or (1.0 / max(1, len(self.poses)),) * len(self.poses)

    @property
    def outline(self) -> Sequence[Point]:
        """The closed outline of where the first pose in `world` is; empty without a covariance."""
        if self.covariance is None or not self.world:
            return ()
        return (*self.arc, self.arc[0]) if self.arc else ellipse(self.world[0], self.covariance)


class FalsePose(msgspec.Struct, frozen=True):
    """The pose that follows from the reports of an attacker."""

    pose: Pose
    """The pose in <W>, in the attacker's true anchor frame; its heading is not wrapped."""
    gap: float
    """Its distance in m from the true position."""


class Player(msgspec.Struct, frozen=True, omit_defaults=True):
    """One robot in one tick. A field is None if it did not occur or is unknown."""

    robot: str
    activity: str
    """The robot's task, as a sentence."""
    pose: Pose | None = None
    """The true pose; its heading is wrapped."""
    sensed: bool = False
    """True if the robot's Observation is known. If false, a missing range has no meaning."""
    down: bool = False
    """True while the robot's process is gone."""
    executed: Controls | None = None
    """The controls over the previous tick, as measured by odometry."""
    anchor_range: float | None = None
    anchors: tuple[NamedRange, ...] = ()
    """The ranges to anchors of a team."""
    contacts: tuple[Contact, ...] = ()
    command: Decision | None = None
    held: HeldPoses | None = None
    reported: FalsePose | None = None
    """The pose that the robot reports of itself, if it is an attacker and its true pose is known."""
    peer: str | None = None
    """The robot that it meets at present, or next, in a group; None for pairs."""

    def hue(self, robot_setup: RobotSetup) -> Role:
        """Return the role whose colour the robot has: in groups and teams, a once localised, b before."""
        if self.peer is None and robot_setup.role is not None:
            return robot_setup.role
        return "a" if self.command is not None and isinstance(self.command.verdict, Localised) else "b"


class PairLink(NamedTuple):
    """Two robots that meet during the run, and the line between them while they are in contact."""

    a: str
    b: str
    ends: tuple[Point, ...] = ()
    """The true positions of both in m; empty if they are not in contact, or a position is unknown."""
    range: float | None = None
    """The range between them in m, if it was measured."""


class Scene(msgspec.Struct, frozen=True):
    """The visible data of one tick."""

    tick: int
    players: tuple[Player, ...]
    """One entry per robot, in the order of `RunSetup.robots`."""
    passages: tuple[Passage, ...]
    events: tuple[Event, ...]
    captions: tuple[Caption, ...] = ()
    configurations: tuple[Configurations, ...] = ()
    """The configurations of each pair whose robots hold the same ones."""

    def player(self, robot: str) -> Player:
        """Return the entry of `robot`. Raises KeyError if there is no such robot."""
        for player in self.players:
            if player.robot == robot:
                return player
        raise KeyError(robot)

    def held_by(self, robot: str | None) -> HeldPoses | None:
        """Return the poses that `robot` holds; None if they, or the robot, are unknown."""
        return next((player.held for player in self.players if player.robot == robot), None)

    def links(self, setup: RunSetup) -> Iterator[PairLink]:
        """Yield the link of each pair that meets during the run."""
        for one, other in setup.links():
            a, b = self.player(one.id), self.player(other.id)
            contact = next((contact for contact in a.contacts if contact.peer == other.id), None)
            ends = [(player.pose.x, player.pose.y) for player in (a, b) if player.pose is not None]
            known = (tuple(ends), contact.range) if contact is not None and len(ends) == 2 else ()
            yield PairLink(one.id, other.id, *known)


def scene(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    end: MissionEnd | None = None,
    reported: Mapping[str, Pose] | None = None,
) -> Scene:
    """Return the scene of the tick of `now`; `before` is the previous tick, if it is known.

    `setup` has the peer of each robot in this tick (see `RunSetup.in_meetings`), and `reported` the poses in
    <W> that attackers report of it.
    """
    false_poses = reported or {}
    players = tuple([player_of(one, setup, now, false_poses.get(one.id)) for one in setup.robots])
    gaps = {one.robot: one.reported.gap for one in players if one.reported is not None}
    deliveries = tuple(passages(setup, now))
    found = tuple(events(setup, before, now, deliveries, end))
    return Scene(
        now.tick,
        players,
        deliveries,
        found,
        tuple(captions(setup, before, now, found, end, gaps)),
        tuple(configurations(setup, before, now)),
    )


def held_poses(robot: str | None, now: TickData) -> HeldPoses | None:
    """Return the poses that `robot` holds in the tick of `now`; None if its Estimate is unknown."""
    estimate = now.estimates.get(robot) if robot is not None else None
    if estimate is None:
        return None
    bent: tuple[Point, ...] = ()
    if estimate.world and estimate.covariance is not None:
        bent = arc(estimate.world[0], estimate.covariance)
    return HeldPoses(
        *(estimate.local, estimate.world, estimate.probabilities, estimate.covariance, estimate.localised),
        *(bent, estimate.anchors),
    )


def player_of(
    robot_setup: RobotSetup, setup: RunSetup, now: TickData, reported: Pose | None = None
) -> Player:
    """Return the entry of one robot in the scene of the tick of `now`; the arguments are as in `scene`."""
    robot, peer = robot_setup.id, robot_setup.peer
    pose, command, down = now.truth.get(robot), now.commands.get(robot), robot in now.down - now.back
    sentence = f"{robot} has not answered"
    if down:
        sentence = f"{robot} is down: its process is gone"
    elif command is not None:
        sentence = doing(robot_setup, command.phase, command.task, command.verdict)
    elif robot in now.late:
        sentence = f"{robot} has missed the deadline and stands still"
    known: dict[str, Any] = {}
    if (observation := now.observations.get(robot)) is not None:
        known["executed"], known["contacts"] = observation.executed, observation.contacts
        known["anchor_range"], known["sensed"] = observation.anchor_range, True
        known["anchors"] = observation.anchors
    if pose is not None:
        known["pose"] = Pose(pose.x, pose.y, wrap(pose.heading))
        known["reported"] = FalsePose(reported, travelled(pose, reported)) if reported is not None else None
    if command is not None:
        known["command"] = Decision(command.v, command.omega, command.phase, command.task, command.verdict)
    held = held_poses(robot, now)
    return Player(robot, sentence, down=down, held=held, peer=peer if setup.visits else None, **known)
