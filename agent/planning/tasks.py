"""The tasks of a robot: what it is doing, one type each, named as in the paper.

Each task has a `name`, which reports, commands and recordings use, and the `phase` of the paper: 1, 2 or 3.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

import msgspec

from agent.estimation.exact import Branch
from protocol.coverage_strips import Place
from protocol.messages import Inconsistent, Localised, Verdict
from protocol.motion import REST, Controls, Pose, compose

Beacon = Literal["anchor", "peer"]


class Asleep(msgspec.Struct, frozen=True):
    """The robot has not measured its first anchor range yet."""

    name: ClassVar[str] = "asleep"
    phase: ClassVar[int] = 1


# --- the search for a further range: to the anchor in phase 1, to the peer in phase 3 ------------------


class Measuring(msgspec.Struct, frozen=True):
    """The base of tasks that are about ranges to `beacon`: the anchor in phase 1, the peer in phase 3."""

    name: ClassVar[str]
    beacon: Beacon

    @property
    def phase(self) -> int:
        """The phase of the paper."""
        return 1 if self.beacon == "anchor" else 3


class Searching(Measuring, frozen=True):
    """The base of the search for a second range to the beacon (Section III.A.2)."""

    origin: Pose
    """The odometry at the beginning of the search."""
    rho0: float
    """The range to the beacon at `origin` in m."""


class Straight(Searching, frozen=True):
    """The robot drives A_0 straight ahead from `origin`, and then checks for a range to the beacon."""

    name: ClassVar[str] = "straight"


class Backing(Searching, frozen=True):
    """The robot was out of range ahead. It drives back to the point A_0 behind `origin`."""

    name: ClassVar[str] = "backing"


class Turning(Searching, frozen=True):
    """The robot is out of range. It turns by pi / 2 on the spot, so that `origin` is on its left."""

    name: ClassVar[str] = "turning"
    heading: float
    """The target heading in rad, in the frame of the odometry."""


class Circling(Searching, frozen=True):
    """The robot drives a circle of radius A_0 about `origin` until it measures a range to the beacon."""

    name: ClassVar[str] = "circling"


class Surveying(Measuring, frozen=True):
    """The robot drives to where its next ranges are expected to be most informative."""

    name: ClassVar[str] = "surveying"
    command: Controls = REST
    since: int = 0
    """The tick of the first of the consecutive plans of which this is the last."""


class ThirdPoint(msgspec.Struct, frozen=True):
    """The robot drives to a point where the remaining branches predict different ranges (eqs. (3) to (5))."""

    name: ClassVar[str] = "third-point"
    phase: ClassVar[int] = 1
    branches: tuple[Branch, ...]
    origin: Pose
    command: Controls


class Homing(msgspec.Struct, frozen=True):
    """The robot drives back until it measures a range to its anchor, and searches if there is none.

    If it has lost its anchor, it drives to the place of the last range. If it has not met its peer, it drives
    to where its anchor should be, and searches on a square spiral.
    """

    name: ClassVar[str] = "homing"
    phase: ClassVar[int] = 1
    place: Place
    """The place, in m in the frame of the odometry."""
    side: int | None = None
    """The number of sides of the spiral up to this place; None without a spiral."""


# --- phase 2 ------------------------------------------------------------------------------------------


class Orbital(msgspec.Struct, frozen=True):
    """The base of the way to the orbit about the own anchor, and of the orbit (Section III.B)."""

    name: ClassVar[str]
    phase: ClassVar[int] = 2


class Aligning(Orbital, frozen=True):
    """The robot turns by -mu on the spot, until it heads radially away from its anchor."""

    name: ClassVar[str] = "aligning"
    heading: float
    """The target heading in rad, in the frame of the odometry."""


class Radial(Orbital, frozen=True):
    """The robot drives along the radius to its orbit, outward or inward."""

    name: ClassVar[str] = "radial"


class Tangent(Orbital, frozen=True):
    """The robot turns from the radius to the tangent of its orbit: a by +90 degrees, b by -90 degrees."""

    name: ClassVar[str] = "tangent"
    heading: float
    """The target heading in rad, in the frame of the odometry."""


class Orbiting(Orbital, frozen=True):
    """The robot drives on its orbit (eq. (6)), or waits at its place if its orbit has no speed."""

    name: ClassVar[str] = "orbiting"
    command: Controls | None = None
    """Noisy sensors: the controls of pure pursuit, or of active sensing while the robot waits."""
    since: int = 0
    """Noisy sensors: the tick in which the robot reached its orbit, or set out for it without a stop."""


class Travelling(msgspec.Struct, frozen=True):
    """A localised robot of a group drives to the next one, which waits beside its anchor.

    If noise has led it astray and the other robot is not in range there, it searches across its way.
    """

    name: ClassVar[str] = "travelling"
    phase: ClassVar[int] = 2
    place: Place
    """The end of the present straight, in m in the frame of the odometry."""
    leg: int = 0
    """The number of legs of the search up to this place; 0 on the way to the robot."""


def drives_aside(task: object) -> bool:
    """Return whether a robot at this task drives aside if another one blocks it (see `travelling`).

    A straight of phase 1 that is blocked is left for the next step of the search.
    """
    on_its_way = isinstance(task, Orbital | Travelling | Homing | Circling)
    return on_its_way or (isinstance(task, Surveying) and task.beacon == "anchor")


def transformed(transform: Pose, places: Iterable[Place]) -> tuple[Place, ...]:
    """Return `places`, in m, in the frame in which their own frame has the pose `transform`."""
    moved = [compose(transform, Pose(x, y, 0.0)) for x, y in places]
    return tuple([(one.x, one.y) for one in moved])


class Covering(msgspec.Struct, frozen=True):
    """A localised robot of a group drives along the strips in which it looks for robots without an anchor."""

    name: ClassVar[str] = "sweeping"
    phase: ClassVar[int] = 2
    places: tuple[Place, ...]
    """The ends of the straights that are left, in m in the frame of the odometry."""


class Awaiting(msgspec.Struct, frozen=True):
    """A robot without an anchor stands, until a localised one finds it."""

    name: ClassVar[str] = "standing"
    phase: ClassVar[int] = 2


# --- phase 3 ------------------------------------------------------------------------------------------


class Resting(msgspec.Struct, frozen=True):
    """The base of standing still in contact."""

    name: ClassVar[str]
    phase: ClassVar[int] = 3
    through: int = -1
    """The last tick whose measurements have been evaluated."""


class Standing(Resting, frozen=True):
    """Robot b stands still. It waits for a's second range or, after its own manoeuvre, for a's report."""

    name: ClassVar[str] = "standing"


class Waiting(Resting, frozen=True):
    """Robot a stands still. It has its second range and waits for b's last manoeuvre.

    Robot a makes a further manoeuvre if b's last one was not sufficient.
    """

    name: ClassVar[str] = "waiting"


class LastManoeuvre(msgspec.Struct, frozen=True):
    """The robot drives to a point where the remaining placements predict different ranges."""

    name: ClassVar[str] = "last-manoeuvre"
    phase: ClassVar[int] = 3
    command: Controls
    origin: Pose


class Returning(msgspec.Struct, frozen=True):
    """The robot has left the peer's range. It drives the same arc backwards, to be able to report again."""

    name: ClassVar[str] = "returning"
    phase: ClassVar[int] = 3
    command: Controls
    origin: Pose


