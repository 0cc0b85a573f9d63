"""The complete state of one robot as one frozen value, and its mode: one type per state of the paper."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from agent.estimation.estimator import Estimator
from agent.estimation.exact_estimator import EXACT_ESTIMATOR
from agent.estimation.gaussian.gaussian_estimator import GAUSSIAN
from agent.estimation.knowledge import Knowledge
from agent.planning.active_sensing import Listening, Retreating, Surveying
from agent.planning.phase1_anchor import ThirdPoint
from agent.planning.phase2_orbit import Aligning, Orbiting, Radial, Tangent, Travelling
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Plan, Returning, Standing, Waiting
from agent.planning.range_seeking import Backing, Circling, Homing, Seeking, Straight, Turning
from agent.planning.sweep import Looping, Sweeping
from protocol import messages
from protocol.messages import Inconsistent, Localised, Undecided
from protocol.mission import Mission
from protocol.motion import ORIGIN, Pose
from protocol.orbits import Orbit


def estimator_for(mission: Mission) -> Estimator:
    """Return the estimator for the noise of `mission`."""
    return EXACT_ESTIMATOR if mission.noise.exact else GAUSSIAN


class Asleep(msgspec.Struct, frozen=True):
    """The robot has not measured its first anchor range yet."""


class Done(msgspec.Struct, frozen=True):
    """The robot has reached its verdict. It stands still and continues to send reports to its peer."""

    phase: int
    verdict: messages.Verdict


Phase1 = Straight | Backing | Turning | Circling | ThirdPoint | Surveying | Homing
Phase2 = Aligning | Radial | Tangent | Orbiting | Travelling | Sweeping
Phase3 = Straight | Backing | Turning | Circling | Standing | Waiting | LastManoeuvre | Returning | Looping
Noisy3 = Surveying | Listening | Retreating
Mode = Asleep | Phase1 | Phase2 | Phase3 | Noisy3 | Done

UNCONFIRMED = "unconfirmed"
"""The mode that a robot without an anchor reports to one by which it knows its pose, until others agree."""

MODE_NAMES: dict[type, str] = {
    Asleep: "asleep",
    Straight: "straight",
    Backing: "backing",
    Turning: "turning",
    Circling: "circling",
    ThirdPoint: "third-point",
    Surveying: "surveying",
    Homing: "homing",
    Listening: "listening",
    Aligning: "aligning",
    Radial: "radial",
    Tangent: "tangent",
    Orbiting: "orbiting",
    Travelling: "travelling",
    Sweeping: "sweeping",
    Looping: "looping",
    Standing: "standing",
    Waiting: "waiting",
    LastManoeuvre: "last-manoeuvre",
    Returning: "returning",
    Retreating: "retreating",
}


PHASE_OF_TASK: dict[type, int] = {
    Asleep: 1,
    ThirdPoint: 1,
    Homing: 1,
    Aligning: 2,
    Radial: 2,
    Tangent: 2,
    Orbiting: 2,
    Travelling: 2,
    Sweeping: 2,
    Looping: 3,
    Standing: 3,
    Waiting: 3,
    LastManoeuvre: 3,
    Returning: 3,
    Listening: 3,
    Retreating: 3,
}
"""The phase of each mode that belongs to one phase alone. That of the others depends on their beacon."""


class RobotState(Knowledge, frozen=True):
    """Everything that a robot knows, and what it is doing (`mode`). The planner maps it to the next one."""

    mode: Mode = Asleep()
    in_contact: bool = False
    """True if the peer is in range in this tick."""
    leg: Pose = ORIGIN
    """The odometry at the beginning of the last segment of the log."""
    plan: Plan | None = None
    """The latest plan of a last manoeuvre of this robot."""

    @property
    def estimator(self) -> Estimator:
        """Return the estimator for the noise of the mission."""
        return estimator_for(self.config.mission)

    @property
    def orbit(self) -> Orbit:
        """Return the orbit of this robot in phase 2."""
        return self.config.orbit

    @property
    def phase(self) -> int:
        """Return the phase of the paper: 1, 2 or 3."""
        mode = self.mode
        phase = PHASE_OF_TASK.get(type(mode))
        if phase is not None:
            return phase
        if isinstance(mode, Done):
            return mode.phase
        assert isinstance(mode, Seeking | Surveying)
        return 1 if mode.beacon == "anchor" else 3

    @property
    def mode_name(self) -> str:
        """Return the name of the mode that reports, commands and recordings use."""
        mode = self.mode
        if not isinstance(mode, Done):
            return MODE_NAMES[type(mode)]
        match mode.verdict:
            case Localised():
                return "localised"
            case Inconsistent():
                return "inconsistent"
            case Undecided():
                return "undecided"

    @property
    def verdict(self) -> messages.Verdict | None:
        """Return the verdict, or None if the robot has not reached one."""
        mode = self.mode
        return mode.verdict if isinstance(mode, Done) else None

    def undecided(self, reason: str) -> RobotState:
        """Return this state, ended with the verdict Undecided: the robot cannot continue."""
        return replace(self, mode=Done(self.phase, Undecided(reason)))

    def inconsistent(self, contradiction: Inconsistent) -> RobotState:
        """Return this state, ended with the verdict Inconsistent: the peer's reports are contradictory."""
        return replace(self, mode=Done(self.phase, contradiction))
