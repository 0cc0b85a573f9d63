"""The data of one robot of a recording for figures."""

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
    """The consecutive ticks `first` to `last` in which the robot is in one of the paper's phases."""

    phase: int
    first: int
    last: int


class Story(msgspec.Struct, frozen=True, dict=True):
    """One robot's mission: its true path and its estimates."""

    recording: Recording
    place: int
    """The index of the robot in the scenario."""
    held: tuple[Estimate, ...]
    """The robot's journaled estimates."""

    @property
    def own(self) -> RobotSpec:
        """The robot."""
        return self.recording.scenario.robots[self.place]

    @property
    def peer(self) -> RobotSpec:
        """The robot's peer."""
        return self.recording.scenario.robot(self.own.peer)

    @property
    def exact(self) -> bool:
        """True if the sensors are exact. Then all possible poses are equally probable."""
        return self.recording.scenario.mission.noise.exact

    @property
    def last(self) -> int:
        """The last recorded tick."""
        return max(0, len(self.recording.ticks) - 1)

    def truth(self, robot: str | None = None) -> list[Pose]:
        """Return the true pose of `robot`, by default this robot, in every tick; at least its start."""
        places = {one.id: i for i, one in enumerate(self.recording.scenario.robots)}
        place = self.place if robot is None else places[robot]
        poses = [moment.truth.poses[place] for moment in self.recording.ticks]
        return poses or [self.recording.scenario.robots[place].start]

    @cached_property
    def estimates(self) -> list[tuple[Estimate, Pose]]:
        """The estimates, each with the true pose in the same tick, for ticks in which both are recorded."""
        truth = self.truth()
        return [(one, truth[one.tick]) for one in self.held if one.tick < len(truth)]

    @cached_property
    def placed(self) -> list[tuple[Estimate, Pose]]:
        """The estimates with poses in the world frame, which exist only from the encounter on."""
        return [(one, truth) for one, truth in self.estimates if one.world]

    @cached_property
    def weighed(self) -> bool:
        """True if the estimates have probabilities, which they have only with noisy sensors."""
        return any(one.probabilities for one in self.held)

    @cached_property
    def likeliest(self) -> list[tuple[Estimate, Pose]]:
        """The estimates in `placed` whose first pose is the most probable or the only one."""
        return [(one, truth) for one, truth in self.placed if one.probabilities or len(one.world) == 1]

    def others(self, estimate: Estimate) -> tuple[Pose, ...]:
        """Return the possible world poses but the most probable; all of them if none is more probable."""
        return estimate.world[1:] if estimate.probabilities or len(estimate.world) == 1 else estimate.world

    @cached_property
    def claim(self) -> Claim | None:
        """The robot's first claim; None if it made none."""
        return first_claim(self.recording, self.place)

    @cached_property
    def phases(self) -> tuple[Span, ...]:
        """The phases in order, over all recorded ticks. A tick without a Command has the phase before it."""
        by_tick, phase = [], 1
        for moment in self.recording.ticks:
            command = moment.commands.get(self.own.id)
            phase = command.phase if command is not None else phase
            by_tick.append((phase, moment.truth.tick))
        spans = []
        for phase, group in groupby(by_tick, key=lambda one: one[0]):
            ticks = [tick for _, tick in group]
            spans.append(Span(phase, ticks[0], ticks[-1]))
        return tuple(spans) or (Span(1, 0, 0),)

    @property
    def encounter_tick(self) -> int | None:
        """The tick in which phase 3 began; None if it did not."""
        return next((span.first for span in self.phases if span.phase == 3), None)


def error(pose: Pose, truth: Pose) -> float:
    """Return the distance between the positions of two poses, in m."""
    return math.hypot(pose.x - truth.x, pose.y - truth.y)
