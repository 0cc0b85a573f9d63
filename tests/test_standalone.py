"""Runs that open elsewhere: the page in one file, from disk, and `run.rrd` in Rerun."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from compose.cli import export as command
from compose.cli.main import parse
from compose.errors import UserError
from compose.launch import in_process
from compose.launch.processes import free_endpoint
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.view.numbers import PLOTS
from compose.view.web import costs
from compose.view.web.standalone import standalone_page
from tests.browser import BOUND_MS, Open, chromium_only, picture, shot, until_shown
from tests.commands import BOUND_S, refused, tandem, until
from world.scenario import Scenario

MOST_BYTES = 2_000_000
"""The largest size of the file for a mission of 100 ticks."""


@pytest.fixture(scope="module")
def file(paper_1: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of paper-1, written by the command."""
    out = tmp_path_factory.mktemp("one") / "file"
    assert tandem("export", paper_1, "--html", "--out", out) == (0, f"{out / 'run.html'}\n", "")
    return out / "run.html"


@chromium_only
def test_it_plays_from_disk_to_its_end_without_a_network(browser: Browser, file: Path) -> None:
    with browser.new_context(offline=True, viewport={"width": 1280, "height": 800}) as context:
        requests: list[str] = []
        complaints: list[str] = []
        page = context.new_page()
        page.set_default_timeout(BOUND_MS)
        page.on("request", lambda request: requests.append(request.url.partition(":")[0]))
        page.on("console", lambda entry: complaints.append(entry.text) if entry.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(file.as_uri())
        until_shown(page, 0)
        expect(page).to_have_title("paper-1 · Tandem")
        page.locator("#speed").select_option("50")
        page.locator("#play").click()
        until_shown(page, 48)
        expect(page.locator("#status")).to_have_text("localised after 48 ticks")
        page.goto(f"{file.as_uri()}#tick=46&robot=a")
        until_shown(page, 46)
        shot(page, "standalone")
        assert {*requests} <= {"file", "data"}
        assert not complaints


@chromium_only
def test_it_shows_what_the_page_of_the_server_shows(
    browser: Browser, opened: Open, file: Path, address: str
) -> None:
    served = opened(f"{address}#tick=46")
    until_shown(served, 46)
    with browser.new_context(viewport={"width": 1280, "height": 800}, color_scheme="light") as context:
        page = context.new_page()
        page.goto(f"{file.as_uri()}#tick=46")
        until_shown(page, 46)
        assert picture(page) == picture(served)
        assert page.locator("#log").inner_text() == served.locator("#log").inner_text()


def test_it_is_small_and_the_same_each_time(tmp_path: Path) -> None:
    run = in_process.run_mission(load("noisy", seed=3), tmp_path)
    page = standalone_page(tmp_path)[0]
    assert page == standalone_page(tmp_path)[0]
    assert len(page.encode()) < MOST_BYTES * max(1.0, run.length / 100)


COSTS = [
    (load("random", faults=["loss=0.9"]), "Without lost reports, it takes 27 ticks, now 48."),
    (
        load("paper-1", faults=["a->b: partition=true, ticks=40..60"]),
        "Without the partition, the mission ends localised after 48 ticks.",
    ),
    (
        load("paper-1", faults=["partition=true, ticks=2..5"]),
        "Without the partition, it takes 48 ticks, too.",
    ),
    (load("paper-1"), None),
]
"""Scenarios, and what their faults cost."""


@pytest.mark.parametrize(("scenario", "cost"), COSTS)
def test_the_last_caption_says_what_faults_cost(scenario: Scenario, cost: str | None, tmp_path: Path) -> None:
    in_process.run_mission(scenario, tmp_path)
    page = standalone_page(tmp_path)[0]
    assert ('"kind":"cost"' in page) == (cost is not None)
    assert cost is None or f'"truth":"{cost}"' in page


def test_a_cost_that_takes_too_long_to_compute_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(costs, "MOST_WALL_S", 0.0)
    in_process.run_mission(COSTS[0][0], tmp_path)
    assert '"kind":"cost"' not in standalone_page(tmp_path)[0]


def test_no_text_of_a_run_ends_its_script(tmp_path: Path) -> None:
    """A verdict is written by a robot, which may be anybody's."""
    in_process.run_mission(load("paper-1"), tmp_path)
    page = standalone_page(tmp_path)[0]
    inside = re.search(r'<script type="application/json" id="recording">(.*?)</script>', page, re.DOTALL)
    assert inside is not None
    assert "<" not in inside[1]
    assert json.loads(inside[1])["mission"]["stage"]["name"] == "paper-1"


def test_what_is_no_recording_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert tandem("export", "empty", "--html", cwd=tmp_path) == (
        2,
        "",
        "tandem export: empty contains no recording, no sweep, no estimate, and no folders with recordings\n",
    )
    refused(tandem("export", "empty", "--html", "--pyfg", cwd=tmp_path), "not allowed with argument")


SOFTWARE_VULKAN = Path("/usr/lib/chromium/vk_swiftshader_icd.json")
"""The graphics driver without a graphics card that Chromium has; Rerun's viewer can use it."""


def test_without_the_library_one_line_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compose.extras.find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"needs rerun: install `tandem-ranging\[rerun\]`"):
        command.main(parse(["export", str(tmp_path), "--rerun"]))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording that the command exports of a run with noise."""
    pytest.importorskip("rerun")
    folder = tmp_path_factory.mktemp("noisy")
    in_process.run_mission(load("noisy"), folder)
    assert command.main(parse(["export", str(folder), "--rerun"])) == 0
    return folder / "run.rrd"


def of_rerun(*words: object, home: Path) -> str:
    """Return the output of Rerun's own command."""
    ended = subprocess.run(
        [sys.executable, "-m", "rerun", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
        env=os.environ | {"HOME": str(home)},
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout + ended.stderr


@pytest.mark.long
def test_rerun_verifies_the_file(recording: Path, tmp_path: Path) -> None:
    assert "verified without error" in of_rerun("rrd", "verify", recording, home=tmp_path)


def views(part: Any) -> Iterator[Any]:
    """Yield the views of a part of a blueprint."""
    contents = getattr(part, "contents", [])
    if isinstance(contents, str) or not any(hasattr(one, "contents") for one in contents):
        yield part
        return
    for one in contents:
        yield from views(one)


@pytest.mark.long
def test_the_blueprint_is_in_the_file_and_shows_only_what_it_has(recording: Path, tmp_path: Path) -> None:
    from compose.view.export.rerun_recording import blueprint  # noqa: PLC0415  # it imports Rerun

    printed = of_rerun("rrd", "print", recording, home=tmp_path)
    entities = {*re.findall(r"rows \([^)]*\) - /([^ ]*) - ", printed)}
    setup = read(recording.parent).setup
    assert setup is not None
    shown = {view.name: view for view in views(blueprint(setup).root_container)}
    assert {*shown} == {"Scene", *PLOTS, "Log"}
    assert "viewport" in entities
    assert sum(bool(re.fullmatch("view/[^/]*", one)) for one in entities) == len(shown)
    drawn = {f"robots/{robot}/{what}" for robot in "ab" for what in ("pose", "path", "hypotheses")}
    stage = {f"stage/{what}/{robot}" for robot in "ab" for what in ("anchor", "range", "orbit")}
    assert {*drawn, *stage, "robots/a/ellipse", "robots/a/range", "contact/a-b", "log"} <= entities
    for view in shown.values():
        contents = ["log"] if view.name == "Log" else view.contents
        for content in contents:
            found = [one for one in entities if re.fullmatch(content.replace("**", ".*"), one)]
            assert found, content
        assert {*view.visualizer_overrides} <= entities


@pytest.mark.long
@pytest.mark.skipif(not SOFTWARE_VULKAN.exists(), reason="there is no Vulkan driver without a graphics card")
def test_the_viewer_opens_all_views_without_a_complaint(recording: Path, tmp_path: Path) -> None:
    from rerun.experimental import ViewerClient  # noqa: PLC0415  # optional
    from rerun_cli import __main__ as viewer  # noqa: PLC0415

    port = int(free_endpoint().rpartition(":")[2])
    words = ["--headless", "--renderer", "vulkan", "--bind", "127.0.0.1", "--port", str(port), str(recording)]
    started = subprocess.Popen(
        [Path(str(viewer.__file__)).with_name("rerun"), *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ
        | {"HOME": str(tmp_path), "VK_DRIVER_FILES": str(SOFTWARE_VULKAN)}
        | {"LD_LIBRARY_PATH": str(SOFTWARE_VULKAN.parent)},
    )
    seen: list[Any] = []

    def opened() -> bool:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            seen[:] = client.get_state().views
        except (RuntimeError, ConnectionError):
            return False
        return len(seen) == 5

    try:
        until(opened, "all views are open")
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.set_time("tick", sequence=15, play_state="paused")
        client.save_screenshot(str(tmp_path / "rerun.png"))
        assert [view.reports for view in client.get_state().views] == [[]] * 5
        assert (tmp_path / "rerun.png").stat().st_size > 10_000
    finally:
        started.kill()
        started.wait()
