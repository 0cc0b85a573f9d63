"""Parts of the page in a browser: selection and roster, the sequence diagram, two recordings side by side."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from playwright.sync_api import FrameLocator, Page, expect

from compose.errors import UserError
from compose.launch import in_process
from compose.recording.comparison import comparison
from compose.recording.run import read
from compose.scenario.scenario_file import load, parse
from compose.view.web.site import of_two
from tests.browser import SCRUB, Open, picture, scrub_to, shot, until_shown, watching
from tests.commands import tandem

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


@pytest.fixture(scope="module")
def assured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of paper-1 with the planner `assured`, which tests must not change."""
    folder = tmp_path_factory.mktemp("recorded") / "assured"
    folder.mkdir()
    in_process.run_mission(replace(load("paper-1"), planner_name="assured"), folder)
    return folder


@pytest.fixture(scope="module")
def beside(paper_1: Path, assured: Path) -> Iterator[str]:
    """Yield the address of the page on both recordings."""
    with watching(paper_1, assured) as (_, found):
        yield found


def frames(page: Page) -> tuple[FrameLocator, FrameLocator]:
    """Return both frames, when each shows a tick."""
    found = page.frame_locator("#left"), page.frame_locator("#right")
    for frame in found:
        expect(frame.locator("body")).to_have_attribute("data-shown", re.compile(r"\d"))
    expect(page.locator("body")).to_have_attribute("data-shown", re.compile(r"\d"))
    return found


def until_both_show(page: Page, left: int, right: int) -> None:
    """Wait until the frames show these ticks."""
    for frame, tick in zip(frames(page), (left, right), strict=True):
        expect(frame.locator("body")).to_have_attribute("data-shown", str(tick))


@pytest.mark.long
def test_both_recordings_show_the_tick_of_one_clock(
    opened: Open, beside: str, paper_1: Path, assured: Path
) -> None:
    lasts = [read(folder).length - 1 for folder in (paper_1, assured)]
    assert lasts[0] != lasts[1]
    page = opened(f"{beside}#tick=3", width=1600, height=1000)
    until_both_show(page, 3, 3)
    page.locator("#clock").evaluate(SCRUB, 20)
    until_both_show(page, 20, 20)
    shot(page, "beside")
    page.keyboard.press("ArrowRight")
    until_both_show(page, 21, 21)
    expect(page).to_have_url(re.compile("#tick=21$"))
    frames(page)[1].locator("#stage").click()
    page.keyboard.press("ArrowRight")  # a key in a frame is one of both
    until_both_show(page, 22, 22)
    page.keyboard.press("End")
    until_both_show(page, *lasts)
    page.keyboard.press("Home")
    until_both_show(page, 0, 0)
    page.locator("#speed").select_option("1000")
    page.locator("#play").click()
    until_both_show(page, *lasts)
    expect(page.locator("#line-of-both")).to_have_text("the first difference is in tick 1: a's command")
    expect(page.locator("#outcome-left")).to_have_text(f"localised after {lasts[0]} ticks")


@pytest.mark.long
@pytest.mark.parametrize("size", [(800, 600), (390, 844)], ids=str)
def test_both_planes_have_room_in_a_small_window(opened: Open, beside: str, size: tuple[int, int]) -> None:
    page = opened(f"{beside}#tick=3", width=size[0], height=size[1])
    until_both_show(page, 3, 3)
    for frame in frames(page):
        box = frame.locator("#canvas").bounding_box()
        assert box is not None
        assert min(box["width"], box["height"]) > 150.0


@pytest.mark.long
def test_the_same_recording_twice_is_identical(opened: Open, paper_1: Path) -> None:
    with watching(paper_1, paper_1) as (_, address):
        page = opened(address)
        until_both_show(page, 0, 0)
        expect(page.locator("#line-of-both")).to_have_text(
            f"identical: the same commands, poses and reports in all ticks, 0 to {read(paper_1).length - 1}"
        )


@pytest.mark.long
def test_a_run_with_killed_processes_is_identical_to_one_without(paper_1: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    killed = tandem("run", "paper-1", "--kill", "a@20", "--kill", "world@30", "--out", out)
    assert killed.status == 0, killed.err
    assert comparison(read(paper_1), read(out)).identical


def test_two_folders_must_be_two_recordings(paper_1: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for folders, named in (
        ((paper_1, tmp_path / "none"), "none is not a folder"),
        ((tmp_path / "empty", paper_1), "contains no recording"),
        ((paper_1, paper_1.parent), "is not one recording: side by side, each folder must be a recording"),
    ):
        with pytest.raises(UserError, match=named):
            of_two(folders)
    refused = tandem("watch", paper_1, paper_1, paper_1)
    assert refused.status == 2
    assert refused.err.endswith("at most two recordings can be shown side by side\n")
    assert refused.err.count("\n") == 1
