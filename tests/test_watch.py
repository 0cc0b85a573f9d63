"""The page that shows a run: its contents in a real browser, and its requests.

Tests that use `opened` are skipped if no browser is installed (tests/browser.py).
"""

from __future__ import annotations

import http.client
import os
import re
import shutil
import socket
from pathlib import Path
from signal import SIGINT, SIGKILL
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import msgpack
import pytest
from msgspec.structs import replace
from playwright.sync_api import expect

from compose.errors import USER_ERROR, UserError
from compose.launch import in_process
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.view.web.site import of_folder
from protocol.journal import journal_file
from protocol.messages import Message, Observation, OfRobot
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.browser import (
    Open,
    address_of,
    chromium_only,
    inks,
    picture,
    scrub_to,
    shot,
    until_shown,
    watching,
)
from tests.commands import (
    BOUND_S,
    ENDLESS,
    PAPER_1,
    SECTION_IV,
    TandemProcess,
    journals,
    processes_of,
    tandem,
    until,
    world,
)
from tests.range_tables import SAMPLE

FAST_TICKS = 1000
"""The number of ticks of about a second at full speed."""
WITH_TIMEOUT = ("--timeout", "600")
"""The options of a mission that waits while browsers start."""


# --- a recording ---------------------------------------------------------------------------------------


def test_a_recording_at_tick_46_shows_the_first_contact(opened: Open, address: str) -> None:
    page = opened(address, tick=45)
    expect(page.locator(".card[data-robot=a] dd").first).not_to_contain_text("b")
    box = page.locator("#line").bounding_box()
    assert box is not None
    for share in range(900, 1000):
        page.mouse.click(box["x"] + share / 1000 * box["width"], box["y"] + 20)
        if page.locator("body").get_attribute("data-tick") == "46":
            break
    until_shown(page, 46)
    expect(page.locator(".card[data-robot=a] dd").first).to_contain_text("b 2.95 m")
    expect(page.locator(".card[data-robot=b] .doing")).to_have_text(
        "b stands still and waits for a's second range"
    )
    expect(page.locator("#log .now").first).to_contain_text("a and b are in range of each other: 2.95 m")
    expect(page.locator("#live")).to_contain_text("Tick 46. a and b are in range of each other: 2.95 m")
    expect(page.locator("#scrub")).to_have_attribute("aria-valuetext", re.compile("^tick 46 of 48"))
    assert "tick=46" in page.url
    shot(page, "tick-46")


@pytest.mark.long
def test_the_slider_reaches_the_last_tick_as_soon_as_it_is_visible(opened: Open, address: str) -> None:
    page = opened(address)
    until_shown(page, 0)
    page.add_init_script("window.requestAnimationFrame = () => 0")  # nothing is ever drawn
    page.reload()
    scrub = page.locator("#scrub")
    scrub.wait_for()
    assert scrub.get_attribute("max") == "48"


@pytest.mark.long
def test_the_plane_is_drawn_in_the_colours_of_what_happens(opened: Open, address: str) -> None:
    page = opened(address)
    until_shown(page, 0)
    page.keyboard.press("f")  # the camera stays where it is
    seen = {}
    for tick in (0, 20, 45, 46, 47, 48):
        scrub_to(page, tick)
        seen[tick] = inks(page)
    assert seen[0]["range"] > 3 * seen[20]["range"]  # both are in range of their anchors; neither is
    assert seen[45]["link"] == 0 < seen[46]["link"]  # phase 3 begins
    assert (
        seen[0]["ghost"] > 100 > seen[45]["ghost"]
    )  # all places at the distance; then no bearing is favoured
    tints = [f"tint-{i}" for i in range(1, 5)]
    assert not any(seen[46][tint] for tint in tints)
    assert min(seen[47][tint] for tint in tints) > 60
    assert [seen[48][tint] > 60 for tint in tints] == [True, False, False, False]
    for robot in ("robot-a", "robot-b"):
        assert 0 < 1.2 * seen[0][robot] < seen[48][robot]  # what it has just driven; older trails are paler
        assert seen[46][robot] < seen[45][robot]  # the copies at other bearings are gone with the encounter
    page.locator("#truth").uncheck()
    page.locator("#robot").select_option("b")
    scrub_to(page, 46)
    alone = inks(page)
    assert alone["ring"] < 0.6 * seen[46]["ring"]  # its own anchor's range
    assert alone["link"] > 100  # the circle of range on which a is
    scrub_to(page, 47)
    assert inks(page)["robot-a"] < 50 < seen[47]["robot-a"]  # nothing is drawn at its true position


