"""Drawings of the page over the plane: configurations with the distances that they predict, and attacks."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace
from playwright.sync_api import expect

from compose.launch import in_process
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.view.recorded import scenes, scenes_of
from compose.view.scene import Scene
from compose.view.web.server import SCENES_TOLD, news_events
from compose.view.web.site import of_folder
from compose.view.web.sources import Recorded
from compose.view.web.standalone import PAGE
from protocol.attack import Attack
from protocol.messages import Inconsistent
from protocol.motion import travelled
from tests.browser import INKS, Open, inks, picture, scrub_to, stop_clock, until_shown, watching
from tests.commands import BOUND_S, copied

STEP_MS = 250


# --- tints --------------------------------------------------------------------------------------------


def test_tints_circles_and_orbits_stand_out_in_both_themes() -> None:
    themes = (PAGE / "style.css").read_text("utf-8").split("@media (prefers-color-scheme: dark)")
    for theme in themes[0], themes[1].split("box-sizing")[0]:
        colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", theme))
        assert min(contrast(colours[f"tint-{i}"], colours["paper"]) for i in range(1, 7)) > 4.5
        assert contrast(colours["faint"], colours["soft"]) > 4.5
        assert min(contrast(colours[name], colours["paper"]) for name in ("ring", "orbit")) > 3.0


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours, as WCAG defines it."""
    dark, light = sorted([luminance(one), luminance(other)])
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour, as WCAG defines it."""
    parts = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.long
def test_a_first_range_is_a_circle_on_which_the_robot_may_be(opened: Open, address: str) -> None:
    page = opened(address, tick=0)
    first = inks(page)["ghost"]
    page.evaluate("location.hash = 'tick=3'")
    until_shown(page, 3)  # a has no range here, and b knows its path
    assert first > 300 > inks(page)["ghost"]


@pytest.mark.long
def test_each_configuration_of_paper_1_has_its_tint_and_the_last_one_keeps_it(
    opened: Open, address: str
) -> None:
    page = opened(f"{address}#tick=46")
    shown = {}
    for tick in (46, 47, 48):
        scrub_to(page, tick)
        drawn = inks(page)
        shown[tick] = [drawn[f"tint-{i}"] > 60 for i in range(1, 5)]
    assert shown == {46: [False] * 4, 47: [True] * 4, 48: [True, False, False, False]}


TINTS = """async (ticks) => {
  const { Tints } = await import('/page/tints.js');
  const scenes = ticks.map(([a, b], tick) => ({
    tick, configurations: [{ robots: ['a', 'b'], count: a.length }],
    players: [a, b].map((world) => ({ executed: [1, 0], held: { world: world.map(([x, y]) => [x, y, 0]) } })),
  }));
  const store = {
    first: 0, whole: scenes.length, scene: (tick) => scenes[tick],
    stage: { mission: { period: 1, sensing_range: 3 } },
    player: (tick, robot) => scenes[tick].players['ab'.indexOf(robot)],
  };
  return scenes.map((_, tick) => new Tints().of(store, tick, 'b'));
}"""


@pytest.mark.long
def test_a_configuration_keeps_its_tint_though_its_place_changes(opened: Open, address: str) -> None:
    """Each robot drives 1 m along x; under noise, the order is that of the probabilities."""
    far = [5, 5]
    ticks = [
        [[[0, 0], far], [[1, 1], [6, 6]]],
        [[[6, 5], [1.1, 0]], [[7, 6], [2, 1]]],
        [[[2.1, 0], [0, -5], [7, 5]], [[3, 1], [0, -4], [8, 6]]],
        [[[8, 5]], [[9, 6]]],
    ]
    assert opened(address).evaluate(TINTS, ticks) == [[0, 1], [1, 0], [0, 2, 1], [1]]


# --- predicted distances ------------------------------------------------------------------------------


@pytest.mark.long
def test_the_predicted_distances_and_their_least_difference_are_listed(opened: Open, address: str) -> None:
    page = opened(address, tick=47)
    listed = page.locator("#predictions li")
    expect(listed).to_have_text(
        [
            "predicted",
            "1: 2.39 m",
            "2: 2.75 m",
            "3: 1.14 m",
            "4: 3.06 m",
            "nearest two differ by 0.31 m",
            "J over turn rate: 1.80\u00a0m² at +0.91 rad/s "
            "J over the turn rate from \N{MINUS SIGN}3.1 to 3.1 rad/s; chosen: +0.91 rad/s, 1.80 m²",
        ]
    )
    page.keyboard.press("ArrowLeft")
    expect(page.locator("#predictions")).to_be_hidden()


@pytest.mark.long
def test_the_measured_range_rules_configurations_out_one_by_one_the_worst_first(
    opened: Open, address: str
) -> None:
    page = opened(address, tick=47)
    stop_clock(page)
    page.keyboard.press("Space")
    out: list[list[str]] = []
    for _ in range(200):
        page.clock.fast_forward(STEP_MS)
        found = page.locator("#predictions .out").all_text_contents()
        if not out or out[-1] != found:
            out.append(found)
        if len(found) == 3:
            break
    assert [len(found) for found in out] == [0, 1, 2, 3]
    assert out[1] == ["3: 1.14 m"]
    assert out[2] == ["3: 1.14 m", "4: 3.06 m"]
    expect(page.locator("#predictions .measured")).to_have_text("measured 2.39 m")


@pytest.mark.long
def test_the_predicted_distances_are_circles_while_the_robot_drives(opened: Open, address: str) -> None:
    page = opened(address, tick=47)
    tints = [f"tint-{i}" for i in range(1, 5)]
    before = inks(page)
    stop_clock(page)
    page.keyboard.press("Space")
    most = dict(before)
    while page.locator("body").get_attribute("data-tick") == "47":
        page.clock.fast_forward(STEP_MS)
        drawn = page.evaluate(INKS)
        most = {name: max(most[name], drawn[name]) for name in most}
    assert all(most[tint] > before[tint] + 200 for tint in tints)


HALVED = Attack("scale", 0.5, "orbit")
LABELS = "document.getElementById('canvas').labels.map((one) => one.text)"


def scenes_with(folder: Path, attack: Attack | None, name: str) -> tuple[Scene, ...]:
    """Return the scenes of a mission whose robot a has `attack`, recorded in `folder`."""
    scenario = load(name)
    a, *others = scenario.robots
    in_process.run_mission(replace(scenario, robots=(replace(a, attack=attack), *others)), folder)
    return scenes_of(read(folder))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("attacked")
    scenes_with(folder, HALVED, "random")
    return folder


@pytest.fixture(scope="module")
def attacked_address(recording: Path) -> Iterator[str]:
    with watching(recording) as (_, found):
        yield found


# --- scenes -------------------------------------------------------------------------------------------


def test_the_reported_path_has_half_the_speed_in_orbit_and_its_gap_is_the_distance_to_the_true_one(
    recording: Path,
) -> None:
    shown = scenes_of(read(recording))
    players = [scene.player("a") for scene in shown]
    assert all(one.reported is not None for one in players)
    assert max(one.reported.gap for one in players if one.reported) > 1.0
    for earlier, now in pairwise(players):
        assert earlier.pose
        assert earlier.reported
        assert now.pose
        assert now.reported
        assert now.reported.gap == travelled(now.pose, now.reported.pose)
        factor = 0.5 if earlier.command and earlier.command.phase == 2 else 1.0
        driven = travelled(earlier.pose, now.pose)
        assert travelled(earlier.reported.pose, now.reported.pose) == pytest.approx(factor * driven, abs=1e-9)
    assert all(scene.player("b").reported is None for scene in shown)


@pytest.mark.parametrize("attack", [Attack("radius", 0.3), Attack("heading", 0.2)], ids=lambda one: one.kind)
def test_the_reported_path_begins_at_the_start_that_the_attacker_reports(
    attack: Attack, tmp_path: Path
) -> None:
    first = scenes_with(tmp_path, attack, "paper-1")[0].player("a")
    assert first.pose
    assert first.reported
    assert first.reported.gap == pytest.approx(0.3 if attack.kind == "radius" else 0.0, abs=1e-9)
    turned = first.reported.pose.heading - first.pose.heading
    assert (turned % 6.283185307179586) == pytest.approx(0.0 if attack.kind == "radius" else 0.2, abs=1e-9)


def test_an_honest_scene_has_no_reported_pose_on_the_wire(paper_1: Path, recording: Path) -> None:
    honest, false = (msgspec.json.encode(scenes_of(read(folder))) for folder in (paper_1, recording))
    assert b'"reported":' in false
    assert b'"reported":' not in honest


def test_without_the_ground_truth_nothing_is_known_to_be_false(recording: Path, tmp_path: Path) -> None:
    copied(recording, tmp_path, "agent-a.journal", "agent-b.journal")
    journals = Recorded("", tmp_path)
    journals.load()
    assert journals.setup is not None
    assert journals.known.reported_logs["a"].through > 0
    shown = scenes(journals.setup, journals.known)
    assert all(player.reported is None for scene in shown for player in scene.players)


def test_what_an_attack_cost_arrives_with_the_scene_that_tells_it(recording: Path) -> None:
    """The update that the server sends has both: without the scene, the page shows none until it asks."""

    async def told() -> dict[str, Any]:
        site = of_folder(recording)
        (show,) = site.shows.values()
        news = news_events(site, show.name, show.version)
        await anext(news)
        show.known.add_costs(["Believed, a would be 4.40 m off."])
        show.revised()
        return dict(json.loads((await anext(news)).removeprefix(b"data: "))["show"])

    update = asyncio.run(asyncio.wait_for(told(), BOUND_S))
    assert update["from"] == update["last"]
    assert [scene["tick"] for scene in update["scenes"]] == [update["last"]]


@pytest.mark.parametrize(("changed", "scenes_told"), [(SCENES_TOLD, SCENES_TOLD), (SCENES_TOLD + 1, 1)])
def test_the_news_of_a_running_mission_have_the_few_scenes_that_changed_or_the_latest(
    recording: Path, changed: int, scenes_told: int
) -> None:
    async def told() -> dict[str, Any]:
        site = of_folder(recording)
        (show,) = site.shows.values()
        news = news_events(site, show.name, show.version)
        await anext(news)
        show.live = True
        show.known.at(show.known.last - changed + 1)
        show.revised()
        return dict(json.loads((await anext(news)).removeprefix(b"data: "))["show"])

    update = asyncio.run(asyncio.wait_for(told(), BOUND_S))
    assert update["from"] == update["last"] - changed + 1
    ticks = [scene["tick"] for scene in update["scenes"]]
    assert ticks == list(range(update["last"] - scenes_told + 1, update["last"] + 1))


# --- the page -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_card_names_the_gap_once_and_only_with_the_truth(
    opened: Open, recording: Path, attacked_address: str
) -> None:
    shown = scenes_of(read(recording))
    commands = [scene.player("b").command for scene in shown]
    verdicts = [command.verdict if command else None for command in commands]
    rejected = next(tick for tick, one in enumerate(verdicts) if isinstance(one, Inconsistent))
    page = opened(attacked_address)
    sentence = page.locator(".card[data-robot=a] .attack")
    scrub_to(page, 0)
    expect(sentence).to_have_text("a has reported its true position so far.")
    for tick in (rejected - 1, rejected):
        scrub_to(page, tick)
        reported = shown[tick].player("a").reported
        assert reported
        gap = f"{reported.gap:.2f} m"
        says = f"a reports a position {gap} from its true one."
        expect(sentence).to_have_text(says)
        picture(page)
        assert f"a reported, {gap} off" in page.evaluate(LABELS)
    expect(page.locator(".card[data-robot=b] .attack")).to_be_hidden()
    page.keyboard.press("t")
    expect(sentence).to_be_hidden()
    picture(page)
    assert not [text for text in page.evaluate(LABELS) if "reported" in text]


@pytest.mark.long
def test_the_path_that_an_attacker_reports_is_drawn_in_the_hue_that_the_legend_gives_it(
    opened: Open, recording: Path, attacked_address: str
) -> None:
    gaps = [one.gap if (one := scene.player("a").reported) else 0.0 for scene in scenes_of(read(recording))]
    begins = next(tick for tick, gap in enumerate(gaps) if gap > 0.1)
    page = opened(attacked_address)
    drawn = {}
    for tick in (begins - 2, len(gaps) - 2):
        scrub_to(page, tick)
        drawn[tick] = inks(page)["fault"]
    honest, false = drawn.values()
    assert honest < 100  # crosses over poses that are ruled out
    assert false > 400
    assert "var(--fault)" in page.locator("#legend li").filter(has_text="path that an attacker").inner_html()
