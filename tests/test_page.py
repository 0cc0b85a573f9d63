"""Regression tests of the page in a browser.

Tests that use `opened` are skipped if no browser is installed (tests/browser.py).
"""

from __future__ import annotations

import re
from contextlib import ExitStack, suppress
from pathlib import Path
from signal import SIGKILL

import pytest
from playwright.sync_api import Page, expect

from compose.recording.recording_files import WORLD_JOURNAL
from compose.recording.run import read
from protocol.journal import journal_file
from protocol.journal.journal_file import Journal
from protocol.messages import Command, Observation
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from tests.browser import Open, inks, picture, scrub_to, shot, stop_clock, until_shown, watching
from tests.commands import ENDLESS, TandemProcess, copied, until, world
from tests.series import series
from world.referee import errors

# --- live -------------------------------------------------------------------------------------------


def frames_to(path: Path, tick: int, first: type[Observation | Command] = Observation) -> int:
    """Return the number of frames in a journal before `tick`, whose first frame is a `first`."""
    for place, frame in enumerate(journal_file.read(path)):
        with suppress(MalformedFrame):
            if decode(frame, first, MAX_FRAME_BYTES).tick == tick:
                return place
    raise AssertionError(f"{path} has no tick {tick}")


@pytest.mark.long
def test_late_data_of_a_tick_appears_on_the_time_line_and_in_the_log(
    opened: Open, paper_1: Path, tmp_path: Path
) -> None:
    whole = {path.name: list(journal_file.read(path)) for path in paper_1.glob("*.journal")}
    told = dict.fromkeys(whole, 0)
    with ExitStack() as stack:
        growing = {name: stack.enter_context(Journal(tmp_path / name)) for name in whole}

        def grow(robots: int, commands: int) -> None:
            """Write the journals of robots up to tick `robots`, and Commands up to tick `commands`."""
            goals = {name: frames_to(paper_1 / name, robots) for name in whole if name != WORLD_JOURNAL}
            goals[WORLD_JOURNAL] = frames_to(paper_1 / WORLD_JOURNAL, commands, Command)
            for name, goal in goals.items():
                growing[name].write(*whole[name][told[name] : goal])
                told[name] = goal

        grow(46, 47)
        _, where = stack.enter_context(watching(tmp_path))
        page = opened(where)
        expect(page.locator("#status")).to_have_text("● running, tick 46")
        until_shown(page, 46)  # where the two are and what they do, and nothing of what they sense
        expect(page.locator("#log")).not_to_contain_text("in range of each other")
        page.keyboard.press("Home")
        until_shown(page, 0)
        assert marks(page) == 0
        for key, tick in (("End", 46), ("ArrowLeft", 45), ("ArrowRight", 46)):  # then it follows no more
            page.keyboard.press(key)
            until_shown(page, tick)
        card = page.locator(".card[data-robot=a]")
        expect(card).not_to_contain_text("b 2.95 m")
        grow(47, 47)
        expect(page.locator("#log")).to_contain_text("a and b are in range of each other: 2.95 m")
        expect(card).to_contain_text("b 2.95 m")
        page.keyboard.press("Home")
        until_shown(page, 0)
        assert marks(page) > 20  # the mark of the contact
        grow(48, 48)
        expect(page.locator("#log")).to_contain_text("b has 4 hypotheses")
        expect(page.locator("#log")).to_contain_text("a and b are in range of each other: 2.95 m")


MARKS = """() => {
  const canvas = document.getElementById('bands');
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, 12).data;
  let found = 0;
  for (let i = 3; i < data.length; i += 4) if (data[i] > 100 && (i >> 2) % canvas.width > 60) found += 1;
  return found;
}"""


def marks(page: Page) -> int:
    """Return the number of pixels of marks and of the hand in the time line, except around tick 0."""
    picture(page)
    return int(page.evaluate(MARKS))


