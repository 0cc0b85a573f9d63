"""Selection on the page: by hover, click and address; and the roster of many robots, the worst first."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from compose.launch import in_process
from compose.recording.run import read
from compose.scenario.scenario_file import parse
from tests.browser import Open, picture, scrub_to, until_shown, watching

PAIRS = 3


def target(page: Page, kind: str, robot: str, place: int | None = None) -> tuple[float, float]:
    """Return where a robot, an anchor or a hypothesis is drawn, as x and y of the window in pixels."""
    picture(page)
    found: list[dict[str, Any]] = page.evaluate("document.getElementById('canvas').targets")
    [at] = [
        one["at"] for one in found if (one["kind"], one["robot"], one.get("place")) == (kind, robot, place)
    ]
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    return box["x"] + at[0], box["y"] + at[1]


@pytest.mark.long
def test_hovering_shows_the_numbers_and_a_click_selects_until_escape(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=47")
    until_shown(page, 47)
    page.keyboard.press("n")
    tip = page.locator("#tip")
    page.mouse.move(*target(page, "robot", "a"))
    expect(tip).to_contain_text(
        re.compile(r"^a: \S+, \S+ m, \S+ rad\nanchor: no range in this tick\nb: range")
    )
    page.mouse.move(*target(page, "hypothesis", "b", 2))
    expect(tip).to_contain_text(re.compile(r"^b, hypothesis 3 of 4: .* rad\nprobability 25 %\nerror \S+ m$"))
    page.mouse.down()
    page.mouse.up()
    expect(page).to_have_url(re.compile("select=hypothesis.b.2"))
    page.mouse.move(*target(page, "anchor", "b"))
    expect(tip).to_contain_text("anchor of b: 10.00, 0.00 m")
    page.mouse.move(1, 1)
    expect(tip).to_contain_text("hypothesis 3 of 4")
    page.mouse.click(*target(page, "robot", "a"))
    expect(page.locator(".card.chosen .name")).to_have_text("a")
    page.keyboard.press("Escape")
    page.mouse.move(1, 1)
    expect(page.locator(".card.chosen")).to_have_count(0)
    expect(tip).to_be_hidden()
    assert not re.search("select|robot", page.url)


@pytest.mark.long
def test_the_address_holds_the_view_once_the_user_has_moved_the_camera_and_the_selection(
    opened: Open, address: str
) -> None:
    page = opened(f"{address}#tick=20")
    until_shown(page, 20)
    page.mouse.click(*target(page, "anchor", "a"))
    expect(page).to_have_url(f"{address}#tick=20&select=anchor.a")
    page.keyboard.press("+")
    page.keyboard.press("w")
    expect(page).to_have_url(re.compile(r"select=anchor\.a&view=\S+_\S+_\S+$"))
    page.mouse.move(1, 1)
    again = opened(page.url)
    until_shown(again, 20)
    assert target(again, "anchor", "a") == pytest.approx(target(page, "anchor", "a"), abs=0.1)
    expect(again.locator("#tip")).to_contain_text("anchor of a")
    again.keyboard.press("f")
    expect(again).to_have_url(f"{address}#tick=20&select=anchor.a")


# --- many robots --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of PAIRS pairs, of which b2 finds that a2 reports false data."""
    robots = "".join(
        f'[[robot]]\nid = "a{i}"\npeer = "b{i}"\nanchor = [0.0, {20.0 * i}]\n'
        + ('attack = {kind = "scale", size = 0.5, part = "orbit"}\n' if i == 2 else "")
        + f'[[robot]]\nid = "b{i}"\npeer = "a{i}"\nanchor = [10.0, {20.0 * i}]\n'
        for i in range(PAIRS)
    )
    mission = "[mission]\nsensing_range = 3.0\nperiod = 1.0\nmax_speed = 1.0\nmax_turn_rate = 3.14159\n"
    folder = tmp_path_factory.mktemp("many")
    in_process.run_mission(parse(f'name = "many"\nseed = 3\n{mission}{robots}', "many"), folder)
    return folder


@pytest.fixture(scope="module")
def many_address(many: Path) -> Iterator[str]:
    with watching(many) as (_, found):
        yield found


@pytest.mark.long
def test_the_roster_counts_outcomes_and_names_the_worst_robots_first(
    opened: Open, many: Path, many_address: str
) -> None:
    last = read(many).ticks[-1].truth.tick
    page = opened(many_address)
    scrub_to(page, 0)
    expect(page.locator("#counts")).to_have_text("6 running")
    scrub_to(page, last)
    expect(page.locator("#counts")).to_have_text("1 inconsistent, 1 undecided, 4 localised")
    entries = page.locator(".entry")
    expect(entries).to_have_text(
        ["b2 inconsistent", "a2 undecided", *[f"{role}{i} localised" for i in (0, 1) for role in "ab"]]
    )
    entries.first.click()
    expect(page.locator(".card.chosen .name")).to_have_text("b2")
    expect(page).to_have_url(re.compile("robot=b2"))
