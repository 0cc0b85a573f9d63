"""What the README refers to runs."""

from __future__ import annotations

import pytest

from docs import random_starts


def test_the_figures_of_random_starts_are_printed_for_both_variants(
    capsys: pytest.CaptureFixture[str],
) -> None:
    random_starts.main(20)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert [line.partition(":")[0] for line in lines[-2:]] == ["assured", "paper"]
    assert "20 localised of 20; worst error " in lines[-2]
