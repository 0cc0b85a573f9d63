"""The commands that measure: many missions of sweeps, relative teams, drawn starts, attacked links."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from agent.planning import team_tasks
from compose.launch.in_process import recorded
from compose.scenario.scenario_file import validate
from compose.sweep.worker import played
from tests import links, many
from tests.drawn_starts import share
from tests.relative_teams import MOST_TICKS, SIGMA, Result, cell_of_ticks, drawn_errors, result_of


def test_missions_of_sweeps_take_turns_and_keep_the_invariants(capsys: pytest.CaptureFixture[str]) -> None:
    assert many.main(["any-start=3", "loss=2", "noise=1"]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[:3] for row in rows] == [
        ["| any-start", "3", "3"],
        ["| loss", "2", "2"],
        ["| noise", "1", "1"],
    ]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"outcome": "wrong", "reason": "b"}, "wrong: b"),
        ({"outcome": "undecided", "reason": "it is over"}, "undecided: it is over"),
        ({"violations": 1, "first_violation": "tick 3"}, "tick 3"),
    ],
)
def test_a_mission_that_breaks_an_invariant_is_named(
    changed: dict[str, Any], says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(many, "played", lambda *given: replace(played(*given), **changed))
    assert many.main(["loss=2", "--seed", "5"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [f"{says}: tandem sweep loss --seed 5 --print-trial {at}:0" for at in (0, 1)]
    assert " 2 |" in lines[-1]


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


@pytest.mark.long
def test_claims_contradict_the_ranges_only_beside_a_link_under_attack() -> None:
    for attack, contradicted in (("none", False), ("mutual +1 m", True)):
        table, at_link = links.table_of(attack, 4, 0.05, random.Random(5))
        run = recorded(validate(table, "links").scenario, "links")
        claimed = links.claimants(run)
        against = claimed.keys() - links.agreeing(run, claimed, 0.05)
        assert (len(claimed), against >= {*at_link}, bool(against)) == (4, contradicted, contradicted)
        found = links.counted(run, at_link, 0.05)
        assert (found["claims of others"], found["claims at the link"]) == (2, 2)
