"""The sequence diagram of the page, in a browser."""

from __future__ import annotations

import re

from playwright.sync_api import expect

from tests.browser import Open, shot, until_shown


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
