"""The charts of the page, and the series that they draw."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from compose.launch.in_process import run_mission
from compose.recording.recording_files import WORLD_JOURNAL
from compose.recording.run import Run, read
from compose.scenario.scenario_file import load
from compose.view import series as series_module
from compose.view.recorded import run_data, scenes_of
from compose.view.series import MOST_BINS, Curve, Series, series
from protocol.journal import journal_file
from protocol.journal.journal_file import Journal
from protocol.messages import Command, Estimate, Observation
from protocol.mission import Anchor
from tests.browser import BOUND_MS, Open, chromium_only, scrub_to, shot, until_loaded, until_shown, watching
from tests.commands import BENT, tandem
from tests.series import series as cases
from tests.test_accessibility import violations
from tests.test_page import frames_to

CHARTS = "#strips canvas + canvas"
"""The canvas with the cursor, which takes the pointer and has the values as its label."""
INSET = (54, 8)
"""The space left and right of the curves in their column, in pixels."""
DRAWN = """(canvas) => {
  const style = getComputedStyle(document.documentElement);
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  return ['robot-a', 'robot-b', 'link'].map((name) => {
    const hex = style.getPropertyValue('--' + name).trim();
    const hue = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
    let count = 0;
    for (let i = 0; i < data.length; i += 4) {
      if (hue.every((part, k) => Math.abs(data[i + k] - part) < 12)) count += 1;
    }
    return count;
  });
}"""
"""Returns the number of pixels in the hues of a and b, and of ranges between them."""


@pytest.fixture(scope="module")
def served(noisy: Path) -> Iterator[str]:
    """Yield the address of the page on the recording of noisy."""
    with watching(noisy) as (_, found):
        yield found


def series_of(run: Run) -> Series:
    """Return the series of all ticks and robots of a run."""
    assert run.setup is not None
    return series(run.setup, run_data(run))


def estimates(run: Run, robot: str) -> dict[int, Estimate]:
    """Return the estimates in the journal of `robot`, by tick."""
    messages = run.journals[f"agent-{robot}.journal"].messages
    return {one.tick: one for one in messages if isinstance(one, Estimate)}


def first_held(noisy: Path) -> tuple[int, int]:
    """Return the first tick in which robot a has poses in <W>, and their number."""
    held = {tick: len(one.world) for tick, one in estimates(read(noisy), "a").items() if one.world}
    return next(iter(held.items()))


# --- the series -------------------------------------------------------------------------------------


def test_the_values_of_a_series_are_those_of_the_run(noisy: Path) -> None:
    run = read(noisy)
    found = series_of(run)
    assert (found.first, found.last, found.step, found.exact) == (0, run.length - 1, 1, False)
    assert tuple([one.robot for one in found.robots]) == run.robots
    for of_robot in found.robots:
        held, truth, curves = estimates(run, of_robot.robot), run.truth(of_robot.robot), of_robot.curves
        for tick in range(run.length):
            at = {name: curve.low[tick] for name, curve in curves.items()}
            assert at == {name: curve.high[tick] for name, curve in curves.items()}
            observation, contact = run.observations[tick][of_robot.robot], run.contact(of_robot.robot, tick)
            assert at["anchor_range_m"] == observation.anchor_range
            assert at["mutual_range_m"] == (contact.range if contact is not None else None)
            one = held[tick]
            assert at["hypotheses"] == len(one.world or one.local)
            if one.world:
                assert one.covariance is not None
                off = [math.hypot(pose.x - truth[tick].x, pose.y - truth[tick].y) for pose in one.world]
                error = off[0] if one.probabilities[0] > 0.5 else max(off)
                assert at["position_error_m"] == pytest.approx(error, abs=1e-12)
                assert at["position_bound_m"] == 3.0 * one.covariance.position_sigma
                assert at["probability"] == one.probabilities[0]
            else:
                assert at["position_error_m"] is at["position_bound_m"] is None


def test_residuals_are_the_ranges_less_those_of_the_first_poses(noisy: Path) -> None:
    """A range between robots is compared with the distance between the leading poses of both."""
    run = read(noisy)
    assert run.setup is not None
    held = {robot: estimates(run, robot) for robot in run.robots}
    known_mutual = 0
    for of_robot in series_of(run).robots:
        setup = run.setup.robot_setup(of_robot.robot)
        assert setup.peer is not None
        for tick in range(run.length):
            one, peer = held[of_robot.robot][tick], held[setup.peer][tick]
            measured = run.observations[tick][of_robot.robot].anchor_range
            residual = of_robot.curves["anchor_residual_m"].low[tick]
            poses, origin = (one.world, setup.anchor) if one.world else (one.local, Anchor(0.0, 0.0))
            assert (residual is None) == (measured is None or not poses)
            if residual is not None and measured is not None:
                expected = math.hypot(poses[0].x - origin.x, poses[0].y - origin.y)
                assert residual == pytest.approx(measured - expected, abs=1e-12)
            contact, mutual = (
                run.contact(of_robot.robot, tick),
                of_robot.curves["mutual_residual_m"].low[tick],
            )
            lead = all(belief.world and belief.probabilities[0] > 0.5 for belief in (one, peer))
            assert (mutual is None) == (contact is None or contact.range is None or not lead)
            if mutual is not None and contact is not None and contact.range is not None:
                apart = math.hypot(one.world[0].x - peer.world[0].x, one.world[0].y - peer.world[0].y)
                assert mutual == pytest.approx(contact.range - apart, abs=1e-12)
                known_mutual += 1
    assert known_mutual > 4


def test_no_peak_is_lost_in_a_series_of_few_bins(noisy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = series_of(read(noisy))
    monkeypatch.setattr(series_module, "MOST_BINS", 5)
    coarse = series_of(read(noisy))
    assert coarse.step == math.ceil((whole.last + 1) / 5)
    for fine, of_robot in zip(whole.robots, coarse.robots, strict=True):
        assert fine.curves.keys() == of_robot.curves.keys()
        for name, curve in of_robot.curves.items():
            assert len(curve.low) <= 5
            for i, (low, high) in enumerate(zip(curve.low, curve.high, strict=True)):
                values = known(fine.curves[name], i * coarse.step, coarse.step)
                assert (low, high) == (min(values, default=None), max(values, default=None))


def known(curve: Curve, first: int, count: int) -> list[float]:
    """Return the known values of a curve with one tick in each bin."""
    return [value for value in curve.low[first : first + count] if value is not None]


def test_a_series_has_at_most_1000_points_and_no_sigma_of_exact_sensors(paper_1: Path) -> None:
    run = read(paper_1)
    assert run.setup is not None
    assert MOST_BINS <= 500
    of_b = series(run.setup, run_data(run), ["b"])
    assert (of_b.first, of_b.last, of_b.exact) == (0, run.length - 1, True)
    assert [one.robot for one in of_b.robots] == ["b"]
    assert "position_bound_m" not in of_b.robots[0].curves
    errors = of_b.robots[0].curves["position_error_m"].high
    largest = max(error for error in errors if error is not None)
    assert largest > 1.0, "of equally probable poses, the error is that of the farthest"
    assert errors[-1] == pytest.approx(0.0, abs=1e-6)


# --- the page ---------------------------------------------------------------------------------------


def at_tick(page: Page, tick: int, last: float) -> tuple[float, float]:
    """Return the place of `tick` in the first strip, which shows the ticks 0 to `last`."""
    box = page.locator(CHARTS).bounding_box()
    assert box is not None
    width = box["width"] / 2 - sum(INSET)
    return INSET[0] + width * tick / last, 40.0


def until_read(page: Page, tick: int) -> None:
    """Wait until the charts have the numbers of `tick`."""
    expect(page.locator(CHARTS)).to_have_attribute("aria-label", re.compile(f"^Tick {tick}. hypotheses"))


@pytest.mark.long
def test_a_click_in_the_charts_goes_to_the_tick_whose_values_it_shows(
    opened: Open, served: str, noisy: Path
) -> None:
    run = read(noisy)
    last = run.length - 1
    page = opened(served, tick=3)
    charts = page.locator(CHARTS)
    expect(charts).to_be_hidden()
    page.keyboard.press("v")
    until_read(page, 3)
    assert min(page.locator("#strips canvas").first.evaluate(DRAWN)) > 100
    tick = next(k for k in range(20, last) if estimates(run, "a")[k].world)
    x, y = at_tick(page, tick, last)
    charts.click(position={"x": x, "y": y})
    until_shown(page, tick)
    one, truth = estimates(run, "a")[tick], run.truth("a")[tick]
    error = math.hypot(one.world[0].x - truth.x, one.world[0].y - truth.y)
    assert one.covariance is not None
    off, sigma = (
        f"{length:.2f} m" if length >= 0.095 else f"{1000.0 * length:.1f} mm"
        for length in (error, 3.0 * one.covariance.position_sigma)
    )
    expect(charts).to_have_attribute("aria-label", re.compile(f"a {off}, a 3 sigma {sigma}"))
    page.locator("#truth").uncheck()
    expect(charts).to_have_attribute(
        "aria-label", re.compile(r"error / 3 sigma: a 3 sigma \d\S+ m, b 3 sigma")
    )
    x, y = at_tick(page, 5, last)
    charts.hover(position={"x": at_tick(page, 8, last)[0], "y": y})
    page.mouse.down()
    until_shown(page, 8)
    charts.hover(position={"x": x, "y": y})
    page.mouse.up()
    until_shown(page, 5)
    shot(page, "charts")


@pytest.mark.long
@pytest.mark.parametrize("look", cases([(False, 1280, 720), (True, 800, 600), (False, 390, 844)]), ids=str)
def test_open_charts_break_no_rule_of_accessibility(
    opened: Open, served: str, look: tuple[bool, int, int]
) -> None:
    dark, width, height = look
    page = opened(served, dark=dark, width=width, height=height)
    scrub_to(page, 20)
    page.locator("#charts summary").click()
    until_read(page, 20)
    assert not violations(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    shot(page, f"charts-{width}")


@chromium_only
@pytest.mark.long
def test_the_page_in_one_file_has_the_charts(browser: Browser, noisy: Path, tmp_path: Path) -> None:
    assert tandem("export", noisy, "--html", "--out", tmp_path).status == 0
    kept = (tmp_path / "run.html").read_text("utf-8").split('id="recording">')[1].split("</script>")[0]
    curves = json.loads(kept)["series"]["robots"][0]["curves"]
    tick, held = first_held(noisy)
    assert curves["hypotheses"]["low"][tick] == held
    page = browser.new_page()
    page.set_default_timeout(BOUND_MS)
    page.goto(f"{(tmp_path / 'run.html').as_uri()}#tick={tick}")
    until_shown(page, tick)
    page.keyboard.press("v")
    until_read(page, tick)
    page.close()


@pytest.mark.long
def test_a_mission_with_exact_sensors_says_that_it_has_no_sigma(opened: Open, address: str) -> None:
    page = opened(address, tick=47)
    page.keyboard.press("v")
    until_read(page, 47)
    expect(page.locator(CHARTS)).to_have_attribute(
        "aria-label", re.compile(r"a 25 %, b 25 %\. error / 3 sigma: a 9\.03 m")
    )
    expect(page.locator(CHARTS)).not_to_have_attribute("aria-label", re.compile(r"sigma \d"))


@pytest.mark.long
def test_the_charts_follow_a_mission_while_it_runs(opened: Open, noisy: Path, tmp_path: Path) -> None:
    whole = {path.name: list(journal_file.read(path)) for path in noisy.glob("*.journal")}
    written = dict.fromkeys(whole, 0)
    with ExitStack() as stack:
        growing = {name: stack.enter_context(Journal(tmp_path / name)) for name in whole}

        def grow(tick: int) -> None:
            """Write the journals up to the Commands of tick `tick`."""
            for name in whole:
                first = Command if name == WORLD_JOURNAL else Observation
                goal = frames_to(noisy / name, tick + 1, first)
                growing[name].write(*whole[name][written[name] : goal])
                written[name] = goal

        tick, _ = first_held(noisy)
        grow(tick)
        _, where = stack.enter_context(watching(tmp_path))
        page = opened(where)
        until_loaded(page)
        page.keyboard.press("v")
        for now in (tick, tick + 3, tick + 5):
            grow(now)
            held = estimates(read(noisy), "a")[now]
            label = re.compile(f"^Tick {now}. hypotheses: a {len(held.world)}, ")
            expect(page.locator(CHARTS)).to_have_attribute("aria-label", label)
            expect(page.locator("#status")).to_contain_text("running")


@pytest.mark.long
def test_a_position_whose_sigma_is_large_is_drawn_along_its_arc(opened: Open, tmp_path: Path) -> None:
    run_mission(load("noisy", seed=BENT), tmp_path)
    shown = scenes_of(read(tmp_path))
    bent = [scene.tick for scene in shown if all(player.held and player.held.arc for player in scene.players)]
    with watching(tmp_path) as (_, served):
        page = opened(served)
        legend = page.locator("#legend")
        scrub_to(page, bent[0])
        expect(legend).to_contain_text("uncertainty (3 sigma): along an arc")
        assert len(legend.get_by_text("uncertainty (3 sigma)").all()) == 1  # and no ellipse
        scrub_to(page, shown[-1].tick)
        expect(legend).not_to_contain_text("along an arc")
