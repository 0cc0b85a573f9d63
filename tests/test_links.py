"""Ranges that agree with claims, and those of an attacked link."""

from __future__ import annotations

import random

import pytest

from compose.launch.in_process import recorded
from compose.scenario.scenario_file import validate
from tests import links


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
