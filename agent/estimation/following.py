"""The estimate of any number of robots that goes on from tick to tick: of a team, or of a recording.

Robots that are located are followed. The whole plane is searched at the numbers of ranges SEARCHED_AT, and
before the first claim of each robot.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import NamedTuple

from agent.estimation.claim import (
    BEFORE_SEARCH,
    CONDITIONS,
    Condition,
    anchors,
    blocked,
    consistency,
    parts,
    parts_before,
    strays,
)
from agent.estimation.gaussian.consistency import CLAIM_P_VALUE
from agent.estimation.gaussian.joint_claims import Displacement, displaced_anchor, displacements
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.search import (
    FEWEST_DECISIVE,
    begun,
    extended,
    from_nothing,
    locatable,
    search,
)
from agent.estimation.judged import Judged, User, misfit, of_joint
from agent.estimation.posterior import NO_HYPOTHESES, Posterior, carried, certainties, ended, settled

SEARCHED_AT = tuple(8 * 2**n for n in range(16))
"""The numbers of ranges (of a pair: of mutual ranges) at which the whole plane is searched again.

They only bound how long a missed hypothesis stays missed: the plane is also searched before each first claim.
More searches cost time; with fewer, robots plan with too few hypotheses.
"""

MOST_SEARCHES = 100
"""The number of searches of the whole plane after which it is only searched with twice as many ranges.

Where no hypothesis fits, each epoch has a search. With fewer, recordings of a minute that settle late would
have other estimates; with more, recordings that contradict themselves take longer.
"""

GIVEN_UP = (
    f"not settled after {MOST_SEARCHES} searches of the plane; the next is due with twice as many ranges"
)
"""The reason against a claim that such a search has not confirmed."""

RETESTED = 1.1
"""The factor by which ranges must have grown before the places of the anchors are tested again.

They are tested before the first claim of a robot as well. With less, claims of robots with many anchors take
twice as long; with more, a false place is found later.
"""

CONFIRMED = 2.0
"""The factor by which ranges must have grown, and blamed an anchor all the time, before a robot gives up."""

MORE_RANGES = 1.5
"""The factor by which the decisive ranges of a robot must have grown before it is tried again."""


DISPLACED = (consistency, strays)
"""The conditions that an anchor elsewhere than surveyed may be the reason against."""


class ClaimRule(NamedTuple):
    """The accuracy and the confidence that a claim needs, and the conditions that are asked."""

    accuracy: float = 0.3
    """The largest sigma of the position in m: the root of the trace of its covariance."""
    confidence: float = 0.9999
    """The least probability of the hypothesis."""
    conditions: Sequence[Condition] = CONDITIONS


EXACT_ACCURACY = 1e-5
"""The largest sigma (m) of a position that is claimed with exact sensors, where a range has one of 1e-6 m.

