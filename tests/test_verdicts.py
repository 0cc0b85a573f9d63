"""A verdict is sent once, and a robot that gives up does not delay its peer."""

from __future__ import annotations

import time
from collections.abc import Sequence

import pytest
from msgspec.structs import replace

from agent.estimation import precision
from compose.launch.in_process import run_mission
from compose.recording.reasons import reason_for
from compose.scenario.scenario_file import parse
from compose.scenario.shipped_files import shipped
from protocol.messages import Command, Localised, MissionEnd, TickStart, Undecided
from protocol.motion import ORIGIN, Covariance
from tests.steps import planner_of, steps
from tests.surveys import scenario_of
from tests.test_claims import EXACT, NOISY
from world.hardware.termination import LAST_WORDS, Ending
from world.referee import decide_outcome, inaccuracy
from world.tick import World, advance, release

GAVE_UP = Undecided("no pose explains the anchor ranges")


def test_the_mission_ends_when_one_of_a_pair_has_given_up() -> None:
    world = next(steps("paper-1")).world
    end = decide_outcome(world.scenario, world.truth, {"a": GAVE_UP})
    assert end is not None
    assert (end.outcome, reason_for(end)) == ("undecided", f"a: {GAVE_UP.reason}")
    assert decide_outcome(world.scenario, world.truth, {}) is None


def test_a_robot_whose_peer_has_given_up_gives_up_too() -> None:
    met = next(step for step in steps("paper-1") if step.heard["a"])
    told = [replace(report, verdict=GAVE_UP) for report in met.heard["a"]]
    verdict = planner_of(met.observed["a"]).decide(met.observed["a"], told).verdict
    assert verdict == Undecided(f"b reports: {GAVE_UP.reason}")


def test_a_forwarded_reason_fits_a_message() -> None:
    met = next(step for step in steps("paper-1") if step.heard["a"])
    told = [replace(report, verdict=Undecided("x" * 300)) for report in met.heard["a"]]
    verdict = planner_of(met.observed["a"]).decide(met.observed["a"], told).verdict
    assert isinstance(verdict, Undecided)
    assert len(verdict.reason) == 300


def test_a_wrong_claim_cannot_be_taken_back() -> None:
    step = next(steps("paper-1"))
    claim = replace(step.commands["a"], verdict=Localised(replace(ORIGIN, x=5.0)))
    world = advance(step.world, step.commands | {"a": claim})
    assert isinstance(world, World)
    world = advance(world, step.commands)
    assert isinstance(world, World)
    end = decide_outcome(world.scenario, world.truth, world.verdicts | {"b": GAVE_UP})
    assert end is not None
    assert end.outcome == "wrong"


def test_the_paper_planner_gives_up_if_the_third_mutual_range_selects_no_placement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """b has driven its last manoeuvre, and a stops, as in the paper. No placement is well determined here."""
    monkeypatch.setattr(precision, "pinned_down", lambda *_: False)
    text = f'{shipped()["random"].read_text()}\n[planner]\nname = "paper"\n'
    recording = run_mission(parse(text, "random", seed=441))
    assert recording.end is not None
    assert recording.end.outcome == "undecided"
    assert reason_for(recording.end) == "b: the third mutual range does not select a placement"
    states = [(moment.commands["a"].task, moment.commands["b"].task) for moment in recording.ticks]
    assert states[-3:] == [("straight", "standing"), ("waiting", "last-manoeuvre"), ("waiting", "undecided")]


# --- the accuracy of claims -----------------------------------------------------------------------------


def covariance(position: float, heading: float) -> Covariance:
    """Return the covariance for these sigmas of position and heading, in m and rad."""
    return Covariance(position**2 / 2.0, 0.0, 0.0, position**2 / 2.0, 0.0, heading**2)