@pytest.mark.long("slow")
def test_a_killed_robot_keeps_its_phase_and_is_shown_as_down_until_it_is_back(
    opened: Open, tmp_path: Path
) -> None:
    scenario, recording = tmp_path / "endless.toml", tmp_path / "record"
    scenario.write_text(ENDLESS)
    patient = ("--timeout", "600")
    with (
        world(scenario, "--out", recording, "--rate", "20", *patient) as (_, endpoint),
        TandemProcess("agent", "b", "--connect", endpoint, "--out", recording, *patient),
        watching(recording) as (_, of_journals),
        watching("--connect", endpoint) as (_, of_network),
    ):
        a = ("agent", "a", "--connect", endpoint, "--out", recording, *patient)
        with TandemProcess(*a) as killed:
            pages = [opened(of_journals), opened(of_network, dark=True)]
            for page in pages:
                expect(page.locator(".card[data-robot=a]")).to_have_attribute("data-phase", "2")
                expect(page.locator("#log")).not_to_contain_text("is down")
            killed.tell(SIGKILL)
            killed.ended()
        for i, page in enumerate(pages):
            card = page.locator(".card[data-robot=a]")
            expect(card.locator(".doing")).to_have_text("a is down: its process is gone")
            expect(card.locator(".phase")).to_have_text("phase 2: search; down")
            expect(card).to_have_attribute("data-phase", "2")
            # in this tick or, if the world has sent the next one by then, in the one before
            expect(page.locator("#log")).to_contain_text("a is down: its process is gone")
            assert inks(page)["fault"] > 0  # crossed out
            shot(page, f"down-{i}")
            page.keyboard.press("Home")
            until_shown(page, 0)
            assert marks(page) > 20
            page.keyboard.press("End")
        with TandemProcess(*a):
            for page in pages:
                expect(page.locator("#log")).to_contain_text("a is back: its process runs again")
                expect(page.locator(".card[data-robot=a] .doing")).not_to_contain_text("down")
                expect(page.locator(".card[data-robot=b] .doing")).not_to_contain_text("down")


# --- contents ---------------------------------------------------------------------------------------

CENTRE = """() => {
  const canvas = document.getElementById('canvas'), style = getComputedStyle(document.documentElement);
  const hex = style.getPropertyValue('--ghost').trim();
  const ink = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  let x = 0, y = 0, n = 0;
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] > 100 && ink.every((part, k) => Math.abs(data[i + k] - part) < 12)) {
      x += (i / 4) % canvas.width; y += Math.floor(i / 4 / canvas.width); n += 1;
    }
  }
  return [Number(document.body.dataset.tick), x / n, y / n];
}"""


