"""The page of a sweep: a map of its cells, from which the worst trial of a cell is played."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from playwright.sync_api import Route, expect

from compose.errors import UserError
from compose.view.web.requested_work import RequestedWork
from compose.view.web.reruns import Trials, over_time
from tests.browser import Open, shot, watching
from tests.commands import BOUND_S, TandemProcess

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
