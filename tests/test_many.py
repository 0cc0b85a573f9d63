"""The command that runs many missions of shipped sweeps names those that break an invariant."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from compose.sweep.worker import played
from tests import many


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