Rounding is smaller than that by several powers of ten. With more, a fit that has converged to a hundredth of
a sigma might be off by more than a claim may be.
"""


class Following(NamedTuple):
    """The hypotheses about robots that are located, and what the searches for others have led to."""

    known: Posterior = NO_HYPOTHESES
    """The hypotheses."""
    part: JointMeasurements | None = None
    """The measurements to which they are fitted; None before the first."""
    judged: Mapping[str, Judged] = {}
    """The estimate of each located robot that is asked, as the conditions for a claim see it."""
    reasons: Mapping[str, str] = {}
    """The reason against the claim of each of them; an empty text if there is none."""
    searched: int = 0
    """The number of ranges at the latest search of the whole plane."""
    searches: int = 0
    """The number of searches."""
    failed: Mapping[tuple[str, ...], int] = {}
    """The decisive ranges with which robots were not located."""
    claimed: frozenset[str] = frozenset()
    """The robots that might have claimed their poses."""
    displacements: tuple[Displacement, ...] = ()
    """The distance by which each anchor seems to stand elsewhere, at the latest test."""
    tested: int = 0
    """The number of ranges at that test."""
    doubted: int = 0
    """The number of ranges at the first of the latest tests that all found one; 0 if the last one did not."""
    disagreed: Mapping[str, int] = {}
    """The number of ticks at the latest disagreement of parts of the ranges of each robot."""
    compared: Mapping[str, int] = {}
    """The number of ticks at the latest comparison of these parts."""
    begun_again: int = 0
    """The number of ranges at which a team has dropped hypotheses that its measurements contradict."""

    def after(self, used: JointMeasurements, rule: ClaimRule, user: User, asked: Container[str]) -> Following:
        """Return the estimate by what is `used`, which has grown since the last one.

        The robots `asked` may claim their poses; the plane is searched before that.

        A team whose measurements contradict all hypotheses begins again, with ever more ranges. A recording
        has other robots, and errors that nobody has told.
        """
        count = len(used.ranges.rho)
        if used.only_rounding:
            rule = rule._replace(accuracy=EXACT_ACCURACY)
        if user == "team" and self._contradicted and count >= MORE_RANGES * self.begun_again:
            self = Following(claimed=self.claimed, begun_again=count)  # noqa: PLW0642  # as if it were new
        known = carried(self.known, self.part, used) if self.part is not None else self.known
        known = ended(settled(known, used), used)
        now = self._extended(known if known.hypotheses else begun(used), used)
        due = now.known.hypotheses and any(self.searched < at <= count for at in SEARCHED_AT)
        now = now._tested(used, rule, user, asked)
        claiming = now._claiming - self.claimed
        if claiming and not due and self.searches >= MOST_SEARCHES:
            now = now._replace(reasons={**now.reasons, **dict.fromkeys(sorted(claiming), GIVEN_UP)})
        elif due or claiming:
            found = ended(search(used, now.known), used)
            now = now._replace(
                known=found, searched=count, searches=self.searches + 1, compared=self.compared
            )
            now = now._tested(used, rule, user, asked)
        return now._replace(claimed=self.claimed | now._claiming)

    @property
    def displacement_confirmed(self) -> bool:
        """True if more ranges go on to say that an anchor stands elsewhere."""
        return 0 < CONFIRMED * self.doubted <= self.tested

    @property
    def _claiming(self) -> frozenset[str]:
        """The robots that nothing prevents from claiming their poses."""
        return frozenset([name for name, reason in self.reasons.items() if not reason])

    @property
    def _contradicted(self) -> bool:
        """True if the measurements contradict the likeliest hypothesis."""
        known = self.known.hypotheses
        return bool(known) and misfit(known[0].fit).p_value < CLAIM_P_VALUE

    def _extended(self, found: Posterior, used: JointMeasurements) -> Following:
        """Return `found` with further robots; those that failed are tried again with more ranges."""
        names, possible = used.robots, locatable(found.located, used)
        tried = {one: self.failed.get(tuple([names[k] for k in one.robots]), 0) for one in possible}
        left = [one for one in possible if one.decisive < MORE_RANGES * tried[one]]
        if len(left) == len(possible):
            return self._replace(known=found)
        anew = not left and found.located == used.started
        more = from_nothing(used, FEWEST_DECISIVE) if anew else extended(found, used, left)
        failed = dict(self.failed)
        for one in locatable(more.located, used):
            if one not in left:
                failed[tuple([names[k] for k in one.robots])] = one.decisive
        return self._replace(known=more, failed=failed)

    def _tested(
        self, used: JointMeasurements, rule: ClaimRule, user: User, asked: Container[str]
    ) -> Following:
        """Return this with what blocks the claim of each located robot that is `asked`."""
        found = self.known
        part = used.some(found.located)
        judged = {
            part.robots[i]: of_joint(
                *(user, i, found, certainty, part, rule.accuracy, rule.confidence),
                self.disagreed.get(part.robots[i], 0),
                self.compared.get(part.robots[i], 0),
            )
            for i, certainty in enumerate(certainties(found))
            if part.robots[i] in asked and not part.is_anchor(i)
        }
        first = {name: blocked(one, BEFORE_SEARCH) for name, one in judged.items()}
        claiming = {name for name, one in first.items() if one is None or one.condition in DISPLACED}
        now = self._replace(part=part, judged=judged, doubted=self.doubted if claiming else 0)
        count = len(part.ranges.rho)
        if claiming:
            now = now._displaced(retested=count >= RETESTED * self.tested)
        reasons = {name: blocked(one, rule.conditions) for name, one in now.judged.items()}
        by_anchors = [name for name, one in reasons.items() if one is None or one.condition is anchors]
        if now.tested < count and claiming & {*by_anchors} - self.claimed:
            now = now._displaced(retested=True)
            reasons |= {name: blocked(now.judged[name], rule.conditions) for name in by_anchors}
        disagreed = {
            name: judged[name].ticks for name, one in reasons.items() if one and one.condition is parts
        }
        compared = {
            name: judged[name].ticks
            for name, one in reasons.items()
            if (one is None or one.condition in (parts, parts_before)) and judged[name].compares
        }
        return now._replace(
            reasons={name: one.reason if one is not None else "" for name, one in reasons.items()},
            disagreed={**self.disagreed, **disagreed},
            compared={**self.compared, **compared},
        )

    def _displaced(self, *, retested: bool) -> Following:
        """Return this with `judged` by the latest test of whether an anchor is displaced, or by a new one."""
        now, part = self, self.part
        assert part is not None
        if retested:
            found = tuple(displacements(self.known.hypotheses[0].fit, part))
            now = now._replace(displacements=found, tested=len(part.ranges.rho))
        displaced = displaced_anchor(now.displacements)
        if retested:
            now = now._replace(doubted=(now.doubted or now.tested) if displaced is not None else 0)
        return now._replace(judged={n: one._replace(displaced=displaced) for n, one in now.judged.items()})
