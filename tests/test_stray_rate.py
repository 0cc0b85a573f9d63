"""Robots learn how many ranges are strays, so that one more of many does not decide."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats  # type: ignore[import-untyped]

from agent.estimation.gaussian import stray_rate
from compose.launch import in_process
from compose.scenario.scenario_file import validate
from protocol.noise import Noise

TOLD = Noise(0.05, 0.05, strays=0.01)
ALPHA, BETA = stray_rate.WORTH * 0.01, stray_rate.WORTH * 0.99
OUTLIERS = {
    "name": "outliers",
    "seed": 1375614881244800650,
    "mission": {
        "sensing_range": 3.0,
        "period": 1.0,
        "max_speed": 1.0,
        "max_turn_rate": 3.141592653589793,
        "accuracy": 0.1,
        "noise": {"anchor_sigma": 0.05, "mutual_sigma": 0.05},
    },
    "world": {"noise": {"outliers": 0.1}},
    "robot": [{"id": "a", "anchor": [0.0, 0.0]}, {"id": "b", "anchor": [10.0, 0.0]}],
}
"""A mission whose robots once claimed another hypothesis, because it explained two strays more."""


@pytest.mark.parametrize(("strays", "inliers"), [(0, 0), (0, 9), (1, 20), (11, 48), (6, 0)])
def test_the_rate_of_strays_has_a_beta_distribution_about_the_told_one(strays: int, inliers: int) -> None:
    count = strays + inliers
    one_order = stats.betabinom.pmf(strays, count, ALPHA, BETA) / math.comb(count, strays)
    assert stray_rate.log_likelihood(strays, inliers, TOLD) == pytest.approx(np.log(one_order), abs=1e-9)
    weights = np.repeat([0.0, 1.0], [strays, inliers])
    mean = stats.beta.mean(ALPHA + strays, BETA + inliers)
    assert stray_rate.expected_rate(weights, TOLD) == pytest.approx(mean)


def test_a_rate_is_not_learned_beside_a_told_rate_of_outliers() -> None:
    for noise in (Noise(0.05, 0.05, outliers=0.1), Noise(0.05, 0.05, strays=0.0)):
        assert not stray_rate.is_learned(noise)
        assert stray_rate.log_gain(3, 20, noise) == 0.0


def test_outliers_that_nobody_told_do_not_make_a_wrong_hypothesis_certain() -> None:
    run = in_process.run_mission(validate(OUTLIERS, "outliers").seeded(None))
    assert run.end is not None
    assert run.end.outcome == "localised"
