"""The estimator contract: hypotheses about the poses of one robot or of both, from its measurements.

`exact_estimator` and `gaussian.gaussian_estimator` implement it. Planners do not ask which of the two they
have: the mission's noise selects it, in `planning.state`. Only the steps of `assured` under noise plan with
covariances, and take them from `gaussian.own_anchor` and `gaussian.followed_pair`.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from agent.estimation.closed_forms import Placement
from agent.estimation.exact import Branch
from agent.estimation.knowledge import Knowledge, MeetingPosterior, OwnAnchor
from protocol.messages import Observation, Verdict
from protocol.motion import ORIGIN, Pose


class AnchorEstimate(NamedTuple):
    """The result of the ranges of a robot to its anchor."""

    known: OwnAnchor
    branches: tuple[Branch, ...]
    """The branches that a further range has to distinguish, the most probable first."""
    margin: float
    """The distance in m inside R at which a point is certainly in range."""
    best: Branch | None = None
    """The most probable branch, fitted to all ranges; None if there is none, or several are as probable."""
    anchor_error: float = 0.0
    """The bound in m on the error of the anchor's position; 0 if the hypotheses have it instead."""
    enough: bool = True
    """True if further ranges would not make a claim possible that is impossible now."""


class PairEstimate(NamedTuple):
    """The result of the logs and the mutual ranges of both robots."""

    posterior: MeetingPosterior
    verdict: Verdict | None
    """The verdict that follows from the estimate; None if it depends on further ranges."""
    placements: tuple[Placement, ...]
    """The possible placements of the frame in which `a` is given in that of `b`, likeliest first."""
    failure: str
    """The reason for the verdict Undecided if no further mutual range is measured."""
    a: Pose = ORIGIN
    """The pose of a; in <a(M1)>, or the origin of a frame of its own."""
    b: Pose = ORIGIN
    """The pose of b; in <b(M2)>, or the origin of a frame of its own."""
    checked: bool = False
    """True if a redundant mutual range has confirmed the placements."""


class Estimator(Protocol):
    """The inference of a robot from its own measurements and from its peer's reports."""

    @property
    def pose_tolerance(self) -> float:
        """Return the tolerance in rad, and relative to A_0, with which the robot's odometry is known.

        A manoeuvre has reached its target within it.
        """

    @property
    def corrects_poses(self) -> bool:
        """Return whether later ranges correct the robot's pose, so that it leaves the path it was on."""

    @property
    def report_tolerance(self) -> float:
        """Return the difference in m and rad from which parts of a peer's report contradict each other."""

    def is_informative(self, knowledge: Knowledge, observation: Observation) -> bool:
        """Return whether the anchor range of `observation` adds to what the robot knows."""

    def on_anchor(self, knowledge: Knowledge, rho0: float) -> AnchorEstimate | None:
        """Return the estimate of a robot that starts on its anchor; None if `rho0` (m) does not say so."""

    def anchor(self, knowledge: Knowledge, allowed: tuple[Branch, ...]) -> AnchorEstimate:
        """Return the branches that the anchor ranges allow.

        `allowed` are the branches that the ranges before the last one allowed; empty at the second range.
        """

    def pair(self, knowledge: Knowledge, first_tick: int, *, second_range: bool) -> PairEstimate | None:
        """Return the hypotheses about both poses; None if the measurements do not suffice yet.

        Mutual ranges before `first_tick` are not used if the ranges after it suffice alone. `second_range`
        says that a has reported its second one.
        """