class Listening(msgspec.Struct, frozen=True):
    """The robot stands still in range of the peer, and waits for the missing part of the peer's log."""

    name: ClassVar[str] = "listening"
    phase: ClassVar[int] = 3
    command: Controls = REST


class Retreating(msgspec.Struct, frozen=True):
    """The robot has left the peer's range. It drives back the same way, and as far again.

    The second half prevents that it takes the same decision, and leaves the range, once more.
    """

    name: ClassVar[str] = "retreating"
    phase: ClassVar[int] = 3
    command: Controls
    since: int
    """The tick in which the peer was out of range for the first time."""


class Looping(msgspec.Struct, frozen=True):
    """A robot drives a loop, so that a robot without an anchor is localised by the ranges between the two."""

    name: ClassVar[str] = "looping"
    phase: ClassVar[int] = 3
    places: tuple[Place, ...]
    """The corners that are left, in m in the frame of the odometry. The last one is where it began."""
    then: tuple[Place, ...] = ()
    """The ends of the straights of the coverage that are left after it."""
    since: int = 0
    """The tick in which the first loop began; it is repeated until a robot is localised."""


# --- any phase ----------------------------------------------------------------------------------------


class Deciding(msgspec.Struct, frozen=True):
    """A planner of the user decides in a meeting of a group."""

    phase: int
    name: str


class Done(msgspec.Struct, frozen=True):
    """The robot has reached its verdict. It stands still and continues to send reports to its peer."""

    phase: int
    verdict: Verdict

    @property
    def name(self) -> str:
        """The name of the verdict."""
        match self.verdict:
            case Localised():
                return "localised"
            case Inconsistent():
                return "inconsistent"
            case _:
                return "undecided"


Task = (
    Asleep | Searching | Surveying | ThirdPoint | Homing
    | Orbital | Travelling | Covering | Awaiting
    | Resting | LastManoeuvre | Returning | Listening | Retreating | Looping
    | Deciding | Done
)  # fmt: skip

UNCONFIRMED = "unconfirmed"
"""The task that a robot without an anchor reports to one by which it knows its pose, until others agree."""