@pytest.mark.long
def test_the_deliveries_of_reports_are_drawn_between_the_robots(opened: Open, tmp_path: Path) -> None:
    seen = {}
    for fault in ("loss=0", "loss=1", "corrupt=1"):
        recording = tmp_path / fault
        recording.mkdir()
        in_process.run_mission(load("paper-1", faults=[f"{fault}, contact_ticks=0..1"]), recording)
        with watching(recording) as (_, where):
            page = opened(where, tick=46)
            seen[fault] = inks(page)["fault"]
    assert seen["loss=0"] == 0 < 1.7 * seen["loss=1"] < seen["corrupt=1"]  # dashed; solid and crossed out


@pytest.mark.long
def test_with_the_truth_hidden_the_page_shows_only_estimates(opened: Open, address: str) -> None:
    page = opened(address, tick=20)
    plane, truth = page.locator("#canvas"), picture(page)
    expect(plane).to_have_attribute("aria-label", re.compile(r"a at 2\.66, 5\.93 m"))
    page.locator("#truth").uncheck()
    page.locator("#robot").select_option("b")
    expect(page.locator("#seen")).to_contain_text("only the posterior of b")
    expect(plane).to_have_attribute("aria-label", "The plane at tick 20: b at an unknown pose")
    expect(page.locator(".card")).to_have_count(1)
    expect(page.locator(".card dl")).not_to_contain_text("9.31")
    assert picture(page) != truth
    assert "robot=b" in page.url
    assert "truth=0" in page.url
    shot(page, "truth-hidden")
    page.locator("#truth").check()
    page.locator("#robot").select_option("")
    expect(page.locator(".card")).to_have_count(2)
    expect(page.locator("#seen")).to_have_text("")
    until(lambda: picture(page) == truth, "the truth is back")
    shot(page, "truth-shown")


@pytest.mark.long
def test_the_page_can_be_used_by_keyboard_alone(opened: Open, address: str) -> None:
    page = opened(address, tick=0)
    press = page.keyboard.press
    for key, tick in (
        ("ArrowRight", 1),
        ("Shift+ArrowRight", 11),
        ("ArrowLeft", 10),
        ("End", 48),
        (",", 47),
        (",", 46),
        (".", 47),
        ("Home", 0),
    ):
        press(key)
        until_shown(page, tick)
    expect(page.locator("#live")).to_contain_text("Tick 0. a is in its anchor's range: 2.68 m")
    press("t")
    expect(page.locator("#truth")).not_to_be_checked()
    press("r")
    expect(page.locator("#robot")).to_have_value("a")
    expect(page.locator("#seen")).to_contain_text("only the posterior of a")
    press("a")
    press("t")
    expect(page.locator("#robot")).to_have_value("")
    before = picture(page)
    press("+")
    until(lambda: picture(page) != before, "it is nearer")
    press("f")
    until(lambda: picture(page) == before, "all fits in again")
    press("n")
    until(lambda: picture(page) != before, "the robots from near")
    press("?")
    expect(page.locator("#keys")).to_be_visible()
    shot(page, "keys")
    press("Escape")
    expect(page.locator("#keys")).not_to_be_visible()
    for _ in range(8):
        press("]")
    press("Space")
    until_shown(page, 48)
    expect(page.locator("#play")).to_have_attribute("aria-label", "Play")
    press("Tab")
    focused = page.evaluate("document.activeElement.tagName")
    assert focused in {"A", "INPUT", "BUTTON", "SELECT"}


