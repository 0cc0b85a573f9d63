"""Tests of the page that shows two recordings side by side, in a browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace
from playwright.sync_api import FrameLocator, Page, expect

from compose.errors import UserError
from compose.launch import in_process
from compose.recording.comparison import comparison
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.view.web.site import of_two
from tests.browser import SCRUB, Open, shot, watching
from tests.commands import tandem


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
