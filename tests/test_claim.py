"""The conditions for a claim: the first one that is not met blocks it, for those whom it concerns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import get_args

import numpy as np
import pytest
from msgspec.structs import replace

from agent.estimation.claim import CONDITIONS, Blocked, Condition, blocked, claim
from agent.estimation.gaussian import followed_pair
from agent.estimation.judged import Judged, User
from compose.launch.in_process import run_mission
from protocol.messages import Localised
from tests.surveys import SIGMA, scenario_of


@pytest.fixture(scope="module")
def judged() -> Judged:
    """Return the estimate of a robot from which its claim has followed."""
    seen: list[Judged] = []

    def remembered(one: Judged | None, conditions: Sequence[Condition]) -> Blocked | None:
        found = blocked(one, conditions)
        if one is not None and found is None and conditions == CONDITIONS:
            seen.append(one)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(followed_pair, "blocked", remembered)
        run_mission(scenario_of(SIGMA, 4))
    return seen[-1]


def with_p_value(one: Judged, p_value: float) -> Judged:
    assert one.inconsistency is not None
    return one._replace(inconsistency=replace(one.inconsistency, p_value=p_value), ranges=15)


def with_strays(one: Judged) -> Judged:
    weights = np.where(np.arange(len(one.fit.weights)) % 2, one.fit.weights, 0.0)
    return one._replace(fit=one.fit._replace(weights=weights))


WORSE: dict[str, Callable[[Judged], Judged]] = {
    "ranges": lambda one: one._replace(ranges=2),
    "probability": lambda one: one._replace(stated=replace(one.stated, probability=0.99)),
    "convergence": lambda one: one._replace(fit=one.fit._replace(last_step=0.2)),
    "consistency": lambda one: with_p_value(one, 0.0005),
    "strays": with_strays,
    "definite covariance": lambda one: one._replace(
        stated=replace(one.stated, covariance=-1e-9 * one.stated.covariance)
    ),
    "determined position": lambda one: one._replace(measured=replace(one.measured, reach=0.001)),
    "position": lambda one: one._replace(accuracy=0.001),
    "heading": lambda one: one._replace(headings=tuple([(i, whose, 1e-4) for i, whose, _ in one.headings])),
    "early consistency": lambda one: with_p_value(one, 0.005),
}


@pytest.mark.parametrize("name", WORSE)
def test_a_condition_that_is_not_met_blocks_the_claims_of_those_whom_it_concerns(
    judged: Judged, name: str
) -> None:
    assert isinstance(claim(judged), Localised)
    (condition,) = [one for one in CONDITIONS if one.name == name]
    others = CONDITIONS[: CONDITIONS.index(condition) + 1]
    for user in get_args(User):
        found = blocked(WORSE[name](judged)._replace(user=user), others)
        if user in condition.users:
            assert found is not None
            assert found.condition is condition
            assert found.reason
        else:
            assert found is None


def test_without_a_hypothesis_there_is_no_claim() -> None:
    found = claim(None)
    assert isinstance(found, Blocked)
    assert found.reason == "no hypothesis explains the ranges"
