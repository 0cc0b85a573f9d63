"""Guided play for a reader who knows nothing: captions that follow the drawing, a legend, legible labels."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from compose.launch.in_process import run_mission
from compose.scenario.scenario_file import setting
from compose.view.web.standalone import PAGE
from tests.browser import Open, picture, stop_clock, until_shown, watching

STEP_MS = 250
STORY = """() => ({
  tick: document.body.dataset.tick,
  caption: document.getElementById('caption').textContent,
  title: document.querySelector('#predictions:not([hidden]) .title')?.textContent ?? null,
  out: document.querySelectorAll('#predictions:not([hidden]) .out').length,
  marks: [...document.querySelectorAll('#legend li')].map((one) => one.textContent),
  busy: document.getElementById('play').getAttribute('aria-label') === 'Pause',
})"""
"""A function of the page that returns the content of guided play."""


def played(page: Page, tick: int) -> Iterator[dict[str, Any]]:
    """Yield what guided play shows from `tick` on, every STEP_MS."""
    until_shown(page, tick)
    stop_clock(page)
    page.keyboard.press("Space")
    for _ in range(90_000 // STEP_MS):
        page.clock.fast_forward(STEP_MS)
        shown = page.evaluate(STORY)
        yield shown
        if not shown["busy"]:
            return
    raise AssertionError("the page still plays")


@pytest.mark.long
def test_captions_speak_of_the_manoeuvre_and_of_what_is_left_when_it_is_drawn(
    opened: Open, address: str
) -> None:
    crossed: dict[str, list[int]] = {}
    for shown in played(opened(f"{address}#tick=46"), 46):
        crossed.setdefault(" ".join(shown["caption"].split(" ")[:3]), []).append(shown["out"])
        if shown["title"] is not None:
            assert re.match("Now a stands still|The distance is|Only one", shown["caption"])
    measured = crossed["The distance is"]
    assert [min(measured), max(measured)] == [0, 3]
    assert measured == sorted(measured)
    assert set(crossed["Only one of"]) == {3}


# --- the legend -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_legend_lists_only_the_marks_that_are_drawn(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=0")
    at: dict[int, str] = {}
    ticks = (0, 1, 2, 5, 20, 46, 47, 48)
    for tick in ticks:
        page.evaluate(f"location.hash = 'tick={tick}'")
        until_shown(page, tick)
        picture(page)
        at[tick] = " ".join(page.locator("#legend li").all_text_contents())
    for words, drawn in (
        ("all places at the measured distance", {0, 1, 2}),
        ("mirror axis", {1, 2}),
        ("turned about its anchor, the driven path fits", {47}),
        ("number of hypotheses", set(ticks)),
        ("distance to the anchor", {0, 1, 2, 5}),
        ("pose that is ruled out", {2, 48}),
        ("turned around the anchor", {5, 20}),
        ("path, phase 3: encounter", {47, 48}),
        ("report to the other robot", {46, 47, 48}),
        ("where b could drive", {47}),
        ("a pose (place and heading) that a robot may have", {1}),
        ("range between robots: 3\u00a0m", {46}),
        ("anchor (beacon); range 3\u00a0m", set(ticks)),
        ("manoeuvre chosen by b", {47}),
        ("robot a", set(ticks)),
    ):
        assert {tick for tick, listed in at.items() if words in listed} == drawn, words


@pytest.mark.long
def test_the_legend_is_beside_the_plane_or_folded_and_opens_by_a_key(opened: Open, address: str) -> None:
    wide, narrow = opened(address), opened(address, width=390, height=844)
    for page in (wide, narrow):
        until_shown(page, 0)
    assert [page.locator("#legend[open]").count() for page in (wide, narrow)] == [1, 0]
    boxes = [wide.locator(one).bounding_box() for one in ("#legend", "#canvas")]
    assert boxes[0] is not None
    assert boxes[1] is not None
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    for page in (wide, narrow):
        page.keyboard.press("k")
    expect(wide.locator("#legend ul")).to_be_hidden()
    expect(narrow.get_by_text("robot a", exact=True)).to_be_visible()
    narrow.locator("#legend summary").press("Enter")
    expect(narrow.locator("#legend ul")).to_be_hidden()


# --- labels and colours ---------------------------------------------------------------------------------


def labels(page: Page) -> dict[str, list[float]]:
    """Return the labels of the plane and their boxes."""
    picture(page)
    return {one["text"]: one["box"] for one in page.evaluate("document.getElementById('canvas').labels")}


@pytest.mark.long
def test_both_first_distances_have_labels_and_no_name_lies_on_the_line_between_robots(
    opened: Open, address: str
) -> None:
    page = opened(f"{address}#tick=0")
    until_shown(page, 0)
    assert {"2.68 m", "1.36 m"} <= labels(page).keys()
    for tick in (46, 47, 48):
        page.evaluate(f"location.hash = 'tick={tick}'")
        until_shown(page, tick)
        names = labels(page)
        targets = page.evaluate("document.getElementById('canvas').targets")
        (ax, ay), (bx, by) = [one["at"] for one in targets if one["kind"] == "robot"]
        for k in range(21):
            x, y = ax + k / 20 * (bx - ax), ay + k / 20 * (by - ay)
            for name in "ab":
                left, top, right, bottom = names[name]
                assert not (left < x < right and top < y < bottom), (tick, name)


@pytest.mark.long
def test_the_label_of_a_mutual_distance_goes_as_soon_as_the_robots_drive_on(
    opened: Open, address: str
) -> None:
    page = opened(f"{address}#tick=46")
    texts = "document.getElementById('canvas').labels.map(({ text }) => text)"
    labelled = ["2.95 m" in page.evaluate(texts) for shown in played(page, 46) if shown["tick"] == "46"]
    assert labelled[0]
    assert not labelled[-1]
    assert labelled == sorted(labelled, reverse=True)


@pytest.mark.long
def test_the_phase_of_a_planner_of_the_user_is_a_number(opened: Open, tmp_path: Path) -> None:
    run_mission(setting("paper-1", planner="tests.own_planners:Wrapping").scenario, tmp_path)
    with watching(tmp_path) as (_, found):
        page = opened(f"{found}#tick=8")
        until_shown(page, 8)
        expect(page.locator(".card[data-robot=a] .phase")).to_have_text("phase 2")
        expect(page.locator(".card[data-robot=a]")).to_contain_text("a: radial")
        expect(page.locator("#legend")).to_contain_text("path, phase 1")
        for words in ("near anchor", "search", "own anchor"):
            expect(page.locator("#mission")).not_to_contain_text(words)


STROKES = """() => new Promise((drawn) => {
  const strokes = [], { stroke } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.stroke = function (path) {
    if (path) strokes.push(`${this.strokeStyle} ${this.globalAlpha.toFixed(2)}`);
    return path ? stroke.call(this, path) : stroke.call(this);
  };
  document.getElementById('canvas').dispatchEvent(new WheelEvent('wheel', { deltaY: 1 }));
  requestAnimationFrame(() => requestAnimationFrame(() => {
    CanvasRenderingContext2D.prototype.stroke = stroke;
    drawn(strokes);
  }));
})"""
"""A function of the page that draws again, and returns colour and opacity of each piece of a trail."""


@pytest.mark.long
def test_all_seven_copies_of_a_path_have_the_colour_of_its_robot(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=5")
    until_shown(page, 5)
    picture(page)
    strokes = Counter(page.evaluate(STROKES))
    light = (PAGE / "style.css").read_text("utf-8").split("@media")[0]
    hues = dict(re.findall(r"--robot-([ab]): (#[0-9a-f]{6});", light))
    pieces = {robot: strokes[f"{hue} 0.95"] for robot, hue in hues.items()}
    assert min(pieces.values()) > 0
    assert {robot: strokes[f"{hue} 0.35"] for robot, hue in hues.items()} == {
        robot: 7 * count for robot, count in pieces.items()
    }


SEEN = {
    "all cones": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "deuteranopia": ((0.367, 0.861, -0.228), (0.280, 0.673, 0.047), (-0.012, 0.043, 0.969)),
    "protanopia": ((0.152, 1.053, -0.205), (0.115, 0.786, 0.099), (-0.004, -0.048, 1.052)),
}
"""The matrices from linear red, green and blue to those perceived (Machado et al. 2009, severity 1)."""
LEAST_DIFFERENCE = 20.0
"""The least difference of two colours in CIELAB; from about 10 on, they are told apart at a glance."""


def lab(colour: str, seen: tuple[tuple[float, ...], ...]) -> tuple[float, float, float]:
    """Return a colour in CIELAB, as one sees it whose sight is `seen`."""
    parts = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    r, g, b = (max(sum(m * part for m, part in zip(row, linear, strict=True)), 0.0) for row in seen)
    white = (0.9505, 1.0, 1.089)
    xyz = (
        0.4124 * r + 0.3576 * g + 0.1805 * b,
        0.2126 * r + 0.7152 * g + 0.0722 * b,
        0.0193 * r + 0.1192 * g + 0.9505 * b,
    )
    x, y, z = (
        (one / of) ** (1 / 3) if one / of > 0.008856 else 7.787 * one / of + 16 / 116
        for one, of in zip(xyz, white, strict=True)
    )
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


@pytest.mark.parametrize("seen", SEEN)
def test_configurations_differ_in_colour_also_for_the_colour_blind(seen: str) -> None:
    themes = (PAGE / "style.css").read_text("utf-8").split("@media (prefers-color-scheme: dark)")
    for theme in themes[0], themes[1].split("box-sizing")[0]:
        tints = dict(re.findall(r"--tint-([1-4]): (#[0-9a-f]{6});", theme))
        for one, other in combinations(tints, 2):
            pairs = zip(lab(tints[one], SEEN[seen]), lab(tints[other], SEEN[seen]), strict=True)
            assert sum((a - b) ** 2 for a, b in pairs) > LEAST_DIFFERENCE**2, (one, other)
