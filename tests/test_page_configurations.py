"""Configurations on the page: their tints and the distances that they predict."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from compose.view.web.standalone import PAGE
from tests.browser import INKS, Open, inks, scrub_to, stop_clock, until_shown

STEP_MS = 250


# --- tints --------------------------------------------------------------------------------------------


def test_tints_circles_and_orbits_stand_out_in_both_themes() -> None:
    themes = (PAGE / "style.css").read_text("utf-8").split("@media (prefers-color-scheme: dark)")
    for theme in themes[0], themes[1].split("box-sizing")[0]:
        colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", theme))
        assert min(contrast(colours[f"tint-{i}"], colours["paper"]) for i in range(1, 7)) > 4.5
        assert contrast(colours["faint"], colours["soft"]) > 4.5
        assert min(contrast(colours[name], colours["paper"]) for name in ("ring", "orbit")) > 3.0


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours, as WCAG defines it."""
    dark, light = sorted([luminance(one), luminance(other)])
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour, as WCAG defines it."""
    parts = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.long
def test_a_first_range_is_a_circle_on_which_the_robot_may_be(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=0")
    until_shown(page, 0)
    first = inks(page)["ghost"]
    page.evaluate("location.hash = 'tick=3'")
    until_shown(page, 3)  # a has no range here, and b knows its path
    assert first > 300 > inks(page)["ghost"]


@pytest.mark.long
def test_each_configuration_of_paper_1_has_its_tint_and_the_last_one_keeps_it(
    opened: Open, address: str
) -> None:
    page = opened(f"{address}#tick=46")
    shown = {}
    for tick in (46, 47, 48):
        scrub_to(page, tick)
        drawn = inks(page)
        shown[tick] = [drawn[f"tint-{i}"] > 60 for i in range(1, 5)]
    assert shown == {46: [False] * 4, 47: [True] * 4, 48: [True, False, False, False]}


TINTS = """async (ticks) => {
  const { Tints } = await import('/page/tints.js');
  const scenes = ticks.map(([a, b], tick) => ({
    tick, configurations: [{ robots: ['a', 'b'], count: a.length }],
    players: [a, b].map((world) => ({ executed: [1, 0], held: { world: world.map(([x, y]) => [x, y, 0]) } })),
  }));
  const store = {
    first: 0, whole: scenes.length, scene: (tick) => scenes[tick],
    stage: { mission: { period: 1, sensing_range: 3 } },
    player: (tick, robot) => scenes[tick].players['ab'.indexOf(robot)],
  };
  return scenes.map((_, tick) => new Tints().of(store, tick, 'b'));
}"""


@pytest.mark.long
def test_a_configuration_keeps_its_tint_though_its_place_changes(opened: Open, address: str) -> None:
    """Each robot drives 1 m along x; under noise, the order is that of the probabilities."""
    far = [5, 5]
    ticks = [
        [[[0, 0], far], [[1, 1], [6, 6]]],
        [[[6, 5], [1.1, 0]], [[7, 6], [2, 1]]],
        [[[2.1, 0], [0, -5], [7, 5]], [[3, 1], [0, -4], [8, 6]]],
        [[[8, 5]], [[9, 6]]],
    ]
    assert opened(address).evaluate(TINTS, ticks) == [[0, 1], [1, 0], [0, 2, 1], [1]]


# --- predicted distances ------------------------------------------------------------------------------


@pytest.mark.long
def test_the_predicted_distances_and_their_least_difference_are_listed(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=47")
    until_shown(page, 47)
    listed = page.locator("#predictions li")
    expect(listed).to_have_text(
        [
            "predicted",
            "1: 2.39 m",
            "2: 2.75 m",
            "3: 1.14 m",
            "4: 3.06 m",
            "nearest two differ by 0.31 m",
            "J over turn rate: 1.80\u00a0m² at +0.91 rad/s "
            "J over the turn rate from -3.1 to 3.1 rad/s; chosen: 0.91 rad/s, 1.80 m²",
        ]
    )
    page.keyboard.press("ArrowLeft")
    expect(page.locator("#predictions")).to_be_hidden()


@pytest.mark.long
def test_the_measured_range_rules_configurations_out_one_by_one_the_worst_first(
    opened: Open, address: str
) -> None:
    page = opened(f"{address}#tick=47")
    until_shown(page, 47)
    stop_clock(page)
    page.keyboard.press("Space")
    out: list[list[str]] = []
    for _ in range(200):
        page.clock.fast_forward(STEP_MS)
        found = page.locator("#predictions .out").all_text_contents()
        if not out or out[-1] != found:
            out.append(found)
        if len(found) == 3:
            break
    assert [len(found) for found in out] == [0, 1, 2, 3]
    assert out[1] == ["3: 1.14 m"]
    assert out[2] == ["3: 1.14 m", "4: 3.06 m"]
    expect(page.locator("#predictions .measured")).to_have_text("measured 2.39 m")


@pytest.mark.long
def test_the_predicted_distances_are_circles_while_the_robot_drives(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=47")
    until_shown(page, 47)
    tints = [f"tint-{i}" for i in range(1, 5)]
    before = inks(page)
    stop_clock(page)
    page.keyboard.press("Space")
    most = dict(before)
    while page.locator("body").get_attribute("data-tick") == "47":
        page.clock.fast_forward(STEP_MS)
        drawn = page.evaluate(INKS)
        most = {name: max(most[name], drawn[name]) for name in most}
    assert all(most[tint] > before[tint] + 200 for tint in tints)
