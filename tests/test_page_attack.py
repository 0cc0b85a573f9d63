"""The attack view: the path that an attacker reports, beside the true one, and what contradicts it."""

from __future__ import annotations

import asyncio
import json
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
from protocol.attack import Attack
from protocol.messages import Inconsistent
from protocol.motion import travelled
from tests.browser import Open, inks, picture, scrub_to, watching
from tests.commands import BOUND_S

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
    for path in recording.glob("agent-*.journal"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
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
