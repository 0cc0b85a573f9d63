"""The `paper` planner under noise: only the manoeuvres of the paper, and no unfounded claims."""

from __future__ import annotations

import pytest

from compose.launch.in_process import run_mission
from compose.recording.summary_json import summary
from tests.series import series
from tests.surveys import SIGMA, scenario_of, states, survey

FINE = "anchor_sigma = 0.001\nmutual_sigma = 0.001\nstrays = 0.0"
"""Fine ranges, none of which may be a stray: one range often has to tell two hypotheses apart."""
SEEDS = range(1, 17)
ITS_OWN = {
    "asleep", "straight", "turning", "circling", "third-point", "aligning", "radial", "tangent", "orbiting",
    "standing", "waiting", "last-manoeuvre", "returning", "localised", "undecided",
}  # fmt: skip
"""The states of the paper, which are the same as with exact sensors."""


@pytest.mark.parametrize("noise", series([FINE, SIGMA]), ids=["fine", "coarse"])
@pytest.mark.long
def test_the_paper_planner_drives_only_the_papers_manoeuvres(noise: str) -> None:
    for seed in SEEDS:
        recording = survey(noise, seed, "paper")
        assert {*states(recording, "a"), *states(recording, "b")} <= ITS_OWN


@pytest.mark.long
def test_the_paper_planner_mostly_localises_with_fine_ranges() -> None:
    outcomes = [summary(survey(FINE, seed, "paper"), "in-process", None)["outcome"] for seed in SEEDS]
    assert outcomes.count("localised") > 0.7 * len(SEEDS)


@pytest.mark.long
def test_the_paper_planner_is_undecided_with_coarse_ranges_and_names_the_reason() -> None:
    reasons = []
    for seed in SEEDS:
        said = summary(survey(SIGMA, seed, "paper"), "in-process", None)
        assert said["outcome"] == "undecided", seed
        reasons.append(said["reason"])
    lacking = [reason for reason in reasons if "the paper's manoeuvres give no further ranges: " in reason]
    assert len(lacking) > 3
    for reason in lacking:
        assert " of " in reason, "so much, of so much"


@pytest.mark.parametrize("noise", [FINE, SIGMA], ids=["fine", "coarse"])
@pytest.mark.long
def test_the_paper_planner_makes_no_wrong_claim(noise: str) -> None:
    claims = 0
    for seed in SEEDS:
        said = summary(survey(noise, seed, "paper"), "in-process", None)
        assert said["outcome"] != "wrong", (seed, said["reason"])
        for robot in said["robots"].values():
            if robot["localised"]:
                claims += 1
                assert robot["position_error_m"] <= 5.0 * robot["position_sigma_m"] + 1e-6
                assert robot["position_sigma_m"] <= 0.1
    assert claims > 0 or noise == SIGMA


@pytest.mark.parametrize(
    ("sigma", "seed"),
    [
        (0.0, 4317446595173490544),  # with four of twelve ranges taken for outliers, a would be off by 8 m
        (0.0, 4991156251998122645),
        (0.001, 4846399667304868315),
        (0.01, 5527597677499313376),
        (0.0, 6948019990109848974),  # a fit does not converge, and its chi-square is negative
    ],
)
def test_the_ranges_of_the_paper_planner_never_suffice_with_outliers(sigma: float, seed: int) -> None:
    noise = f"anchor_sigma = {sigma}\nmutual_sigma = {sigma}\noutliers = 0.05"
    recording = run_mission(scenario_of(noise, seed, planner_name="paper", accuracy=0.03))
    said = summary(recording, "in-process", None)
    assert said["outcome"] == "undecided"
    assert "the paper's manoeuvres give no further ranges: " in said["reason"]
    assert "of 12 required ranges from different places" in said["reason"]