@pytest.mark.long
def test_robots_in_hardware_mode_are_shown_by_their_estimates(
    opened: Open, paper_1: Path, tmp_path: Path
) -> None:
    for path in paper_1.glob("agent-*.journal"):
        told = [decode(frame, OfRobot, MAX_FRAME_BYTES) for frame in journal_file.read(path)]
        frames = [encode(as_a_driver_tells(one)) for one in told]
        (tmp_path / path.name).write_bytes(b"".join([msgpack.packb(frame) for frame in frames]))
    with watching(tmp_path) as (_, where):
        page = opened(where, tick=46)
        expect(page.locator(".card[data-robot=b] .doing")).to_contain_text("b stands still")
        expect(page.locator("#seen")).to_contain_text("no ground truth")
        expect(page.locator("#log")).to_contain_text("b claims to be at")
        assert inks(page)["ghost"] > 100


def as_a_driver_tells(message: Message) -> Message:
    """Return a message as in hardware mode, where no simulator lists the received reports."""
    if not isinstance(message, Observation):
        return message
    return replace(message, contacts=tuple([replace(one, heard=None) for one in message.contacts]))


@pytest.mark.long
def test_the_page_is_legible_at_360_pixels(opened: Open, address: str) -> None:
    page = opened(address, tick=48, width=360, height=740)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    for part in ("#canvas", "#play", "#back", "#on", "#truth", "#robot", "#line"):
        expect(page.locator(part)).to_be_in_viewport()
    shot(page, "narrow")
    page.locator("#log").scroll_into_view_if_needed()
    expect(page.locator("#log")).to_contain_text("The mission ends: localised")


@chromium_only
@pytest.mark.long
def test_the_page_is_dark_if_the_system_is(opened: Open, address: str) -> None:
    page = opened(address, tick=47, dark=True)
    shot(page, "dark")
    background = page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
    assert max(map(int, re.findall(r"\d+", background)[:3])) < 64
    light = opened(f"{address}#tick=47")
    until_shown(light, 47)
    assert picture(light) != picture(page)


@pytest.mark.long
def test_fifty_robots_are_shown(opened: Open, tmp_path: Path) -> None:
    scenario = tmp_path / "fifty.toml"
    robots = [
        f'[[robot]]\nid = "{role}{i}"\npeer = "{peer}{i}"\n'
        f"anchor = [{40.0 * (i % 5) + offset}, {25.0 * (i // 5)}]\n"
        for i in range(25)
        for role, peer, offset in (("a", "b", 0.0), ("b", "a", 10.0))
    ]
    scenario.write_text(f'name = "fifty"\nseed = 5\n{SECTION_IV}' + "".join(robots))
    recording = tmp_path / "record"
    recording.mkdir()
    in_process.run_mission(load(str(scenario)), recording)
    with watching(recording) as (_, where):
        page = opened(where, tick=20)
        expect(page.locator(".entry")).to_have_count(50)
        expect(page.locator(".card .name")).to_have_text(["a0", "b0"])
        shot(page, "fifty")
        page.locator(".entry", has_text=re.compile("^b7 ")).click()
        expect(page.locator(".card .name")).to_have_text(["a7", "b7"])
        assert "robot=b7" in page.url
        shot(page, "fifty-b7")


@pytest.mark.long
def test_lost_late_and_damaged_reports_are_shown(opened: Open, tmp_path: Path) -> None:
    recording = tmp_path / "record"
    recording.mkdir()
    in_process.run_mission(
        load("noisy", faults=["loss=0.3, delay=0..3, corrupt=0.1, duplicate=0.2"]), recording
    )
    with watching(recording) as (_, where):
        page = opened(where, tick=26)
        expect(page.locator("#log")).to_contain_text("is lost")
        expect(page.locator("#log")).to_contain_text("ticks late")
        page.keyboard.press("n")
        shot(page, "faults")
        page.locator("#radio").uncheck()
        expect(page.locator("#log")).not_to_contain_text("is lost")
        page = opened(where, tick=55)
        expect(page.locator(".probability li").first).to_contain_text("%")


