"""The sequence diagram of the page, in a browser."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from compose.launch import in_process
from compose.scenario.scenario_file import load
from tests.browser import Open, picture, scrub_to, shot, until_shown, watching
from tests.commands import tandem


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
def test_the_diagram_shows_a_killed_process_and_zooms_by_key_and_by_button(
    opened: Open, tmp_path: Path
) -> None:
    """All ticks are visible, then a few around the current one."""
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
        plane = picture(page)
        diagram.focus()
        page.keyboard.press("0")
        box = diagram.bounding_box()
        assert box is not None
        diagram.click(position={"x": box["width"] - 2, "y": 60})
        until_shown(page, 48)
        for _ in range(3):
            page.get_by_role("button", name="Zoom the diagram in").click()
        diagram.click(position={"x": 62, "y": 60})
        expect(page.locator("body")).to_have_attribute("data-shown", re.compile("^3.$"))
        scrub_to(page, 20)
        assert picture(page) == plane  # its keys are not those of the plane


BARS = """() => {
  const canvas = document.getElementById('sequence'), style = getComputedStyle(document.documentElement);
  const { width, height } = canvas, { data } = canvas.getContext('2d').getImageData(0, 0, width, height);
  const found = { link: [], fault: [] };
  for (const [name, columns] of Object.entries(found)) {
    const hex = style.getPropertyValue(`--${name}`).trim();
    const ink = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
    for (let i = 0; i < data.length; i += 4) {
      if (ink.every((part, k) => data[i + k] === part)) columns.push((i / 4) % width / width);
    }
  }
  return Object.values(found).every((columns) => columns.length > 20 && Math.min(...columns) > 0.95);
}"""
"""Returns true if the diagram has bars of received and of lost reports, all of them at its right end."""


@pytest.mark.long
def test_a_long_mission_is_shown_as_bars(opened: Open, tmp_path: Path) -> None:
    """All reports are in the last four of thousands of ticks."""
    in_process.run_mission(load("far", faults=["loss=0.5"]), tmp_path)
    with watching(tmp_path) as (_, address):
        page = opened(f"{address}#tick=3000")
        until_shown(page, 3000)
        page.keyboard.press("d")
        diagram = page.locator("#sequence")
        expect(diagram).to_have_attribute("aria-label", "Tick 3000. No reports.")
        diagram.focus()
        page.keyboard.press("0")
        page.keyboard.press("End")
        page.wait_for_function(BARS)
        shot(page, "sequence-long")
