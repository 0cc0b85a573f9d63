"""What there is to tell of one robot of a record."""

from __future__ import annotations

import math
from functools import cached_property
from itertools import groupby

import msgspec

from compose.recording.claim import Claim
from compose.recording.run import Recording
from compose.recording.summary_json import first_claim
from protocol.messages import Estimate
from protocol.motion import Pose
from world.scenario import RobotSpec


class Span(msgspec.Struct, frozen=True):
    """Ticks in a row in which the robot is in one of the paper's phases."""

    phase: int
    first: int
    last: int


class Story(msgspec.Struct, frozen=True, dict=True):
    """One robot's mission, and what it thought of it."""

    recording: Recording
    place: int
    """in the scenario"""
    held: tuple[Estimate, ...]
    """what it held possible, as it journaled"""

    @property
    def own(self) -> RobotSpec:
        """Who it is."""
        return self.recording.scenario.robots[self.place]

    @property
    def peer(self) -> RobotSpec:
        """Whom it is to find."""
        return self.recording.scenario.robot(self.own.peer)

    @property
    def exact(self) -> bool:
        """Whether its sensors are: then nothing is likelier than anything else that is possible."""
        return self.recording.scenario.mission.noise.exact

    @property
    def last(self) -> int:
        """The last tick on record."""
        return max(0, len(self.recording.moments) - 1)

    def truth(self, robot: str | None = None) -> list[Pose]:
        """Where it was, or `robot`, in every tick; at least where it was released."""
        places = {one.id: i for i, one in enumerate(self.recording.scenario.robots)}
        place = self.place if robot is None else places[robot]
        poses = [moment.truth.poses[place] for moment in self.recording.moments]
        return poses or [self.recording.scenario.robots[place].start]

    @cached_property
    def estimates(self) -> list[tuple[Estimate, Pose]]:
        """Each with where the robot was then, as far as both are on record."""
        truth = self.truth()
        return [(one, truth[one.tick]) for one in self.held if one.tick < len(truth)]

    @cached_property
    def placed(self) -> list[tuple[Estimate, Pose]]:
        """Those that say where in the plane it is, which nothing tells before the two have met."""
        return [(one, truth) for one, truth in self.estimates if one.world]

    @cached_property
    def weighed(self) -> bool:
        """Whether it held one pose for likelier than another, as it does where sensors are not exact."""
        return any(one.probabilities for one in self.held)

    @cached_property
    def likeliest(self) -> list[tuple[Estimate, Pose]]:
        """Those of `placed` whose first pose is likelier than others, or the only one."""
        return [(one, truth) for one, truth in self.placed if one.probabilities or len(one.world) == 1]

    def others(self, estimate: Estimate) -> tuple[Pose, ...]:
        """Where else in the plane it may be than at the likeliest pose; all of them, where none is that."""
        return estimate.world[1:] if estimate.probabilities or len(estimate.world) == 1 else estimate.world

    @cached_property
    def claim(self) -> Claim | None:
        """The first, if it ever claimed."""
        return first_claim(self.recording, self.place)

    @cached_property
    def phases(self) -> tuple[Span, ...]:
        """In order, over all ticks on record; one in which no Command came goes with those before."""
        told, phase = [], 1
        for moment in self.recording.moments:
            command = moment.commands.get(self.own.id)
            phase = command.phase if command is not None else phase
            told.append((phase, moment.truth.tick))
        spans = []
        for phase, ticks in groupby(told, key=lambda one: one[0]):
            run = [tick for _, tick in ticks]
            spans.append(Span(phase, run[0], run[-1]))
        return tuple(spans) or (Span(1, 0, 0),)

    @property
    def encounter_tick(self) -> int | None:
        """The tick in which phase 3 began."""
        return next((span.first for span in self.phases if span.phase == 3), None)


def error(pose: Pose, truth: Pose) -> float:
    """m"""
    return math.hypot(pose.x - truth.x, pose.y - truth.y)