@pytest.mark.long
def test_an_estimate_moves_between_ticks_like_its_robot(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=20&truth=0&robot=a")
    until_shown(page, 20)
    page.locator("#speed").select_option("0.5")
    page.keyboard.press("Space")
    at: dict[int, list[tuple[float, float]]] = {}

    def moved() -> bool:
        tick, x, y = page.evaluate(CENTRE)
        seen = at.setdefault(tick, [])
        seen.append((x, y))
        return bool(max(abs(x - seen[0][0]), abs(y - seen[0][1])) > 1.0)

    until(moved, "what is drawn of a's belief moves within a tick")


HELD = """async ([now, next, share]) => {
  const { held_now } = await import('/page/held.js');
  const held = (one) => ({ local: [], probability: [], covariance: null, ...one });
  const scenes = [now, next].map((one) => ({ players: [{ held: held(one), executed: one.executed }] }));
  const store = {
    places: new Map([['a', 0]]), stage: { mission: { period: 1, sensing_range: 3 } },
    player: (tick) => scenes[tick]?.players[0],
  };
  const robot = { id: 'a', anchor: [0, 0], frame: null };
  return held_now({ store, scene: scenes[0], truth: true, tick: 0, share, moving: true }, robot);
}"""


def test_a_hypothesis_that_goes_on_moves_to_where_it_is_next_and_others_as_driven(
    opened: Open, address: str
) -> None:
    """Hypotheses are ordered by probability, and the order changes from tick to tick."""
    page = opened(address)
    now = {"world": [[0, 0, 0], [5, 5, 0]], "probability": [0.7, 0.3], "covariance": [4, 0, 0, 4, 0, 0]}
    next_ = {"world": [[6.1, 5, 0], [1, 0.1, 0]], "probability": [0.9, 0.1], "covariance": [2, 0, 0, 2, 0, 0]}
    found = page.evaluate(HELD, [now, next_ | {"executed": [1, 0]}, 0.5])
    assert found["poses"] == [[0.5, pytest.approx(0.05), 0], [pytest.approx(5.55), 5, 0]]
    assert found["covariance"] == now["covariance"]  # its hypothesis is no longer the first
    kept = {"world": [[1.1, 0, 0]], "covariance": [2, 0, 0, 2, 0, 0], "executed": [1, 0]}
    found = page.evaluate(HELD, [now, kept, 0.5])
    assert found["poses"] == [[pytest.approx(0.55), 0, 0], [5.5, 5, 0]]  # the other is ruled out then
    assert found["covariance"] == [3, 0, 0, 3, 0, 0]
    far = {"world": [[1.5, 0, 0]], "executed": [1, 0]}
    assert page.evaluate(HELD, [now, far, 0.5])["poses"][0] == [0.5, 0, 0]  # it jumps at the tick


CROWDED = """async () => {
  const { Labels, NAME } = await import('/page/labels.js');
  const look = { font: '12px sans-serif', bold: '600 15px sans-serif', paper: '#fff' };
  const labels = new Labels(document.createElement('canvas').getContext('2d'), look, 400, 300, []);
  for (let y = 0; y <= 300; y += 6) labels.avoid([0, y], [400, y]);
  labels.put('2.00 m', 200, 150, '#000', 'center');
  labels.put('a', 200, 150, '#000', 'left', { rank: NAME, around: 15 });
  labels.draw();
  return labels.drawn.map(({ text }) => text);
}"""


def test_among_many_ranges_a_robot_keeps_its_name(opened: Open, address: str) -> None:
    assert opened(address).evaluate(CROWDED) == ["a"]


WATCHED = """() => {
  window.changes = [];
  new MutationObserver((records) => {
    for (const { target, attributeName } of records) {
      window.changes.push(`${target.id || target.className}.${attributeName}`);
    }
  }).observe(document, { subtree: true, childList: true, attributes: true, characterData: true });
}"""


def test_a_frame_within_a_tick_changes_no_element(opened: Open, address: str) -> None:
    """If one did, the browser would compute styles and the layout in each frame."""
    page = opened(address)
    scrub_to(page, 20)
    page.locator("#speed").select_option("0.5")
    stop_clock(page)
    page.keyboard.press("Space")
    page.clock.run_for(200)
    before = picture_of(page)
    page.evaluate(WATCHED)
    page.clock.run_for(400)
    assert picture_of(page) != before
    assert page.evaluate("window.changes") == []


def picture_of(page: Page) -> str:
    """Return the canvas as it is, whose clock stands."""
    return str(page.evaluate("document.getElementById('canvas').toDataURL()"))


@pytest.mark.long
def test_a_view_is_the_same_picture_however_it_was_reached(opened: Open, address: str) -> None:
    """A part that does not change between two ticks is drawn once, and again when it changes."""
    pages = {tick: opened(f"{address}#tick={tick}") for tick in (30, 40)}
    expected = {}
    for tick, page in pages.items():
        until_shown(page, tick)
        expected[tick] = inks(page)
    page = pages[30]
    first = picture(page)
    for away, back in (("n", "f"), ("t", "t"), ("r", "a"), ("w", "f")):
        page.keyboard.press(away)
        assert picture(page) != first
        page.keyboard.press(back)
        for tick, inked in reversed(expected.items()):
            scrub_to(page, tick)
            assert inks(page) == inked
        assert picture(page) == first


JOINED = """async () => {
  const { Timeline } = await import('/page/timeline.js');
  const make = (name) => document.createElement(name);
  const timeline = new Timeline(make('div'), make('canvas'), make('input'), () => {});
  const player = (robot) => ({ robot, command: { phase: 2 }, contacts: [], down: false });
  const robots = [{ id: 'a', role: 'a', peer: 'b' }];
  const store = {
    stage: { robots }, few: () => robots, whole: 1, last: 0, live: true,
    scene: () => ({ players: [player('a'), player('b')], events: [] }),
  };
  timeline.stage(store);
  timeline.draw({ tick: 0, share: 0, focus: null, moving: false }, new Map());
  const first = [...timeline.spans.keys()];
  robots.push({ id: 'b', role: 'b', peer: 'a' });
  timeline.stage(store);
  timeline.draw({ tick: 0, share: 0, focus: null, moving: false }, new Map());
  return [first, timeline.spans.get('b').length];
}"""


@pytest.mark.long
def test_a_robot_that_joins_is_on_the_timeline_once_the_page_has_its_setup(
    opened: Open, address: str
) -> None:
    """A pushed scene may contain a robot before the page has read the setup of the mission again."""
    assert opened(address).evaluate(JOINED) == [["a"], 1]


@pytest.mark.parametrize("dark", series([False, True]))
def test_without_the_truth_the_page_opens_with_the_estimates(
    dark: bool, opened: Open, paper_1: Path, tmp_path: Path
) -> None:
    copied(paper_1, tmp_path, "agent-a.journal", "agent-b.journal")
    with watching(tmp_path) as (_, where):
        page = opened(where, height=720, dark=dark)
        until_shown(page, 0)
        page.keyboard.press("End")
        until_shown(page, 48)
        expect(page.locator("#truth")).not_to_be_checked()
        expect(page.locator("#truth")).to_be_disabled()
        expect(page.locator("#seen")).to_have_text("no ground truth: only the posterior of each robot")
        expect(page.locator("#canvas")).to_have_attribute(
            "aria-label", re.compile(r"The plane at tick 48: a at .*; b at ")
        )
        drawn = inks(page)
        assert min(drawn[f"robot-{role}"] for role in "ab") > 100  # trails
        page.keyboard.press("t")
        assert inks(page) == drawn
        assert "truth=0" not in page.url
        shot(page, f"no-truth-{dark}")


@pytest.mark.long
def test_the_error_is_that_of_the_likeliest_pose_or_else_a_range(
    opened: Open, paper_1: Path, address: str
) -> None:
    page = opened(address, tick=47, height=720)
    truth = read(paper_1).ticks[47].truth.poses[1]
    off = sorted(errors(pose, truth)[0] for pose in read(paper_1).estimates("b")[47].world)
    assert len(off) == 4
    assert off[3] > 1.0
    error = page.locator(".card[data-robot=b] .error")
    expect(error).to_have_text(f"error up to {off[3]:.2f} m")
    expect(error).to_have_attribute("title", re.compile(rf"^\S+ m to {off[3]:.2f} m: 4 poses are possible"))
    shot(page, "equally-likely")
    page.locator("#truth").uncheck()
    expect(page.locator("#canvas")).to_have_attribute("aria-label", re.compile("b at one of 4 poses"))
    shot(page, "equally-likely-believed")
    page.locator("#truth").check()
    page.keyboard.press("End")
    expect(error).to_have_text(re.compile(r"^error \S+ \S*m$"))


def test_a_tick_after_the_end_is_corrected_in_the_address(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=99999")
    until_shown(page, 48)
    expect(page).to_have_url(f"{address}#tick=48")


# --- keys -------------------------------------------------------------------------------------------


DRAWN = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
"""A script that waits until all pending drawing is done."""
TIMELESS = """() => {
    const real = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (draw) => real(() => draw(1));
}"""
"""A script that stops time for a page that still draws."""


@pytest.mark.parametrize(
    "click",
    series(["#back", "#log li:first-child button", "#on", "#truth", "#near", ".card[data-robot=a] .name"]),
)
def test_space_after_a_click_plays_and_pauses_and_does_nothing_else(
    opened: Open, address: str, click: str
) -> None:
    page = opened(address, tick=20)
    page.keyboard.press("[")
    page.keyboard.press("[")
    page.keyboard.press("[")
    page.locator(click).click()
    page.evaluate(DRAWN)
    tick = page.locator("body").get_attribute("data-tick")
    before = state(page)
    page.evaluate(TIMELESS)
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Play")
    assert state(page) == before
    assert page.locator("body").get_attribute("data-tick") == tick


def state(page: Page) -> list[object]:
    found: list[object] = page.evaluate(
        "[document.getElementById('truth').checked, document.getElementById('robot').value,"
        " document.getElementById('speed').value]"
    )
    return found


@pytest.mark.long
def test_space_plays_though_the_closed_help_still_has_the_focus(opened: Open, address: str) -> None:
    """For a moment after it closes, longer on a slow machine, keys still go to its button."""
    page = opened(address, tick=45)
    page.locator("#keys button").first.dispatch_event("keydown", {"key": " ", "bubbles": True})
    until_shown(page, 48)


@pytest.mark.long
def test_who_goes_by_keyboard_presses_a_button_with_space(opened: Open, address: str) -> None:
    page = opened(address, tick=20)
    page.locator("#back").focus()
    page.keyboard.press("Space")
    until_shown(page, 19)
    expect(page.locator("#play")).to_have_attribute("aria-label", "Play")


@pytest.mark.long
def test_the_speed_box_takes_only_the_keys_that_choose_a_speed(opened: Open, address: str) -> None:
    page = opened(address, tick=20)
    speed = page.locator("#speed")
    speed.focus()
    for key, tick in (("ArrowRight", 21), ("ArrowLeft", 20), ("Shift+ArrowRight", 30), ("Home", 0), (".", 1)):
        page.keyboard.press(key)
        with suppress(AssertionError):
            until_shown(page, tick)
        assert page.locator("body").get_attribute("data-tick") == str(tick), key
        expect(speed).to_have_value("5")
        expect(speed).to_be_focused()
    page.keyboard.press("ArrowDown")
    expect(speed).to_have_value("10")
    page.keyboard.press("t")
    expect(page.locator("#truth")).not_to_be_checked()
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
    expect(speed).to_have_value("10")
