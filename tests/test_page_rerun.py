"""A recording is changed on the page and run again: through HTTP, and in a browser."""

from __future__ import annotations

import json
import re
from math import remainder, tau
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import msgspec
import pytest
from msgspec.structs import replace
from playwright.sync_api import Page, Route, expect

from compose.errors import UserError
from compose.launch import in_process
from compose.scenario.scenario_change import ScenarioChange, changed, values_of
from compose.scenario.scenario_file import load, parse
from compose.scenario.toml_file import field_first
from compose.view.web import reruns
from compose.view.web.requested_work import RequestedWork
from compose.view.web.reruns import MOST_MISSION_TICKS, ChangedMissions
from compose.view.web.sources import Recorded
from tests.browser import Open, chromium_only, shot, until_loaded, until_shown
from tests.commands import until
from world.scenario import Scenario

PAPER_1 = load("paper-1")


def posted(address: str, change: object, what: str = "changed", origin: str | None = None) -> Any:
    """Return the answer to the request that the page sends; its text if it is no JSON."""
    body = change if isinstance(change, bytes) else json.dumps(change).encode()
    heads = {"Origin": origin or address.rstrip("/"), "Content-Type": "application/json"}
    request = Request(f"{address}api/shows/paper-1/{what}", body, heads)
    with urlopen(request, timeout=60) as answer:
        text = answer.read().decode()
    return text if what.endswith("toml") else json.loads(text)


def test_an_error_in_a_body_that_is_no_json_begins_with_what_it_is() -> None:
    assert field_first("JSON is malformed: invalid character (byte 0)", ScenarioChange).startswith("JSON is")


def test_a_mission_that_takes_too_long_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_process.run_mission(load("paper-1"), tmp_path)
    show, work = Recorded("", tmp_path), RequestedWork()
    show.load()
    missions = ChangedMissions(work)
    change = msgspec.convert(missions.values(show), ScenarioChange)
    monkeypatch.setattr(reruns, "MISSION_S", 0.0)
    with pytest.raises(UserError, match="the mission has not ended after 0 s: save it"):
        missions.run(show, change)
    missions.close()
    work.stop()


def values(**changed: object) -> dict[str, Any]:
    """Return the values of paper-1 for a request, with others for those in `changed`."""
    return {"robots": {}, "sensing_range": 3.0, "sigma": 0.0, "loss": 0.0, **changed}


def moved_a(x: float, y: float) -> dict[str, Any]:
    """Return the values of robot a in paper-1 with another start."""
    return {"a": {"x": x, "y": y, "heading": 1.0, "anchor_x": 0.0, "anchor_y": 0.5}}


def fetched(address: str, path: str) -> Any:
    """Return the server's answer at `path`."""
    with urlopen(f"{address}api/{path}", timeout=60) as answer:
        return json.load(answer)


def test_a_changed_mission_is_that_of_its_scenario_file_run_in_one_process(address: str) -> None:
    change = values(robots=moved_a(1.0, 2.0), sensing_range=3.5, loss=0.05)
    name = posted(address, change)["show"].replace(" ", "%20")
    scenario = parse(posted(address, change, "changed.toml"), "saved")
    run = in_process.run_mission(scenario)
    mission = fetched(address, f"shows/{name}")
    assert run.end is not None
    assert (mission["end"]["tick"], mission["end"]["outcome"]) == (run.end.tick, run.end.outcome)
    assert mission["stage"]["mission"]["sensing_range"] == 3.5
    assert mission["stage"]["faults"][0][1] == 0.05
    for tick in (0, run.end.tick):
        [scene] = fetched(address, f"shows/{name}/scenes?from={tick}&to={tick}")["scenes"]
        assert run.world is not None
        poses = [(pose.x, pose.y, remainder(pose.heading, tau)) for pose in run.world.ticks[tick].truth.poses]
        shown = [(x, y, remainder(turn, tau)) for x, y, turn in (one["pose"] for one in scene["players"])]
        assert shown == [pytest.approx(pose, abs=1e-12) for pose in poses]