@pytest.mark.long
def test_the_recordings_in_a_folder_are_listed(opened: Open, paper_1: Path, tmp_path: Path) -> None:
    shutil.copytree(paper_1, tmp_path / "whole")
    shutil.copytree(paper_1, tmp_path / "torn")
    for torn in (tmp_path / "torn").glob("*.journal"):
        torn.write_bytes(torn.read_bytes()[:4000])
    with watching(tmp_path) as (_, where):
        page = opened(where)
        links = page.locator("#list a")
        expect(links).to_have_count(2)
        expect(links.first).to_contain_text("incomplete, ends at tick")
        expect(links.last.locator(".chip")).to_have_text("★ localised after 48 ticks")
        shot(page, "list")
        links.last.click()
        expect(page.locator("#status")).to_have_text("localised after 48 ticks")
        page.locator("#home").click()
        expect(links).to_have_count(2)


@pytest.mark.long
def test_an_estimate_shows_its_robots_and_its_figures(opened: Open, tmp_path: Path) -> None:
    folder = tmp_path / "estimated"
    assert tandem("estimate", str(SAMPLE), "--window", "0..12", "--out", str(folder)).status in (0, 1)
    with watching(folder) as (_, where):
        page = opened(where)
        expect(page.locator("#title")).to_have_text("tiers-a-b-30-s.pyfg")
        expect(page.locator("#status")).to_contain_text("undecided at the end")
        scrub_to(page, 12)
        expect(page.locator("#robots")).to_contain_text("hypotheses")
        page.get_by_role("link", name="Table and figures").click()
        expect(page.locator("#status")).to_have_text("estimate")
        expect(page.locator("#sweep tbody tr")).to_have_count(2)
        expect(page.locator("#sweep tbody tr").first).to_contain_text("LC0")
        expect(page.locator("#sweep img")).to_have_count(2)
        expect(page.locator("#sweep img").first).to_have_js_property("complete", value=True)
        shot(page, "estimate")


def test_what_is_no_summary_of_an_estimate_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "estimate.json").write_text('{"robots": 3}')
    ended = tandem("watch", str(tmp_path))
    assert ended.status == USER_ERROR
    assert ended.err.endswith(
        "estimate.json is not the summary of an estimate: the field 'source' is missing\n"
    )
    assert ended.err.count("\n") == 1


@pytest.mark.long
def test_a_sweep_shows_its_cells_and_its_figures(opened: Open, tmp_path: Path) -> None:
    spec = tmp_path / "speeds.toml"
    spec.write_text(
        'name = "speeds"\nscenario = "random"\ntrials = 2\nseed = 1\n'
        '[[axis]]\nfield = "mission.max_speed"\nvalues = [0.5, 1.0]\n'
    )
    folder = tmp_path / "sweep"
    with TandemProcess("sweep", spec, "--out", folder, "--workers", "1", "-q", "--no-audit") as sweep:
        assert sweep.ended(4 * BOUND_S).status == 0
    with watching(folder) as (_, where):
        page = opened(where)
        expect(page.locator("#title")).to_have_text("speeds")
        expect(page.locator("#sweep > .wide tbody tr")).to_have_count(2)
        expect(page.locator("#sweep > .wide tbody tr").first).to_contain_text("100.0 %")
        expect(page.locator("#sweep")).to_contain_text("Trials are not recorded")
        expect(page.locator("#sweep img").first).to_have_js_property("complete", value=True)
        expect(page.get_by_role("slider", name="Tick")).to_be_visible()  # the trials have been read
        shot(page, "sweep")


# --- live -------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_mission_is_followed_to_its_end_from_its_journals_and_from_the_network(
    opened: Open, tmp_path: Path
) -> None:
    scenario, recording = tmp_path / "paper-1.toml", tmp_path / "record"
    scenario.write_text(PAPER_1)
    with (
        world(scenario, "--out", recording, *WITH_TIMEOUT) as (_, endpoint),
        world("paper-2", *WITH_TIMEOUT) as (_, other),
        TandemProcess("agent", "a", "--connect", endpoint, "--out", recording, *WITH_TIMEOUT) as a,
        TandemProcess("agent", "b", "--connect", other),
        watching(recording) as (_, of_journals),
        watching("--connect", endpoint, "--connect", other) as (_, of_network),
    ):
        a.until_answered("a", recording)
        files, heard = opened(of_journals), opened(of_network)
        expect(heard.locator("#list a")).to_have_count(2)
        heard.locator("#list a", has_text="paper-1").click()
        for page in (files, heard):
            until_shown(page, 0)
            expect(page.locator("#status")).to_have_text("● running, tick 0")
            expect(page.locator("#follow")).to_be_visible()
        with TandemProcess("agent", "b", "--connect", endpoint, "--out", recording) as b:
            for page in (files, heard):
                expect(page.locator("#status")).to_have_text("localised after 48 ticks")
                until_shown(page, 48)
                expect(page.locator("#log .now").last).to_have_text(re.compile("The mission ends: localised"))
            shot(files, "live-journals")
            shot(heard, "live-network")
            for page in (files, heard):  # skipped frames are present afterwards
                for tick, measured in ((0, "anchor"), (5, "anchor"), (46, "b")):
                    scrub_to(page, tick)
                    expect(page.locator(".card[data-robot=a] dd").first).to_contain_text(measured)
            assert b.ended().status == 0


