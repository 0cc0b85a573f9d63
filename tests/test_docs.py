"""The scripts in docs/ run."""

from __future__ import annotations

import pytest

from docs import rendezvous


@pytest.mark.long
def test_the_figures_of_the_rendezvous_are_printed_a_line_a_setting(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendezvous, "SETTINGS", [rendezvous.SECTION_IV])
    rendezvous.main(90, 25)
    heading, line = capsys.readouterr().out.splitlines()
    assert heading.split()[0] == "D,"
    setting, _, figures = line.partition("3.14 ")
    assert setting.split() == ["10,", "3,", "1,", "1,"]
    bound, mean, worst, paper_mean, paper_worst, *_ = (
        float(word) for word in figures.replace("/", " ").split()
    )
    assert worst <= bound
    assert mean <= 0.6 * paper_mean
    assert worst <= 0.6 * paper_worst
