"""The estimator for noisy sensors: hypotheses by likelihood, with covariances."""

from __future__ import annotations

import math
from typing import ClassVar

import msgspec
import numpy as np

from agent.estimation.closed_forms import Placement
from agent.estimation.estimator import AnchorEstimate, Estimator, PairEstimate
from agent.estimation.exact import Branch
from agent.estimation.fit import Fit
from agent.estimation.gaussian.followed_pair import judged_posterior
from agent.estimation.gaussian.mission_measurements import pair_of
from agent.estimation.gaussian.own_anchor import followed
from agent.estimation.gaussian.search import search
from agent.estimation.knowledge import Knowledge
from protocol.messages import Localised, Observation, Undecided, Verdict
from protocol.mission import RANGE_MARGIN
from protocol.motion import Pose, relative, wrap

LIKELY_BRANCH = 0.05
"""The probability from which on a branch takes part in the planning of a manoeuvre."""

FEWEST_MUTUAL_RANGES = 2
"""The minimum number of mutual ranges for hypotheses about the pair, as many as eq. (7) has."""


class GaussianEstimator(msgspec.Struct, frozen=True):
    """The hypotheses of the Gaussian fits. None is certain, and no single measurement excludes one."""

    pose_tolerance: ClassVar[float] = 0.05
    """The noise of actuation moves a robot past its target."""
    corrects_poses: ClassVar[bool] = True
    """Each range to the anchor corrects the pose."""
    report_tolerance: ClassVar[float] = math.inf
    """Noise explains every difference, and the consistency tests decide."""

    def is_informative(self, knowledge: Knowledge, observation: Observation) -> bool:
        """Return True: each range has an error of its own."""
        del knowledge, observation
        return True

    def on_anchor(self, knowledge: Knowledge, rho0: float) -> AnchorEstimate | None:
        """Return None: a noisy range does not say that the robot is exactly on its anchor."""
        del knowledge, rho0
        return None

    def anchor(self, knowledge: Knowledge, allowed: tuple[Branch, ...]) -> AnchorEstimate:
        """Return the branches of at least the probability LIKELY_BRANCH, whatever was `allowed` before."""
        del allowed
        known = followed(knowledge)
        if known is None:
            return AnchorEstimate(knowledge.own_anchor, (), RANGE_MARGIN)
        each = zip(known.branches, known.hypotheses, strict=True)
        likely = tuple([branch for branch, one in each if one.probability >= LIKELY_BRANCH])
        return AnchorEstimate(known, likely, RANGE_MARGIN, likely[0] if likely else None)

    def pair(self, knowledge: Knowledge, first_tick: int, *, second_range: bool) -> PairEstimate | None:
        """Return the hypotheses from a search of the whole plane with all ranges.

        The result is None until a has its second range and the logs of both robots reach the present tick.
        """
        del first_tick
        if not second_range:
            return None
        measured = pair_of(knowledge)
        mutual = np.count_nonzero(measured.ranges.mutual)
        if knowledge.known_through < knowledge.tick or mutual < FEWEST_MUTUAL_RANGES:
            return None
        found = search(measured, fewest=FEWEST_MUTUAL_RANGES)
        posterior, judged, blocking = judged_posterior(knowledge, "paper", found, measured)
        failure = f"the paper's manoeuvres give no further ranges: {posterior.blocking_reason}"
        verdict: Verdict | None = Undecided(failure)
        if judged is not None:
            verdict = Localised(posterior.poses[0], posterior.covariance) if blocking is None else None
        placements = tuple([_pose_in_b_frame(one.fit) for one in posterior.pair])
        return PairEstimate(posterior, verdict, placements, failure)


def _pose_in_b_frame(fit: Fit) -> Placement:
    """Return the pose of a in the frame of b's current pose."""
    a, b = [Pose(*one) for one in fit.poses.tolist()]
    seen = relative(b, a)
    return Placement(wrap(seen.heading), seen.x, seen.y)


GAUSSIAN: Estimator = GaussianEstimator()