@pytest.mark.long("slow")
def test_a_page_keeps_up_with_a_mission_as_fast_as_it_goes(opened: Open, tmp_path: Path) -> None:
    """It skips frames: after thousands of ticks, it has never been far behind for long."""
    scenario, out = tmp_path / "endless.toml", tmp_path / "out"
    scenario.write_text(ENDLESS)
    with TandemProcess("run", scenario, "--watch", "--out", out, "-q") as run:
        page = opened(address_of(run))

        def shown() -> int:
            return int(page.evaluate("document.body.dataset.shown || -1"))

        for tick in (FAST_TICKS, 2 * FAST_TICKS):
            until(lambda tick=tick: shown() >= tick, f"tick {tick} is shown")  # type: ignore[misc]
            until(lambda: len(read(out).ticks) - shown() < FAST_TICKS // 2, "the page is nearly there")
        assert run.tell(SIGINT)
        assert run.ended().status == 130


@pytest.mark.long
def test_run_watch_serves_until_ctrl_c_and_writes_the_usual_recording(
    opened: Open, paper_1: Path, tmp_path: Path
) -> None:
    with TandemProcess("run", "paper-1", "--watch", "--out", tmp_path / "record", "-q") as run:
        page = opened(address_of(run))
        run.until_prints("the page remains at")
        expect(page.locator("#status")).to_have_text("localised after 48 ticks")
        page.keyboard.press("Home")
        until_shown(page, 0)
        page.keyboard.press("End")
        until_shown(page, 48)
        shot(page, "run-watch")
        run.tell(SIGINT)
        assert run.ended().status == 0
        assert "localised after 48 ticks" in run.out
        expect(page.locator("#status")).to_have_text("connection to the server lost")
    assert journals(tmp_path / "record") == journals(paper_1)


# --- the command ------------------------------------------------------------------------------------


def test_the_page_ends_with_whoever_launched_it(tmp_path: Path) -> None:
    with TandemProcess("run", "paper-1", "--watch", "--out", tmp_path / "record", "-q") as run:
        run.until_prints("the page remains at")
        assert processes_of(tmp_path / "record")
        run.tell(SIGKILL)
        run.ended()
        until(lambda: not processes_of(tmp_path / "record"), "nobody is left")


def test_the_server_answers_its_own_page_only_and_seals_what_it_sends(address: str) -> None:
    host = address.removeprefix("http://").rstrip("/")
    port = host.rpartition(":")[2]

    def asked(path: str, **headers: str) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection(host, timeout=BOUND_S)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        answer.read()
        connection.close()
        return answer

    for headers, status in (
        ({}, 200),
        ({"Host": f"localhost:{port}"}, 200),
        ({"Origin": f"http://{host}"}, 200),
        ({"Host": "elsewhere.example"}, 403),
        ({"Host": f"elsewhere.example:{port}", "Origin": f"http://elsewhere.example:{port}"}, 403),
        ({"Origin": "http://elsewhere.example"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "null"}, 403),
    ):
        for path in ("/", "/api/shows/paper-1"):
            answer = asked(path, **headers)
            assert (headers, answer.status) == (headers, status)
            policy = answer.getheader("content-security-policy") or ""
            assert policy.startswith("default-src 'self'")
            assert "frame-ancestors 'none'" in policy
            assert answer.getheader("cross-origin-resource-policy") == "same-origin"
    for path in ("/page/../server.py", "/page/%2e%2e/server.py", "/api/figures/x.svg", "/api/shows/none"):
        assert asked(path).status == 404


def test_ctrl_c_ends_a_page_that_is_open_in_a_browser(paper_1: Path) -> None:
    with watching(paper_1) as (command, where):
        host = where.removeprefix("http://").rstrip("/")
        connection = http.client.HTTPConnection(host, timeout=BOUND_S)
        connection.request("GET", "/api/news?show=paper-1")
        assert connection.getresponse().readline().startswith(b"data: ")
        command.tell(SIGINT)
        assert command.ended().status == 130
        assert command.err == ""
        connection.close()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["nowhere"], "nowhere is not a folder"),
        (["."], ". contains no recording, no sweep, no estimate, and no folders with recordings"),
        (
            [".", "--connect", "tcp/127.0.0.1:7447"],
            "--connect: a recording needs no network; give either DIR or --connect",
        ),
        (
            ["--connect", "here"],
            "--connect: 'here' is not an endpoint; expected one such as tcp/127.0.0.1:7447",
        ),
        (
            [".", "--port", "65536"],
            "argument --port: '65536' is not a port, which is 0 (any free port) to 65535",
        ),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], complaint: str, tmp_path: Path) -> None:
    assert tandem("watch", *arguments, cwd=tmp_path) == (2, "", f"tandem watch: {complaint}\n")


