"""The numbers of one robot in one tick that viewers plot over time."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
from msgspec import UNSET, UnsetType

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.outlines import OUTLINE_SIGMAS
from compose.view.scene import HeldPoses, Player, Scene
from protocol.motion import Pose
from world.referee import errors


class Numbers(msgspec.Struct, frozen=True):
    """The numbers of one robot in one tick. A number that is unknown in this tick is absent."""

    hypotheses: int | UnsetType = UNSET
    """The number of the robot's hypotheses."""
    probability: float | UnsetType = UNSET
    """The probability of the first of them."""
    position_error_m: float | UnsetType = UNSET
    """The distance of the leading pose in the world frame from the true position.

    If no pose is more probable than all others together, it is that of the farthest hypothesis.
    """
    position_bound_m: float | UnsetType = UNSET
    """SIGMAS times the robot's standard deviation of the first pose's position."""
    anchor_range_m: float | UnsetType = UNSET
    """The range to the anchor, in a team to the nearest one."""
    mutual_range_m: float | UnsetType = UNSET
    """The range to the peer, in a team to the nearest robot."""
    anchor_residual_m: float | UnsetType = UNSET
    """The range to the anchor, less that from the first pose; absent if its position is unknown."""
    mutual_residual_m: float | UnsetType = UNSET
    """The range to that robot, less the distance between the leading poses of both in the world frame."""

    @staticmethod
    def of(
        player: Player, robot: RobotSetup, setup: RunSetup, held_by: Callable[[str | None], HeldPoses | None]
    ) -> Numbers:
        """Return the numbers of `robot`; `held_by` returns the poses that another one holds."""
        held = player.held
        hypotheses = held.poses if held is not None else ()
        world = held.world if held is not None else ()
        covariance = held.covariance if world and held is not None else None
        anchor, anchor_range = robot.given_anchor, player.anchor_range
        if player.anchors:
            nearest = min(player.anchors, key=lambda one: one.range)
            anchor, anchor_range = setup.position_of(nearest.anchor), nearest.range
        ranges = [
            (contact.range, contact.peer)
            for contact in player.contacts
            if contact.range is not None and player.peer in (None, contact.peer)
        ]
        mutual, peer = min(ranges, default=(None, player.peer or robot.peer))
        expected = None
        if world and anchor is not None:
            expected = math.hypot(world[0].x - anchor.x, world[0].y - anchor.y)
        elif hypotheses and not world:
            expected = math.hypot(hypotheses[0].x, hypotheses[0].y)
        own, other = _leading(held), _leading(held_by(peer))
        apart = errors(own, other)[0] if own is not None and other is not None else None
        distances = [errors(pose, player.pose)[0] for pose in world] if player.pose is not None else []
        return Numbers(
            hypotheses=len(hypotheses) if held is not None else UNSET,
            probability=held.shares[0] if held is not None and hypotheses else UNSET,
            position_error_m=(max(distances) if own is None else distances[0]) if distances else UNSET,
            position_bound_m=OUTLINE_SIGMAS * covariance.position_sigma if covariance is not None else UNSET,
            anchor_range_m=anchor_range if anchor_range is not None else UNSET,
            mutual_range_m=mutual if mutual is not None else UNSET,
            anchor_residual_m=_residual(anchor_range, expected),
            mutual_residual_m=_residual(mutual, apart),
        )

    @staticmethod
    def in_scene(scene: Scene, robot: RobotSetup, setup: RunSetup) -> Numbers:
        """Return the numbers of `robot` in the tick of `scene`."""
        return Numbers.of(scene.player(robot.id), robot, setup, scene.held_by)

    def encode(self) -> bytes:
        """Return the numbers as a JSON object."""
        return msgspec.json.encode(self)


def _leading(held: HeldPoses | None) -> Pose | None:
    """Return the pose in the world frame that is more probable than all others together, if there is one."""
    if held is None or not held.world:
        return None
    return held.world[0] if held.shares[0] > 0.5 else None


def _residual(measured: float | None, expected: float | None) -> float | UnsetType:
    return measured - expected if measured is not None and expected is not None else UNSET


HYPOTHESES, RANGES = "Hypotheses", "Ranges, m"
PLOTS: dict[str, tuple[str, ...]] = {
    HYPOTHESES: ("hypotheses",),
    "Error and 3 sigma, m": ("position_error_m", "position_bound_m"),
    RANGES: ("anchor_range_m", "mutual_range_m"),
}
"""The plots of a viewer: the title of each, and its numbers."""
PLOTTED = 6
"""The largest number of robots that are plotted: with more, no curve can be followed."""
