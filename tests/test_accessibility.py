"""The page keeps the rules of WCAG that axe-core checks, and none of its texts overlaps another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace
from playwright.sync_api import Browser, Page, expect

from compose.launch import in_process
from compose.recording.kills_file import KILLS, Killed
from compose.scenario.scenario_file import load, parse
from protocol.attack import Attack
from tests.browser import BOUND_MS, Open, chromium_only, picture, scrub_to, shot, until_shown, watching
from tests.commands import SECTION_IV, tandem
from tests.range_tables import SAMPLE
from tests.series import series
from world.scenario import Scenario

NARROW = 390
"""The width of a telephone in pixels."""


def violations(page: Page) -> dict[str, list[str]]:
    """Return the elements that break each rule."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-core is not installed")
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


SIZES = [(1280, 720), (1600, 1000), (800, 600), (390, 844)]
SHOWN = [
    *[("paper-1", size) for size in SIZES],
    *[
        (name, size)
        for number, name in enumerate(["noisy", "attack", "crashes", "loss", "six", "two-hundred"])
        for size in SIZES[number % 2 :: 2]
    ],
]
"""The missions that are shown, and the sizes of the window: one in all of them, the others in every other."""
TEXTS = """() => {
  const canvas = document.getElementById('canvas'), { left, top } = canvas.getBoundingClientRect();
  const found = canvas.labels.map(({ text, box: [l, t, r, b] }) => (
    [text, l + left, t + top, r + left, b + top]
  ));
  const seen = (element, { left: l, top: t, right: r, bottom: b }) => {
    for (let outer = element; outer; outer = outer.parentElement) {
      if (getComputedStyle(outer).overflow === 'visible') continue;
      const clip = outer.getBoundingClientRect();
      l = Math.max(l, clip.left); t = Math.max(t, clip.top);
      r = Math.min(r, clip.right); b = Math.min(b, clip.bottom);
    }
    return [l, t, r, b];
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const element = node.parentElement;
    if (!node.data.trim() || !element.checkVisibility()) continue;
    if (element.closest('select, .unseen, .skip, .probability, dialog')) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const [l, t, r, b] = seen(element, range.getBoundingClientRect());
    if (r - l > 1 && b - t > 1) found.push([node.data.trim(), l, t, r, b]);
  }
  return found;
}"""
"""The visible texts and their boxes in pixels of the window, as far as nothing clips them."""


def overlapping(page: Page) -> list[tuple[str, str]]:
    """Return the pairs of texts whose boxes overlap, and the texts that lie outside of the window."""
    picture(page)
    return overlaps(page)


def overlaps(page: Page) -> list[tuple[str, str]]:
    boxes: list[list[Any]] = page.evaluate(TEXTS)
    size = page.viewport_size
    assert size is not None
    found = [
        (text, "the edge of the window")
        for text, left, top, right, bottom in boxes
        if left < -1 or top < -1 or right > size["width"] + 1 or bottom > size["height"] + 1
    ]
    for (one, left, top, right, bottom), (other, l2, t2, r2, b2) in combinations(boxes, 2):
        if left + 1 < r2 and l2 + 1 < right and top + 1 < b2 and t2 + 1 < bottom:
            found.append((one, other))
    return found


# --- missions -----------------------------------------------------------------------------------------


def many(robots: int) -> Scenario:
    """Return a scenario of pairs, ten in a row."""
    tables = [
        f'[[robot]]\nid = "{role}{i}"\npeer = "{peer}{i}"\n'
        f"anchor = [{40.0 * (i % 10) + offset}, {25.0 * (i // 10)}]\n"
        for i in range(robots // 2)
        for role, peer, offset in (("a", "b", 0.0), ("b", "a", 10.0))
    ]
    return parse(f'name = "many"\nseed = 5\n{SECTION_IV}{"".join(tables)}', "many")


def attacked() -> Scenario:
    scenario = load("random")
    a, b = scenario.robots
    return replace(scenario, robots=(replace(a, attack=Attack("scale", 0.5, "orbit")), b))


MISSIONS: dict[str, Callable[[], Scenario]] = {
    "paper-1": lambda: load("paper-1"),
    "noisy": lambda: load("noisy"),
    "attack": attacked,
    "crashes": lambda: load("paper-1"),
    "loss": lambda: load("random", faults=["loss=0.9"]),
    "six": lambda: many(6),
    "two-hundred": lambda: many(200),
}
TICKS = {
    "paper-1": (0, 5, 20, 46, 47, 48),
    "noisy": (3, 15, 16, 20),
    "attack": (12, 25),
    "crashes": (20, 30, 47),
    "loss": (25, 32, 46, 48),
    "six": (0, 11, 24),
    "two-hundred": (0, 20, 61),
}
KILLED = (
    Killed("a", 20, "command", 0.0, 21),
    Killed("world", 30, "journal", 0.0, 31),
    Killed("b", 47, "report", 0.0, 47),
)
Address = Callable[[str], str]


@pytest.fixture(scope="module")
def address_of(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    """Yield a function that returns the address of the page on the recording of a mission."""
    found: dict[str, str] = {}
    with ExitStack() as stack:

        def address(name: str) -> str:
            if name not in found:
                folder = tmp_path_factory.mktemp("labels") / name
                folder.mkdir()
                in_process.run_mission(MISSIONS[name](), folder)
                if name == "crashes":
                    (folder / KILLS).write_bytes(b"".join(msgspec.json.encode(one) + b"\n" for one in KILLED))
                found[name] = stack.enter_context(watching(folder))[1]
            return found[name]

        yield address


# --- what is shown ------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("shown", series(SHOWN), ids=str)
def test_no_text_overlaps_another(
    shown: tuple[str, tuple[int, int]], opened: Open, browser: Browser, address_of: Address
) -> None:
    """With the whole scenario in view, near the robots, and with the sequence diagram, light and dark."""
    name, size = shown
    page = opened(address_of(name), width=size[0], height=size[1])
    for tick in TICKS[name]:
        scrub_to(page, tick)
        for key in ("f", "n", "d", "d", "t", "t"):
            page.keyboard.press(key)
            assert not overlapping(page), (tick, key)
        if name == "paper-1":
            assert {"a", "b"} <= {text for text, *_ in page.evaluate(TEXTS)}
        if name == "attack":
            assert any(text.startswith("a reported, ") for text, *_ in page.evaluate(TEXTS))
        shot(page, f"labels-{name}-{tick}-{size[0]}")
    if browser.browser_type.name != "firefox":  # it cannot be told the system's theme
        page.emulate_media(color_scheme="dark")
        assert not overlapping(page)
        shot(page, f"labels-{name}-dark-{size[0]}")


COVERED = """() => {
  const { labels, targets } = document.getElementById('canvas');
  const off = ([x, y], [l, t, r, b]) => (
    Math.hypot(x - Math.min(Math.max(x, l), r), y - Math.min(Math.max(y, t), b))
  );
  return targets.filter(({ kind }) => kind !== 'anchor').flatMap(({ at, radius }) => (
    labels.filter(({ box }) => off(at, box) < 0.6 * radius).map(({ text }) => text)
  ));
}"""


@pytest.mark.long
def test_no_label_covers_a_robot_whose_bearing_is_unknown(opened: Open, address: str) -> None:
    page = opened(address)
    until_shown(page, 0)
    page.keyboard.press("t")
    for tick in (16, 20, 24):
        scrub_to(page, tick)
        picture(page)
        assert any("bearing unknown" in text for text, *_ in page.evaluate(TEXTS))
        assert not page.evaluate(COVERED), tick
