"""The figures of `tests.relative_teams` and `tests.drawn_starts`."""

from __future__ import annotations

import numpy as np
import pytest

from agent.planning import team_tasks
from tests.drawn_starts import share
from tests.relative_teams import MOST_TICKS, SIGMA, Result, cell_of_ticks, drawn_errors, result_of


def test_a_ratio_of_ticks_is_that_of_pairs_of_which_one_that_has_not_ended_counts_as_all_ticks() -> None:
    planned = [Result("localised", ticks, [], [], []) for ticks in (4, 8)]
    drawn = [Result("localised", 16, [], [], []), Result("undecided", 7, [], [], [])]
    low, ratio, high = 0.006, (4 / 16 * 8 / MOST_TICKS) ** 0.5, 0.840
    assert cell_of_ticks(planned, drawn) == f"6, {ratio:.2f} ({low:.2f} to {high:.2f})"


def test_a_claim_has_the_bound_of_its_measurements_and_errors_of_the_world_change_it() -> None:
    exact, noisy, off = (
        result_of(2, sigma, 1, team_tasks.next_task, errors)
        for sigma, errors in ((0.0, ""), (SIGMA, ""), (SIGMA, drawn_errors(1)))
    )
    assert (len(exact.errors), exact.nees, exact.bounds) == (1, [], [])
    assert exact.errors[0] < 1e-9
    assert 0.2 * SIGMA < noisy.bounds[0] < 0.2  # the accuracy of a claim
    assert noisy.errors[0] < 5.0 * noisy.bounds[0]
    assert off.errors != noisy.errors


def test_two_robots_claim_while_the_fit_of_a_third_goes_to_and_fro_between_poses() -> None:
    found = result_of(3, 0.0, 5002, team_tasks.next_task)
    assert found.outcome == "localised"
    assert found.ticks < 30
    assert max(found.errors) < 1e-9


@pytest.mark.parametrize("reach", [5.0, 15.0])
def test_the_share_of_admitted_starts_is_that_of_points_in_the_square(reach: float) -> None:
    first, second = np.random.default_rng(1).uniform(0.0, 10.0, (2, 1000, 2))
    admitted = np.mean(np.hypot(*(first[:, None] - second).T) <= reach, 0)
    percent, _, most = share(2, reach, 100, anchors=0).partition(" % ")
    assert float(percent) == pytest.approx(100.0 / np.mean(1.0 / admitted), abs=6.0)
    assert (most == "(1)") == (reach > 10.0 * 2.0**0.5)
