"""The sequence diagram of the page, in a browser."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.browser import Open, shot, until_shown, watching
from tests.commands import tandem

TICK_PX = 34
"""The width of a tick in the diagram."""


@pytest.mark.long
def test_the_sequence_diagram_says_what_became_of_the_reports_of_the_tick(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=46")
    until_shown(page, 46)
    page.keyboard.press("d")
    diagram = page.locator("#sequence")
    expect(diagram).to_have_attribute(
        "aria-label", re.compile(r"^Tick 46\. a's report of tick 46 to b: received\. b's report")
    )
    shot(page, "sequence")
    page.keyboard.press("Home")
    expect(diagram).to_have_attribute("aria-label", "Tick 0. No reports.")
    page.keyboard.press("d")
    expect(diagram).to_be_hidden()


@pytest.mark.long
def test_the_diagram_shows_a_killed_process_and_the_ticks_around_the_current_one(
    opened: Open, tmp_path: Path
) -> None:
    killed = ("--kill", "a@20:command")
    assert tandem("run", "paper-1", "-q", "--out", tmp_path / "run", *killed).status == 0
    with watching(tmp_path / "run") as (_, address):
        page = opened(f"{address}#tick=20")
        until_shown(page, 20)
        page.keyboard.press("d")
        diagram = page.locator("#sequence")
        gone = "Tick 20. a is down: its process is gone. a is back: its process replayed 21 ticks, identical."
        expect(diagram).to_have_attribute("aria-label", gone)
        expect(page.locator("#exchange p")).to_have_text(gone)
        box = diagram.bounding_box()
        assert box is not None
        ticks = int((box["width"] - 50) // TICK_PX)
        diagram.click(position={"x": 62, "y": 60})
        until_shown(page, 20 - ticks // 2)
        page.keyboard.press("End")
        until_shown(page, 48)
        diagram.click(position={"x": 62, "y": 60})
        until_shown(page, 49 - ticks)
        shot(page, "sequence-killed")