REFUSED: dict[str, tuple[object, int, str]] = {
    "no number": (values(sigma=float("nan")), 400, "SON is malformed"),
    "infinite": (json.dumps(values()).replace("3.0", "1e999").encode(), 400, "sensing_range"),
    "too large": (b" " * 10_000, 413, "more than 8192 bytes"),
    "a code": (values(planner="os:popen"), 400, "unknown field 'planner'"),
    "unknown robot": (
        values(robots={"z": moved_a(0.0, 1.0)["a"]}),
        422,
        "robots: there is no 'z'; there are a, b",
    ),
    "R = 0": (values(sensing_range=0.0), 422, "mission.sensing_range: expected a number >= 0.001"),
    "out of range": (values(robots=moved_a(5.0, 0.0)), 422, "robot[0].start: 'a' is 5.02493781 m from its"),
    "loss": (values(loss=1.5), 422, "fault[0].loss: expected a number <= 1.0"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_a_file_may_not_have_is_one_line(address: str, what: str) -> None:
    change, status, why = REFUSED[what]
    with pytest.raises(HTTPError) as refused:
        posted(address, change)
    line = json.loads(refused.value.read())["error"]
    assert (refused.value.code, "\n" in line) == (status, False)
    assert why in line


def test_only_the_page_of_the_server_changes_a_mission(address: str) -> None:
    for origin in ("http://elsewhere.example", "null", "http://127.0.0.1:1"):
        with pytest.raises(HTTPError, match="403"):
            posted(address, values(), origin=origin)
    for heads in ({"Content-Type": "application/json"}, {"Origin": address.rstrip("/")}):
        request = Request(f"{address}api/shows/paper-1/changed", b"{}", heads)
        with pytest.raises(HTTPError, match=r"403|415"):
            urlopen(request, timeout=60)


FAULTS = ("a->b: loss=0.3, delay=0..3", "loss=0.1", "delay=2, ticks=3..9")
EVERYTHING = """
name = "everything"
seed = 3
max_ticks = 77
mission = {sensing_range = 3.0, period = 1.0, max_speed = 1.0, max_turn_rate = 3.1, accuracy = 0.3, noise = {profile = "uwb", slow_sigma = 0.0}}
[world.noise]
anchor_sigma = 0.07
anchor_bias = {a = 0.1}
[world.range]
model = "fading"
options = {full = 0.7}
[[robot]]
id = "a"
anchor = [0.0, 0.0]
attack = {kind = "scale", size = 0.5, part = "orbit"}
[[robot]]
id = "b"
anchor = [10.0, 0.0]
start = [11.0, 0.0, 100.0]
"""  # noqa: E501


@pytest.mark.parametrize(
    "scenario", [load("paper-1", faults=FAULTS), load("noisy"), parse(EVERYTHING, "everything")]
)
def test_without_a_change_the_file_describes_the_same_scenario(scenario: Scenario) -> None:
    table = changed(scenario, values_of(scenario), MOST_MISSION_TICKS).table
    again = parse(json_as_toml(table), "saved")
    assert replace(again, name=scenario.name) == scenario


def json_as_toml(table: dict[str, Any]) -> str:
    return pytest.importorskip("tomli_w").dumps(table)  # type: ignore[no-any-return]


def test_sigma_is_that_of_all_ranges_and_zero_is_exact() -> None:
    noisy = load("noisy")
    found = [
        parse(
            json_as_toml(changed(noisy, replace(values_of(noisy), sigma=sigma), MOST_MISSION_TICKS).table),
            "saved",
        )
        for sigma in (0.02, 0.0)
    ]
    noise = found[0].mission.noise
    assert (noise.anchor_sigma, noise.mutual_sigma, noise.outliers) == (0.02, 0.02, 0.05)
    assert found[1].mission.noise.exact


def test_a_planner_that_the_user_has_not_named_is_not_run_again() -> None:
    scenario = replace(PAPER_1, planner_name="os:popen")
    for refused in (
        lambda: values_of(scenario),
        lambda: changed(scenario, values_of(PAPER_1), MOST_MISSION_TICKS),
    ):
        with pytest.raises(UserError, match="the planner is os:popen; to run its code, add --planner"):
            refused()


# --- in a browser ---------------------------------------------------------------------------------------


ON_TOP = """(one) => {
  const { left, top, width, height } = one.getBoundingClientRect();
  return one.disabled || document.elementFromPoint(left + width / 2, top + height / 2) === one;
}"""
"""Returns whether nothing covers the middle of an element."""


def opened_form(opened: Open, address: str, **window: Any) -> Page:
    """Return the page of paper-1 with the form open, and its values in it."""
    page = opened(f"{address}#show=paper-1&tick=0", **window)
    until_loaded(page)
    page.keyboard.press("e")
    expect(page.get_by_label("start x in m", exact=True)).to_have_value(str(PAPER_1.robots[0].start.x))
    return page


def pixel(page: Page, x: float, y: float) -> tuple[float, float]:
    """Return the place in the window of a position in <W>, by the anchors of paper-1 that are drawn."""
    drawn = page.evaluate("document.getElementById('canvas').targets")
    a, b = (
        next(one["at"] for one in drawn if one["kind"] == "anchor" and one["robot"] == robot)
        for robot in "ab"
    )
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    scale = (b[0] - a[0]) / (PAPER_1.robots[1].anchor.x - PAPER_1.robots[0].anchor.x)
    return box["x"] + a[0] + scale * x, box["y"] + a[1] - scale * y


def drag(page: Page, before: tuple[float, float], after: tuple[float, float]) -> None:
    page.mouse.move(*pixel(page, *before))
    page.mouse.down()
    page.mouse.move(*pixel(page, 0.5 * (before[0] + after[0]), 0.5 * (before[1] + after[1])))
    page.mouse.move(*pixel(page, *after))
    page.mouse.up()


@pytest.mark.long
def test_a_start_that_is_dragged_is_where_the_mission_begins_again(opened: Open, address: str) -> None:
    page = opened_form(opened, address)
    start = PAPER_1.robots[0].start
    drag(page, (start.x, start.y), (1.0, 2.0))
    x, y = (float(page.get_by_label(f"start {axis} in m", exact=True).input_value()) for axis in "xy")
    assert (x, y) == pytest.approx((1.0, 2.0), abs=0.05)
    page.get_by_role("button", name="run", exact=True).click()
    expect(page.locator("#title")).to_have_text("paper-1-changed")
    expect(page).to_have_url(re.compile("show=changed"))
    expect(page.locator("#status")).to_contain_text("localised")
    name = re.search(r"show=(changed)[+%20]+(\d+)", page.url)
    assert name is not None
    [scene] = fetched(address, f"shows/changed%20{name[2]}/scenes?from=0&to=0")["scenes"]
    assert scene["players"][0]["pose"][:2] == [x, y]
    expect(page.get_by_label("start x in m", exact=True)).to_have_value(f"{x:g}")  # ready for the next change
    older = opened(f"{address}#tick=7")  # from when there was one mission
    expect(older.locator("#title")).to_have_text("paper-1")
    until_shown(older, 7)


@pytest.mark.long
def test_a_list_that_arrives_before_the_next_frame_does_not_bring_the_old_mission_back(
    opened: Open, address: str
) -> None:
    posted(address, values())  # the address names the mission if there are several
    page = opened_form(opened, address)
    page.evaluate("""() => {
      Object.assign(window, { lists: 0, titles: [] });
      const title = document.getElementById("title");
      new MutationObserver(() => window.titles.push(title.textContent)).observe(title, { childList: true });
      new EventSource("/api/news").onmessage = ({ data }) => { window.lists += "list" in JSON.parse(data); };
    }""")
    until(lambda: page.evaluate("lists"), "there is a list of missions")
    page.evaluate("""() => {
      window.requestAnimationFrame = () => 0;
      document.querySelector("#changes button:not([type=button])").click();
    }""")
    until(lambda: page.evaluate("lists > 1 && titles.length"), "the list has the new mission")
    for _ in range(5):  # the page gets the list at about the same time, and would then fetch the old mission
        page.evaluate("async () => (await fetch('/api/shows/paper-1')).text()")
    assert page.evaluate("titles") == ["paper-1-changed"]


@chromium_only
def test_the_form_works_from_the_keyboard_and_saves_the_scenario(opened: Open, address: str) -> None:
    page = opened_form(opened, address)
    page.get_by_label("sensing range R in m", exact=True).nth(1).focus()
    page.keyboard.press("Control+a")
    page.keyboard.type("3.5")
    page.get_by_label("reports lost").first.focus()
    page.keyboard.press("ArrowRight")
    loss = float(page.get_by_label("reports lost").nth(1).input_value())
    assert loss > 0.0
    page.get_by_role("button", name="save as a scenario").focus()
    with page.expect_download() as saved:
        page.keyboard.press("Enter")
    assert saved.value.suggested_filename == "paper-1-changed.toml"
    found = load(str(saved.value.path()))
    assert (found.mission.sensing_range, found.faults[0].loss) == (3.5, loss)
    page.get_by_role("button", name="reset").focus()
    page.keyboard.press("Space")
    expect(page.get_by_label("sensing range R in m", exact=True).nth(1)).to_have_value("3")
    page.get_by_role("button", name="close").press("e")
    expect(page.locator("#changes")).to_be_hidden()


@pytest.mark.long
@chromium_only
def test_an_empty_field_and_what_the_server_refuses_run_nothing(opened: Open, address: str) -> None:
    page = opened_form(opened, address)
    sent = []

    def refuse(route: Route) -> None:
        """Answer as the server does, but with a status that browsers do not log."""
        sent.append(json.loads(route.request.post_data or ""))
        with pytest.raises(HTTPError) as refused:
            posted(address, sent[-1])
        route.fulfill(status=200, content_type="application/json", body=refused.value.read())

    page.route(re.compile("/changed$"), refuse)
    field = page.get_by_label("start x in m", exact=True)
    for empty_or_not in ("", "5"):
        field.fill(empty_or_not)
        field.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("robot[0].start: 'a' is")
    expect(page.locator("#title")).to_have_text("paper-1")
    assert [one["robots"]["a"]["x"] for one in sent] == [5.0]


@pytest.mark.long
def test_in_a_narrow_window_the_handles_stay_in_view_while_the_form_is_scrolled(
    opened: Open, address: str
) -> None:
    page = opened_form(opened, address, width=390, height=844)
    start = PAPER_1.robots[0].start
    fields = page.locator("#changes button, #changes input").all()
    for one in [*fields, *reversed(fields)]:
        one.focus()
        expect(page.locator("#canvas")).to_be_in_viewport(ratio=1.0)
        assert one.evaluate(ON_TOP)
    drag(page, (start.x, start.y), (1.0, 2.0))
    assert float(page.get_by_label("start x in m", exact=True).input_value()) == pytest.approx(1.0, abs=0.1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("width", "height", "dark"), [(1280, 720, False), (800, 600, True), (390, 844, True)]
)
def test_the_form_is_legible(opened: Open, address: str, width: int, height: int, dark: bool) -> None:
    page = opened_form(opened, address, width=width, height=height, dark=dark)
    shot(page, f"rerun-{width}-{'dark' if dark else 'light'}")
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    for box in page.locator("#changes input, #changes button").all():
        box.scroll_into_view_if_needed()
        expect(box).to_be_in_viewport()
