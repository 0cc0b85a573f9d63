"""Guided play, in a browser with a clock of its own: time, captions, camera, controls, legend and labels."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from compose.launch import in_process
from compose.launch.in_process import run_mission
from compose.scenario.scenario_file import load, setting
from compose.view.web.standalone import PAGE
from tests.browser import INKS, Open, chromium_only, picture, shot, stop_clock, until_shown, watching
from tests.test_accessibility import SIZES, overlaps

STEP_MS = 250
"""The time in ms between two frames of the page."""
BUSY = "document.getElementById('play').getAttribute('aria-label') === 'Pause'"
NOW = f"""() => [
  Number(document.body.dataset.tick), document.getElementById('caption').textContent, {BUSY},
]"""


def started(
    opened: Open, address: str, tick: int = 0, *, reduced: bool = False, size: tuple[int, int] = SIZES[0]
) -> Page:
    """Return a page on which guided play has begun. From then on, time passes only by `played`."""
    page = opened(f"{address}#tick={tick}", width=size[0], height=size[1])
    page.emulate_media(reduced_motion="reduce" if reduced else "no-preference")
    until_shown(page, tick)
    stop_clock(page)
    page.keyboard.press("Space")
    return page


def played(page: Page, most_s: float = 90.0) -> Iterator[tuple[int, str]]:
    """Yield the tick and the caption of a page every STEP_MS, until it stops playing."""
    for _ in range(round(1000 * most_s / STEP_MS)):
        page.clock.fast_forward(STEP_MS)
        tick, caption, busy = page.evaluate(NOW)
        yield tick, caption
        if not busy:
            return
    raise AssertionError(f"the page still plays after {most_s} s")


PLANE = "(({ clientWidth, clientHeight }) => [clientWidth, clientHeight])(document.getElementById('canvas'))"
"""An expression of the page: the size of the plane in pixels."""


@pytest.mark.long
@pytest.mark.parametrize("size", [SIZES[0], SIZES[-1]], ids=str)
def test_guided_play_tells_paper_1_in_less_than_a_minute_and_at_no_moment_does_text_overlap(
    size: tuple[int, int], opened: Open, address: str
) -> None:
    """Most of the time is that of the encounter, and the plane keeps its size."""
    page = started(opened, address, size=size)
    expect(page.locator("#guide")).to_have_attribute("aria-pressed", "true")
    seen: list[tuple[float, str]] = []
    planes = set()
    for now in played(page):
        assert not overlaps(page), now
        planes.add(str(page.evaluate(PLANE)))
        if now[1] not in [caption for _, caption in seen]:
            shot(page, f"guided-{size[0]}-{len(seen)}")
        seen.append(now)
    assert len(planes) == 1
    told = list(dict.fromkeys(caption for _, caption in seen))
    assert [re.split(r"[.,]", one)[0] for one in told] == [
        "Each robot knows where the anchors are and how it moves",
        "A robot measures how far away its anchor or the other robot is",
        "After a straight drive and a second distance",
        "b had two hypotheses of its pose relative to its anchor",
        "After a short drive",
        "They drive on circles around their anchors to find each other",
        "a and b meet",
        "The distance was 2",
        "Now a stands still and b drives to where the four predict distances that differ most: then the "
        "next measured distance can tell which one is true",
        "The distance is 2",
        "Only one of the four hypotheses is left",
        "Both are localised: each knows its position and its heading",
    ]
    assert 40.0 < 0.001 * STEP_MS * len(seen) < 60.0
    assert sum(tick >= 46 for tick, _ in seen) > 0.4 * len(seen)
    assert seen[-1][0] == 48


LONG = """async ([encounter, last, captions]) => {
  const { Guide } = await import('/page/guide.js');
  const robots = [{ id: 'a', role: 'a', peer: 'b' }, { id: 'b', role: 'b', peer: 'a' }];
  const scene = (tick) => ({ tick, captions: captions[tick] ?? [] });
  const store = {
    stage: { robots }, first: 0, last, whole: last + 1, scene,
    player: (tick) => ({ command: { phase: tick < encounter ? 2 : 3, verdict: null } }),
  };
  const guide = new Guide(), view = { tick: 0, share: 0, beat: null, held: 0, focus: null, truth: true };
  guide.stage(store);
  const ticks = [];
  while (guide.advance(view, 0.1)) { guide.told(view); ticks.push(view.tick); }
  return ticks;
}"""


@pytest.mark.long
def test_guided_play_of_thousands_of_ticks_takes_about_a_minute(opened: Open, address: str) -> None:
    """There is a caption in every third tick of the encounter."""
    page = opened(address)
    told = [{"kind": "measured", "text": "x" * 90, "robots": ["a", "b"]}]
    encounter, last = 6000, 6600
    captions = dict.fromkeys(range(encounter, last, 3), told)
    ticks = page.evaluate(LONG, [encounter, last, captions])
    assert 60.0 < 0.1 * len(ticks) < 80.0
    assert 50 < sum(tick < encounter for tick in ticks) < 70


@pytest.mark.long
def test_guided_play_stops_at_each_kill_and_at_the_first_fault_of_each_kind(
    opened: Open, address: str
) -> None:
    page = opened(address)
    captions: dict[int, list[dict[str, object]]] = {
        tick: [
            {"kind": "report-lost", "text": f"a's report of tick {tick} to b is lost.", "robots": ["a", "b"]}
        ]
        for tick in range(20, 30)
    }
    captions[10] = [
        {"kind": "down", "text": "a is down: its process is gone.", "robots": ["a", "b"]},
        {
            "kind": "back",
            "text": "a is back: its process replayed 10 ticks, identical.",
            "robots": ["a", "b"],
        },
    ]
    captions[40] = [{"kind": "down", "text": "The world is down: its process is gone.", "robots": []}]
    ticks = page.evaluate(LONG, [20, 60, captions])
    stops = {tick for tick in range(60) if ticks.count(tick) > 15}
    assert stops == {10, 20, 40}
    assert ticks.count(10) > 1.5 * ticks.count(40)


PX_PER_M = """() => {
  const { targets } = document.getElementById('canvas');
  const of_b = (kind) => targets.find((one) => one.kind === kind && one.robot === 'b').at;
  const [robot, anchor] = [of_b('robot'), of_b('anchor')];
  return Math.hypot(robot[0] - anchor[0], robot[1] - anchor[1]);
}"""
"""A function of the page that returns how far b is from its anchor on the plane, in pixels."""


@pytest.mark.long
def test_the_camera_is_where_two_mirror_images_are_and_goes_back(opened: Open, address: str) -> None:
    page = opened(address, tick=1)
    expect(page.locator("#camera")).to_have_attribute("aria-pressed", "true")
    picture(page)
    near = page.evaluate(PX_PER_M) / 0.934
    page.evaluate("location.hash = 'tick=4'")
    until_shown(page, 4)
    picture(page)
    far = page.evaluate(PX_PER_M) / 2.69
    assert near > 3 * far


@pytest.mark.long
def test_a_path_that_is_turned_comes_to_one_hypothesis_after_the_other(opened: Open, address: str) -> None:
    page = started(opened, address, 46)
    drawn = []
    for tick, caption in played(page):
        if tick == 47 and caption.startswith("The distance was"):
            targets = page.evaluate("document.getElementById('canvas').targets")
            drawn.append(sum(one["kind"] == "hypothesis" and one["robot"] == "a" for one in targets))
        if "predict distances" in caption:
            break
    assert drawn == sorted(drawn)
    assert min(drawn) < 4 == max(drawn)


@pytest.mark.long
def test_the_camera_follows_the_story_until_it_is_moved(opened: Open, address: str) -> None:
    page = started(opened, address, 44)
    camera = page.locator("#camera")
    for tick, _ in played(page):
        if tick == 47:
            break
    expect(camera).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("Space")
    settle(page)
    near = picture_now(page)
    page.keyboard.press("w")
    page.clock.fast_forward(STEP_MS)
    expect(camera).to_have_attribute("aria-pressed", "false")
    assert picture_now(page) != near
    page.keyboard.press("Space")
    page.clock.fast_forward(STEP_MS)
    expect(camera).to_have_attribute("aria-pressed", "false")
    page.keyboard.press("Space")
    page.keyboard.press("c")
    settle(page)
    expect(camera).to_have_attribute("aria-pressed", "true")
    assert picture_now(page) == near


def settle(page: Page) -> None:
    """Let enough time pass for the camera to arrive."""
    for _ in range(20):
        page.clock.fast_forward(STEP_MS)


def picture_now(page: Page) -> str:
    """Return the canvas as a data URL; unlike `picture`, it does not wait for the clock."""
    return str(page.evaluate("document.getElementById('canvas').toDataURL()"))


DISCS = """async () => {
  const { story_discs } = await import('/page/camera.js');
  const [{ name }] = await new Promise((done) => {
    const source = new EventSource('/api/news');
    source.onmessage = ({ data }) => { source.close(); done(JSON.parse(data).list.shows); };
  });
  const { stage } = await (await fetch(`/api/shows/${name}`)).json();
  const { scenes } = await (await fetch(`/api/shows/${name}/scenes?from=0&to=48`)).json();
  const player = (tick, robot) => scenes[tick]?.players.find((one) => one.robot === robot);
  const phase = (tick, robot) => player(tick, robot)?.command?.phase ?? 1;
  const view = { store: { stage, player, phase }, share: 0, focus: null, truth: true };
  return [[46, 1], [47, 1], [48, 0], [48, 1]].map(([tick, eliminated]) => {
    const inside = ([x, y]) => story_discs({ ...view, tick, eliminated }, stage.robots).some(
      ([at, radius]) => Math.hypot(x - at[0], y - at[1]) < radius
    );
    const shown = (k) => scenes[k].players.flatMap((one) => one.held.world).filter(inside).length;
    return [shown(47), shown(48)];
  });
}"""


@pytest.mark.long
def test_the_camera_keeps_every_hypothesis_in_view_and_those_being_ruled_out(
    opened: Open, address: str
) -> None:
    ahead, with_four, ruling_out, after = opened(address).evaluate(DISCS)
    assert ahead[0] == 8
    assert with_four == ruling_out == [8, 2]
    assert after[1] == 2
    assert after[0] < 8


FINISHED = """async (verdicts) => {
  const { story_discs } = await import('/page/camera.js');
  const robots = ['a0', 'b0', 'a1', 'b1'].map((id, i) => ({ id, anchor: [10 * i, 0], orbit: [6.5] }));
  const player = (tick, robot) => ({
    pose: [1, 2, 0], command: { phase: 3, verdict: verdicts.includes(robot) ? ['localised'] : null },
  });
  const store = { stage: { robots, mission: { sensing_range: 3 } }, player, phase: () => 3 };
  const view = { store, tick: 5, focus: null, truth: true, eliminated: 1 };
  return story_discs(view, robots.slice(0, 2)).map(([at]) => at[0]);
}"""


@pytest.mark.long
def test_once_its_pair_has_finished_the_camera_shows_all_pairs(opened: Open, address: str) -> None:
    page = opened(address)
    assert set(page.evaluate(FINISHED, ["a0"])) == {1}
    assert page.evaluate(FINISHED, ["a0", "b0"]) == [0, 10, 20, 30]


@pytest.mark.long
def test_the_camera_recovers_from_a_window_too_low_for_a_picture(opened: Open, address: str) -> None:
    page = started(opened, address, 46)
    for height in (170, 800):
        page.set_viewport_size({"width": 1000, "height": height})
        for _ in range(20):
            page.clock.fast_forward(STEP_MS)
            picture_now(page)
    assert page.evaluate(INKS)["robot-b"] > 60


@pytest.mark.long
def test_guided_play_can_be_left_and_entered_by_keys_and_buttons(opened: Open, address: str) -> None:
    page = opened(address)
    until_shown(page, 0)
    guide = page.locator("#guide")
    for action, pressed in (
        (lambda: page.keyboard.press("g"), "false"),
        (lambda: page.keyboard.press("g"), "true"),
        (lambda: page.locator("#speed").select_option("10"), "false"),
        (guide.click, "true"),
        (lambda: page.keyboard.press("]"), "false"),
    ):
        action()
        expect(guide).to_have_attribute("aria-pressed", pressed)
    expect(page.locator("#speed")).to_have_value("20")
    before = picture(page)
    page.keyboard.press("Space")
    until_shown(page, 48)
    expect(page.locator("#camera")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("Home")
    until_shown(page, 0)
    assert picture(page) == before  # the camera is back, too


@pytest.mark.long
def test_captions_are_announced_while_the_story_is_played_and_events_otherwise(
    opened: Open, address: str
) -> None:
    page = started(opened, address, 44)
    caption, live = page.locator("#caption"), page.locator("#live")
    page.clock.fast_forward(STEP_MS)
    expect(caption).to_have_attribute("aria-live", "polite")
    said = live.text_content()
    for tick, _ in played(page):
        if tick == 46:
            break
    assert live.text_content() == said
    page.keyboard.press("Space")
    settle(page)
    expect(caption).to_have_attribute("aria-live", "off")
    expect(live).to_contain_text("Tick 46. a and b are in range of each other")


@chromium_only
@pytest.mark.long
def test_with_reduced_motion_nothing_moves_between_two_ticks(opened: Open, address: str) -> None:
    page = started(opened, address, 44, reduced=True)
    pictures: dict[tuple[int, str], set[str]] = {}
    for tick, caption in played(page):
        if tick >= 46:
            pictures.setdefault((tick, caption), set()).add(picture_now(page))
    assert {tick for tick, _ in pictures} == {46, 47, 48}
    assert all(len(found) == 1 for (tick, _), found in pictures.items() if tick < 48)


@pytest.mark.long
def test_the_server_tells_what_faults_cost_once_it_has_run_the_mission_without(
    opened: Open, tmp_path: Path
) -> None:
    in_process.run_mission(load("random", faults=["loss=0.9"]), tmp_path)
    with watching(tmp_path) as (_, address):
        page = opened(f"{address}#tick=48")
        expect(page.locator("#caption")).to_contain_text("Without lost reports, it takes 27 ticks, now 48.")
        page.keyboard.press("t")
        expect(page.locator("#caption")).not_to_contain_text("Without")


def test_captions_do_not_tell_the_truth_if_it_is_hidden(opened: Open, address: str) -> None:
    page = opened(address, tick=48)
    expect(page.locator("#caption")).to_contain_text(
        "each knows its position and its heading. The claimed positions are off by"
    )
    page.keyboard.press("t")
    expect(page.locator("#caption")).to_have_text(re.compile(r"each knows its position and its heading\.$"))


STORY = """() => ({
  tick: document.body.dataset.tick,
  caption: document.getElementById('caption').textContent,
  title: document.querySelector('#predictions:not([hidden]) .title')?.textContent ?? null,
  out: document.querySelectorAll('#predictions:not([hidden]) .out').length,
  marks: [...document.querySelectorAll('#legend li')].map((one) => one.textContent),
  busy: document.getElementById('play').getAttribute('aria-label') === 'Pause',
})"""
"""A function of the page that returns the content of guided play."""


def story_from(page: Page, tick: int) -> Iterator[dict[str, Any]]:
    """Yield what guided play shows from `tick` on, every STEP_MS."""
    until_shown(page, tick)
    stop_clock(page)
    page.keyboard.press("Space")
    for _ in range(90_000 // STEP_MS):
        page.clock.fast_forward(STEP_MS)
        shown = page.evaluate(STORY)
        yield shown
        if not shown["busy"]:
            return
    raise AssertionError("the page still plays")


@pytest.mark.long
def test_captions_speak_of_the_manoeuvre_and_of_what_is_left_when_it_is_drawn(
    opened: Open, address: str
) -> None:
    crossed: dict[str, list[int]] = {}
    for shown in story_from(opened(f"{address}#tick=46"), 46):
        crossed.setdefault(" ".join(shown["caption"].split(" ")[:3]), []).append(shown["out"])
        if shown["title"] is not None:
            assert re.match("Now a stands still|The distance is|Only one", shown["caption"])
    measured = crossed["The distance is"]
    assert [min(measured), max(measured)] == [0, 3]
    assert measured == sorted(measured)
    assert set(crossed["Only one of"]) == {3}


# --- the legend -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_legend_lists_only_the_marks_that_are_drawn(opened: Open, address: str) -> None:
    page = opened(f"{address}#tick=0")
    at: dict[int, str] = {}
    ticks = (0, 1, 2, 5, 20, 46, 47, 48)
    for tick in ticks:
        page.evaluate(f"location.hash = 'tick={tick}'")
        until_shown(page, tick)
        picture(page)
        at[tick] = " ".join(page.locator("#legend li").all_text_contents())
    for words, drawn in (
        ("all places at the measured distance", {0, 1, 2}),
        ("mirror axis", {1, 2}),
        ("turned about its anchor, the driven path fits", {47}),
        ("number of hypotheses", set(ticks)),
        ("distance to the anchor", {0, 1, 2, 5}),
        ("pose that is ruled out", {2, 48}),
        ("turned around the anchor", {5, 20}),
        ("path, phase 3: encounter", {47, 48}),
        ("report to the other robot", {46, 47, 48}),
        ("where b could drive", {47}),
        ("a pose (place and heading) that a robot may have", {1}),
        ("range between robots: 3\u00a0m", {46}),
        ("anchor; sensing range 3\u00a0m", set(ticks)),
        ("manoeuvre chosen by b", {47}),
        ("robot a", set(ticks)),
    ):
        assert {tick for tick, listed in at.items() if words in listed} == drawn, words


@pytest.mark.long
def test_the_legend_is_beside_the_plane_or_folded_and_opens_by_a_key(opened: Open, address: str) -> None:
    wide, narrow = opened(address), opened(address, width=390, height=844)
    for page in (wide, narrow):
        until_shown(page, 0)
    assert [page.locator("#legend[open]").count() for page in (wide, narrow)] == [1, 0]
    boxes = [wide.locator(one).bounding_box() for one in ("#legend", "#canvas")]
    assert boxes[0] is not None
    assert boxes[1] is not None
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    for page in (wide, narrow):
        page.keyboard.press("k")
    expect(wide.locator("#legend ul")).to_be_hidden()
    expect(narrow.get_by_text("robot a", exact=True)).to_be_visible()
    narrow.locator("#legend summary").press("Enter")
    expect(narrow.locator("#legend ul")).to_be_hidden()


# --- labels and colours ---------------------------------------------------------------------------------


def labels(page: Page) -> dict[str, list[float]]:
    """Return the labels of the plane and their boxes."""
    picture(page)
    return {one["text"]: one["box"] for one in page.evaluate("document.getElementById('canvas').labels")}


@pytest.mark.long
def test_both_first_distances_have_labels_and_no_name_lies_on_the_line_between_robots(
    opened: Open, address: str
) -> None:
    page = opened(address, tick=0)
    assert {"2.68 m", "1.36 m"} <= labels(page).keys()
    for tick in (46, 47, 48):
        page.evaluate(f"location.hash = 'tick={tick}'")
        until_shown(page, tick)
        names = labels(page)
        targets = page.evaluate("document.getElementById('canvas').targets")
        (ax, ay), (bx, by) = [one["at"] for one in targets if one["kind"] == "robot"]
        for k in range(21):
            x, y = ax + k / 20 * (bx - ax), ay + k / 20 * (by - ay)
            for name in "ab":
                left, top, right, bottom = names[name]
                assert not (left < x < right and top < y < bottom), (tick, name)


@pytest.mark.long
def test_the_label_of_a_mutual_distance_goes_as_soon_as_the_robots_drive_on(
    opened: Open, address: str
) -> None:
    page = opened(f"{address}#tick=46")
    texts = "document.getElementById('canvas').labels.map(({ text }) => text)"
    labelled = ["2.95 m" in page.evaluate(texts) for shown in story_from(page, 46) if shown["tick"] == "46"]
    assert labelled[0]
    assert not labelled[-1]
    assert labelled == sorted(labelled, reverse=True)


@pytest.mark.long
def test_the_phase_of_a_planner_of_the_user_is_a_number(opened: Open, tmp_path: Path) -> None:
    run_mission(setting("paper-1", planner="tests.own_planners:Wrapping").scenario, tmp_path)
    with watching(tmp_path) as (_, found):
        page = opened(found, tick=8)
        expect(page.locator(".card[data-robot=a] .phase")).to_have_text("phase 2")
        expect(page.locator(".card[data-robot=a]")).to_contain_text("a: radial")
        expect(page.locator("#legend")).to_contain_text("path, phase 1")
        for words in ("near anchor", "search", "own anchor"):
            expect(page.locator("#mission")).not_to_contain_text(words)


STROKES = """() => new Promise((drawn) => {
  const strokes = [], { stroke } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.stroke = function (path) {
    if (path) strokes.push(`${this.strokeStyle} ${this.globalAlpha.toFixed(2)}`);
    return path ? stroke.call(this, path) : stroke.call(this);
  };
  document.getElementById('canvas').dispatchEvent(new WheelEvent('wheel', { deltaY: 1 }));
  requestAnimationFrame(() => requestAnimationFrame(() => {
    CanvasRenderingContext2D.prototype.stroke = stroke;
    drawn(strokes);
  }));
})"""
"""A function of the page that draws again, and returns colour and opacity of each piece of a trail."""


@pytest.mark.long
def test_all_seven_copies_of_a_path_have_the_colour_of_its_robot(opened: Open, address: str) -> None:
    page = opened(address, tick=5)
    picture(page)
    strokes = Counter(page.evaluate(STROKES))
    light = (PAGE / "style.css").read_text("utf-8").split("@media")[0]
    hues = dict(re.findall(r"--robot-([ab]): (#[0-9a-f]{6});", light))
    pieces = {robot: strokes[f"{hue} 0.95"] for robot, hue in hues.items()}
    assert min(pieces.values()) > 0
    assert {robot: strokes[f"{hue} 0.35"] for robot, hue in hues.items()} == {
        robot: 7 * count for robot, count in pieces.items()
    }


SEEN = {
    "all cones": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "deuteranopia": ((0.367, 0.861, -0.228), (0.280, 0.673, 0.047), (-0.012, 0.043, 0.969)),
    "protanopia": ((0.152, 1.053, -0.205), (0.115, 0.786, 0.099), (-0.004, -0.048, 1.052)),
}
"""The matrices from linear red, green and blue to those perceived (Machado et al. 2009, severity 1)."""
LEAST_DIFFERENCE = 20.0
"""The least difference of two colours in CIELAB; from about 10 on, they are told apart at a glance."""


def lab(colour: str, seen: tuple[tuple[float, ...], ...]) -> tuple[float, float, float]:
    """Return a colour in CIELAB, as one sees it whose sight is `seen`."""
    parts = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    r, g, b = (max(sum(m * part for m, part in zip(row, linear, strict=True)), 0.0) for row in seen)
    white = (0.9505, 1.0, 1.089)
    xyz = (
        0.4124 * r + 0.3576 * g + 0.1805 * b,
        0.2126 * r + 0.7152 * g + 0.0722 * b,
        0.0193 * r + 0.1192 * g + 0.9505 * b,
    )
    x, y, z = (
        (one / of) ** (1 / 3) if one / of > 0.008856 else 7.787 * one / of + 16 / 116
        for one, of in zip(xyz, white, strict=True)
    )
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


@pytest.mark.parametrize("seen", SEEN)
def test_configurations_differ_in_colour_also_for_the_colour_blind(seen: str) -> None:
    themes = (PAGE / "style.css").read_text("utf-8").split("@media (prefers-color-scheme: dark)")
    for theme in themes[0], themes[1].split("box-sizing")[0]:
        tints = dict(re.findall(r"--tint-([1-4]): (#[0-9a-f]{6});", theme))
        for one, other in combinations(tints, 2):
            pairs = zip(lab(tints[one], SEEN[seen]), lab(tints[other], SEEN[seen]), strict=True)
            assert sum((a - b) ** 2 for a, b in pairs) > LEAST_DIFFERENCE**2, (one, other)
