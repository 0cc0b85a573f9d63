"""A verdict is given once, and a robot that gives up does not keep its peer waiting."""

from __future__ import annotations

from msgspec.structs import replace

from agent import planner
from compose.inline import play
from compose.scenario import parse, shipped
from protocol.messages import Localised, Undecided
from protocol.motion import ORIGIN
from tests.steps import steps
from world.referee import Judgement, judge
from world.tick import World, advance

GAVE_UP = Undecided("no pose explains the anchor ranges")


def test_the_mission_ends_when_one_of_a_pair_has_given_up() -> None:
    world = next(steps("paper-1")).world
    judgement = judge(world.scenario, world.truth, {"a": GAVE_UP})
    assert judgement == Judgement("undecided", f"a: {GAVE_UP.reason}")
    assert judge(world.scenario, world.truth, {}) is None


def test_a_robot_whose_peer_has_given_up_gives_up_too() -> None:
    met = next(step for step in steps("paper-1") if step.heard["a"])
    told = [replace(report, verdict=GAVE_UP) for report in met.heard["a"]]
    verdict = planner.decide(met.observed["a"], told).verdict
    assert verdict == Undecided(f"b says: {GAVE_UP.reason}")


def test_a_reason_handed_on_stays_within_what_a_message_can_hold() -> None:
    met = next(step for step in steps("paper-1") if step.heard["a"])
    told = [replace(report, verdict=Undecided("x" * 300)) for report in met.heard["a"]]
    verdict = planner.decide(met.observed["a"], told).verdict
    assert isinstance(verdict, Undecided)
    assert len(verdict.reason) == 300


def test_a_wrong_claim_cannot_be_taken_back() -> None:
    step = next(steps("paper-1"))
    claim = replace(step.drives["a"], verdict=Localised(replace(ORIGIN, x=5.0)))
    world = advance(step.world, step.drives | {"a": claim})
    assert isinstance(world, World)
    world = advance(world, step.drives)
    assert isinstance(world, World)
    judgement = judge(world.scenario, world.truth, world.verdicts | {"b": GAVE_UP})
    assert judgement is not None
    assert judgement.outcome == "wrong"


def test_the_letter_gives_up_where_the_third_mutual_range_settles_nothing() -> None:
    """b drove its one last manoeuvre; a, which the paper has stand, stands."""
    text = f'{shipped()["random"].read_text()}\n[planner]\nvariant = "paper"\n'
    record = play(parse(text, "random", seed=441))
    assert record.end is not None
    assert record.end.outcome == "undecided"
    assert record.end.reason == "b: the third mutual range does not settle where they are"
    states = [(moment.drives["a"].state, moment.drives["b"].state) for moment in record.moments]
    assert states[-3:] == [("straight", "standing"), ("waiting", "last-manoeuvre"), ("waiting", "undecided")]