def test_a_journal_that_cannot_be_read_does_not_hide_other_recordings(paper_1: Path, tmp_path: Path) -> None:
    shutil.copytree(paper_1, tmp_path / "good")
    bad = tmp_path / "bad" / "agent-a.journal"
    shutil.copytree(paper_1, bad.parent)
    bad.unlink()
    os.mkfifo(bad)
    why = f"{bad} cannot be read: it is not a regular file"
    shown = of_folder(tmp_path)
    assert [*shown.shows] == ["good"]
    assert shown.notes == [why]
    with pytest.raises(UserError, match=re.escape(why)):
        of_folder(bad.parent)


def test_a_port_that_is_taken_is_one_line(paper_1: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for command in (["watch", str(paper_1)], ["run", "paper-1", "--watch"]):
            ended = tandem(*command, "--port", port)
            assert ended.status == 2
            said = f"tandem {command[0]}: --port: {port} cannot be used: Address already in use\n"
            assert ended.err == said


def test_a_page_on_every_address_answers_to_addresses_and_to_no_names(paper_1: Path) -> None:
    with TandemProcess("watch", paper_1, "--address", "0.0.0.0") as command:
        command.until_prints("until Ctrl-C")
        assert "tandem watch: --address: every machine that reaches 0.0.0.0 can watch\n" in command.err
        address = command.out.split()[0]
        assert address.startswith("http://127.0.0.1:")
        with urlopen(address, timeout=BOUND_S) as answer:
            assert answer.status == 200
        for known in ("192.0.2.1", "192.0.2.1:8080", "[2001:db8::1]:8080", "localhost"):
            with urlopen(Request(address, headers={"Host": known}), timeout=BOUND_S) as answer:
                assert answer.status == 200
        with pytest.raises(HTTPError, match="403"):
            urlopen(Request(address, headers={"Host": "robot.example"}), timeout=BOUND_S)


def test_a_page_on_an_address_of_this_machine_answers_to_it(paper_1: Path) -> None:
    with TandemProcess("watch", paper_1, "--address", "127.0.0.2") as command:
        command.until_prints("until Ctrl-C")
        assert command.err == ""
        address = command.out.split()[0]
        assert address.startswith("http://127.0.0.2:")
        with urlopen(address, timeout=BOUND_S) as answer:
            assert answer.status == 200


def test_an_unavailable_address_is_one_line(paper_1: Path) -> None:
    for address, said in {
        "192.0.2.1": "--address: 192.0.2.1 cannot be used: Cannot assign requested address",
        "robot": "argument --address: 'robot' is not an IP address such as 127.0.0.1 or 0.0.0.0",
    }.items():
        assert tandem("watch", str(paper_1), "--address", address) == (2, "", f"tandem watch: {said}\n")