def after_claims(text: str, a: Covariance | None, *, off: float = 0.0) -> MissionEnd | World:
    """Return the result of immediate claims of both; that of a is `off` by metres, with covariance `a`."""
    world = release(parse(text, "noisy", seed=1))
    there, other = world.truth.poses
    claim = Localised(replace(there, x=there.x + off), a)
    return advance(
        world,
        {
            "a": Command(0, "a", 0.0, 0.0, 3, "localised", claim),
            "b": Command(0, "b", 0.0, 0.0, 3, "localised", Localised(other)),
        },
    )


@pytest.mark.parametrize(
    ("position", "heading", "what"),
    [
        (0.0999, 0.199, None),
        (0.101, 0.01, "a claims a position known to 0.101 m, required 0.1"),
        (0.01, 0.201, "a claims a heading known to 0.201 rad, required 0.2"),
        (4.5e7, 0.01, "a claims a position known to 4.5e+07 m, required 0.1"),
        (3e7, 3e7, "a claims a position known to 3e+07 m, required 0.1"),
    ],
)
def test_a_claim_below_the_required_accuracy_is_not_localised(
    position: float, heading: float, what: str | None
) -> None:
    end = after_claims(NOISY, covariance(position, heading))
    assert isinstance(end, MissionEnd)
    assert (end.outcome, reason_for(end)) == ("localised" if what is None else "undecided", what)


def test_no_sigma_excuses_a_claim_that_is_farther_off_than_the_accuracy_allows() -> None:
    """The limit is five times the accuracy of 0.1 m, or 1e-6 m with exact sensors."""
    huge = covariance(4.5e7, 3.0)
    for text, far, near in ((NOISY, 0.501, 0.499), (EXACT, 2e-6, 1e-7)):
        wrong, vague = after_claims(text, huge, off=far), after_claims(text, huge, off=near)
        assert isinstance(wrong, MissionEnd)
        assert isinstance(vague, MissionEnd)
        assert (wrong.outcome, vague.outcome) == ("wrong", "undecided")


@pytest.mark.parametrize("whose", ["its own", "its peer's"])
def test_a_claim_below_the_required_accuracy_is_not_localised_in_hardware_mode(whose: str) -> None:
    config = parse(NOISY, "noisy", seed=1).config("a")
    good, vague = (Localised(ORIGIN, covariance(sigma, 0.01)) for sigma in (0.05, 4.5e7))
    own, peers = (vague, good) if whose == "its own" else (good, vague)
    for mine, other, outcome in ((own, peers, "undecided"), (good, good, "localised")):
        ending = Ending(config, 100, 30.0, time.monotonic)
        ending.receive(TickStart(0, "b", other, complete=True))
        command = Command(0, "a", 0.0, 0.0, 3, "localised", mine)
        ends = []
        for tick in range(LAST_WORDS + 1):
            ending.tick_start(tick)
            ends.append(ending.after(tick, command))
        assert ends[-1] is not None
        assert ends[-1].outcome == outcome


def honest_claims(planner_name: str, sigma: float, seeds: Sequence[int], outliers: float) -> int:
    """Return the number of claims of honest robots under this noise, and check their accuracy."""
    claims = 0
    for seed in seeds:
        noise = f"anchor_sigma = {sigma}\nmutual_sigma = {sigma}\noutliers = {outliers}"
        recording = run_mission(scenario_of(noise, seed, planner_name=planner_name))
        assert recording.end is not None
        mission = recording.scenario.mission
        for moment in recording.ticks:
            for command in moment.commands.values():
                if isinstance(command.verdict, Localised):
                    claims += 1
                    assert inaccuracy(command.robot, command.verdict, mission) is None, (sigma, seed)
        assert "claims a" not in (reason_for(recording.end) or ""), (sigma, seed, recording.end)
    return claims


@pytest.mark.long
@pytest.mark.parametrize("outliers", [0.0, 0.05])
@pytest.mark.parametrize("planner_name", ["paper", "assured"])
def test_every_claim_of_many_noisy_missions_has_the_required_accuracy(
    planner_name: str, outliers: float
) -> None:
    for sigma in (0.001, 0.01, 0.05, 0.1):
        found = honest_claims(planner_name, sigma, range(5), outliers)
        assert found > 0 or planner_name == "paper"
