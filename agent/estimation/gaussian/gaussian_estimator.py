"""The estimator for noisy sensors: hypotheses by likelihood, with covariances."""

from __future__ import annotations

import math
from typing import ClassVar

import msgspec
import numpy as np

from agent.estimation.claim import Blocked, claim
from agent.estimation.closed_forms import Placement
from agent.estimation.estimator import AnchorEstimate, Estimator, FittedBranch, PairEstimate
from agent.estimation.exact import Branch
from agent.estimation.gaussian import inference
from agent.estimation.gaussian.inference import PlanningHypothesis
from agent.estimation.gaussian.search import search
from agent.estimation.judged import of_pair
from agent.estimation.knowledge import Knowledge
from protocol.messages import Localised, Observation, Undecided, Verdict
from protocol.mission import RANGE_MARGIN
from protocol.motion import ORIGIN, Pose, relative, wrap

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

    def on_anchor(self, knowledge: Knowledge, rho0: float) -> FittedBranch | None:
        """Return None: a noisy range does not say that the robot is exactly on its anchor."""
        del knowledge, rho0
        return None

    def anchor(self, knowledge: Knowledge, candidates: tuple[Branch, ...]) -> AnchorEstimate:
        """Return the branches of at least the probability LIKELY_BRANCH, whatever the `candidates` were."""
        del candidates
        scored = inference.own_anchor(knowledge)
        if not scored:
            return AnchorEstimate(knowledge.belief, (), None, RANGE_MARGIN)
        belief = inference.with_own(knowledge, scored)
        likely = [
            branch
            for branch, one in zip(belief.branches, belief.own, strict=True)
            if one.probability >= LIKELY_BRANCH
        ]
        return AnchorEstimate(belief, tuple(likely), likely[0] if likely else None, RANGE_MARGIN)

    def fitted(self, knowledge: Knowledge, branch: Branch) -> FittedBranch:
        """Return `branch`, which is fitted already."""
        del knowledge
        return FittedBranch(branch, 0.0, enough=True)

    def pair(self, knowledge: Knowledge, first_tick: int, *, second_range: bool) -> PairEstimate | None:
        """Return the hypotheses from a search of the whole plane with all ranges.

        The result is None until a has its second range and the logs of both robots reach the present tick.
        """
        del first_tick
        if not second_range:
            return None
        pair = inference.pair_of(knowledge)
        known_through = inference.known_through(knowledge)
        if known_through < knowledge.tick or np.count_nonzero(pair.ranges.mutual) < FEWEST_MUTUAL_RANGES:
            return None
        scored = search(pair, fewest=FEWEST_MUTUAL_RANGES).hypotheses
        hypotheses = inference.pair_planning_hypotheses(scored)
        judged = of_pair("paper", knowledge.config, scored, pair)
        found = claim(judged)
        reason = found.reason if isinstance(found, Blocked) else None
        verdict: Verdict | None = found if isinstance(found, Localised) else None
        failure = f"the paper's manoeuvres give no further ranges: {reason}"
        if not scored:
            verdict = Undecided(failure)
        belief = inference.with_pair(knowledge, scored, judged and judged.inconsistency, reason)
        placements = tuple([_pose_in_b_frame(one) for one in hypotheses])
        return PairEstimate(
            belief, verdict, placements, ORIGIN, ORIGIN, checked=False, observations=(), failure=failure
        )


def _pose_in_b_frame(planning_hypothesis: PlanningHypothesis) -> Placement:
    """Return the pose of a in the frame of b's current pose."""
    ax, ay, a_heading, bx, by, b_heading = planning_hypothesis.poses.tolist()
    seen = relative(Pose(bx, by, b_heading), Pose(ax, ay, a_heading))
    return Placement(wrap(seen.heading), seen.x, seen.y)


GAUSSIAN: Estimator = GaussianEstimator()
