"""Parts of the page: selection and roster, sequence diagram, two recordings, and the map of a sweep."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace
from playwright.sync_api import FrameLocator, Page, Route, expect

from compose.errors import UserError
from compose.launch import in_process
from compose.recording.comparison import comparison
from compose.recording.run import read
from compose.scenario.scenario_file import load, parse
from compose.view.web.requested_work import RequestedWork
from compose.view.web.reruns import Trials, over_time
from compose.view.web.site import of_two
from tests.browser import SCRUB, Open, picture, scrub_to, shot, until_shown, watching
from tests.commands import BOUND_S, TandemProcess, tandem

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
    page = opened(address, tick=47)
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
    page = opened(address, tick=20)
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
    page = opened(address, tick=46)
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
        page = opened(address, tick=20)
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


COLUMNS = (
    "cell,way,mission.max_speed,trials,localised,undecided,inconsistent,wrong,failed,rate,violations,refused"
)
ROWS = (
    "0,lossless,0.5,4,4,0,0,0,0,1.0,0,",
    "1,lossless,1,4,3,1,0,0,0,0.75,0,",
    "2,90 % loss,0.5,4,1,1,0,2,0,0.25,0,",
    "3,90 % loss,1,0,0,0,0,0,0,,,infeasible",
)


SCRUB_TO = "(slider, step) => { slider.value = step; slider.dispatchEvent(new Event('input')); }"
"""Moves a slider, as a user does who drags it."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder that has what the page reads of a sweep."""
    axes = [
        {"name": "way", "fields": ["fault.x"], "labels": ["lossless", "90 % loss"], "values": [[0], [1]]},
        {"name": "mission.max_speed", "fields": ["mission.max_speed"], "values": [[0.5], [1.0]]},
    ]
    sweep = {"name": "ways", "trials": 4, "seed": 1, "axes": axes}
    (tmp_path / "sweep.json").write_text(json.dumps({"sweep": sweep, "refused": {"3": "infeasible"}}))
    (tmp_path / "summary.csv").write_text("\n".join([COLUMNS, *ROWS, ""]))
    return tmp_path


def test_the_map_has_each_cell_in_its_place_with_its_outcomes_in_words(opened: Open, folder: Path) -> None:
    with watching(folder) as (_, where):
        page = opened(where)
        cells = page.locator(".heat td")
        expect(cells).to_have_text(["100 %", "75 %1 undecided", "25 %2 wrong, 1 undecided", "refused"])
        expect(page.locator(".heat tbody th")).to_have_text(["lossless", "90 % loss"])
        expect(page.locator(".heat thead th")).to_have_text(["way ↓ by max_speed →", "0.5", "1"])
        expect(page.get_by_role("button", name="25 % of 4 localised, 2 wrong, 1 undecided")).to_have_count(1)
        expect(page.locator(".facts dd").first).to_have_text("66.7 % of 12")
        shot(page, "sweep-map")


def test_the_slider_shows_how_many_trials_have_localised_by_a_tick(opened: Open, folder: Path) -> None:
    outcomes = ["localised", "localised", "undecided", "localised", "wrong"]
    trials = {"cell": [0, 0, 0, 1, 2], "ticks": [10, 30, 5, 20, 8], "outcome": outcomes}
    pq.write_table(pa.table(trials), folder / "trials.parquet")
    with watching(folder) as (_, where):
        page = opened(where)
        shares, slider = page.locator(".cell b"), page.get_by_role("slider", name="Tick")
        expect(shares).to_have_text(["50 %", "25 %", "0 %"])
        slider.evaluate(SCRUB_TO, "12")
        expect(page.locator(".heat output")).to_have_text("by tick 12")
        expect(shares).to_have_text(["25 %", "0 %", "0 %"])
        slider.evaluate(SCRUB_TO, "20")
        expect(shares).to_have_text(["25 %", "25 %", "0 %"])


@pytest.mark.parametrize("ticks", ["many", [1], 2**62, float("nan")])
def test_a_table_of_trials_with_other_ticks_is_refused_in_a_line(ticks: object, tmp_path: Path) -> None:
    trials = {"cell": [0], "ticks": [ticks], "outcome": ["localised"]}
    pq.write_table(pa.table(trials), tmp_path / "trials.parquet")
    with pytest.raises(UserError, match=r"^[^\n]*: trials\.parquet cannot be read: [^\n]+$"):
        over_time(str(tmp_path))


@pytest.mark.long
def test_a_cell_is_played_from_the_keyboard(opened: Open, folder: Path) -> None:
    asked: list[str] = []

    def answer(route: Route) -> None:
        asked.append(f"{route.request.method} {route.request.url.rpartition('/api')[2]}")
        route.fulfill(json={"error": "cell 0 has no trials"})

    with watching(folder) as (_, where):
        page = opened(where)
        page.route("**/api/cells/**", answer)
        expect(page.locator(".cell")).to_have_count(3)
        for _ in range(3):  # the skip link, the scrolling map, the first cell
            page.keyboard.press("Tab")
        expect(page.locator(".cell").first).to_be_focused()
        page.keyboard.press("Enter")
        expect(page.locator("#trial")).to_have_text("cell 0 has no trials")
        assert asked == ["POST /cells/0/worst"]


def test_a_cell_that_cannot_be_run_is_one_line(folder: Path) -> None:
    work = RequestedWork()
    trials = Trials(folder, work)
    with pytest.raises(UserError, match=r"^cell 0 cannot be run: "):
        trials.worst(0)
    trials.close()
    work.stop()


@pytest.mark.long
def test_a_cell_plays_its_worst_trial_at_once_and_leads_back(opened: Open, tmp_path: Path) -> None:
    (tmp_path / "speeds.toml").write_text(
        'name = "speeds"\nscenario = "random"\ntrials = 3\nseed = 1\n'
        '[[axis]]\nfield = "mission.max_speed"\nvalues = [0.5, 1.0]\n'
    )
    words = (
        "sweep",
        tmp_path / "speeds.toml",
        "--out",
        tmp_path / "out",
        "--workers",
        "1",
        "-q",
        "--no-audit",
    )
    with TandemProcess(*words) as sweep:
        assert sweep.ended(4 * BOUND_S).status == 0
    with watching(tmp_path / "out") as (_, where):
        page = opened(where)
        page.locator(".cell").last.click()
        expect(page.locator("#status")).to_contain_text("localised after")
        expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
        assert "#show=cell-1-trial-" in page.url
        page.locator("#home").click()
        expect(page.locator(".cell")).to_have_count(2)
        assert page.url == where
