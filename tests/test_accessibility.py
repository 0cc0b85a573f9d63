"""The page keeps the rules of WCAG that axe-core checks: contrast, names, roles, order of headings."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from compose.launch import in_process
from compose.scenario.scenario_file import load
from tests.browser import BOUND_MS, Open, chromium_only, picture, scrub_to, until_shown, watching
from tests.commands import tandem
from tests.range_tables import SAMPLE
from tests.series import series

axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-core is not installed")
NARROW = 390
"""The width of a telephone in pixels."""


def violations(page: Page) -> dict[str, list[str]]:
    """Return the elements that break each rule."""
    found = axe.Axe().run(page).response["violations"]
    return {one["id"]: [str(node["target"]) for node in one["nodes"]] for one in found}


@pytest.mark.long
@pytest.mark.parametrize("look", series([(False, 1280), (True, 1280), (False, NARROW)], 1), ids=str)
def test_no_beat_of_a_recording_breaks_a_rule(opened: Open, address: str, look: tuple[bool, int]) -> None:
    dark, width = look
    page = opened(address, dark=dark, width=width)
    for tick in (0, 47, 48):
        scrub_to(page, tick)
        picture(page)
        assert not violations(page), tick
    page.keyboard.press("d")
    assert not violations(page)
    page.keyboard.press("e")
    expect(page.get_by_role("button", name="run", exact=True)).to_be_enabled()
    assert not violations(page)
    page.keyboard.press("?")
    assert not violations(page)


@pytest.mark.long
def test_the_other_pages_break_no_rule(opened: Open, tmp_path: Path) -> None:
    for name in ("paper-1", "paper-2"):
        (tmp_path / name).mkdir()
        in_process.run_mission(load(name), tmp_path / name)
    sweep = tmp_path / "speeds.toml"
    sweep.write_text(
        'name = "speeds"\nscenario = "random"\ntrials = 1\nseed = 1\n'
        '[[axis]]\nfield = "mission.max_speed"\nvalues = [0.5, 1.0]\n'
    )
    for command in (
        ("sweep", sweep, "--out", tmp_path / "swept", "--workers", "1", "-q", "--no-audit"),
        ("estimate", SAMPLE, "--noise", "uwb-calibrated", "--out", tmp_path / "estimated"),
    ):
        assert tandem(*command).status == 0
    for folder, ready in ((".", "#list a"), ("swept", ".cell"), ("estimated", "#home")):
        with watching(tmp_path / folder) as (_, where):
            for dark in (False, True):
                page = opened(where, dark=dark)
                expect(page.locator(ready).first).to_be_visible()
                assert not violations(page), (folder, dark)
                if folder == "estimated":
                    page.locator("#home").click()
                    expect(page.locator("#sweep table")).to_be_visible()
                    assert not violations(page), (folder, dark)


@chromium_only
@pytest.mark.long
def test_the_page_in_one_file_breaks_no_rule(browser: Browser, paper_1: Path, tmp_path: Path) -> None:
    assert tandem("export", paper_1, "--html", "--out", tmp_path).status == 0
    for dark in (False, True):
        page = browser.new_page(color_scheme="dark" if dark else "light")
        page.set_default_timeout(BOUND_MS)
        page.goto(f"{(tmp_path / 'run.html').as_uri()}#tick=47")
        until_shown(page, 47)
        picture(page)
        assert not violations(page), dark
        page.close()
