"""A robot of a group in hardware mode: whose ticks it counts, when it ends, and what its driver reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from compose.errors import UserError
from compose.launch.driver_loader import config_of, mission
from compose.recording.reasons import reason_for
from compose.scenario.scenario_file import parse
from protocol.journal.journal_file import CorruptJournal, MemoryJournal, Sink
from protocol.messages import (
    Cause,
    Command,
    Contact,
    Inconsistent,
    Localised,
    MissionEnd,
    Observation,
    RobotConfig,
    TickStart,
    Undecided,
    Verdict,
)
from protocol.motion import ORIGIN, REST
from protocol.network import keys
from protocol.wire import decode, encode
from tests.stage import MANOEUVRE_S, TICK_S, Member, Stage, begins, command
from tests.test_group_field import FAR
from world.hardware.bridge import NoStart
from world.hardware.driver import Reading
from world.hardware.driver_journal import driver_history
from world.hardware.measurements import InvalidReading, observation_frame
from world.hardware.termination import LAST_WORDS, Ending
from world.hardware.tick_source import UNHEARD, TickSource

LOCALISED = Localised(ORIGIN)


def config_in_group(robot: str) -> RobotConfig:
    return config_of(parse(FAR, "four"), robot, MANOEUVRE_S)


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    return Stage(monkeypatch)


def member(
    stage: Stage,
    robot: str,
    max_ticks: int,
    verdict: Verdict | None = None,
    journal: Sink | None = None,
    tolerates: int = 0,
) -> Member:
    """Return a robot of the group on a stage."""
    config = replace(config_in_group(robot), tolerates=tolerates)
    return Member(stage, config, max_ticks, verdict, journal)


# --- whose ticks --------------------------------------------------------------------------------------


def test_each_robot_counts_the_ticks_of_the_first_one_that_it_hears() -> None:
    source, later = TickSource(config_in_group("c"), 1.0), 1.0 + UNHEARD
    assert source.leads("b", 0.0)
    source.hear("a", 7, 1.0)
    source.hear("b", 7, 1.0)
    assert [source.leads(robot, 2.0) for robot in "abd"] == [True, False, False]
    assert [source.leads(robot, later) for robot in "abd"] == [True, True, False]
    assert not source.is_first
    assert TickSource(config_in_group("a"), 1.0).is_first


def test_a_robot_whose_source_falls_silent_counts_the_ticks_of_the_next_one(stage: Stage) -> None:
    """Robot a is dead after tick 4. Until c has missed it, it uses its own clock."""
    c = member(stage, "c", 14)
    stage.alive("a", "b", "c", "d")
    begins(stage, "a", {tick: 0.1 + tick * TICK_S for tick in range(5)})
    late = 0.4 * TICK_S
    begins(stage, "b", {tick: 0.1 + tick * TICK_S + late for tick in range(15)})
    assert c.play().tick == 14
    assert c.times[4] == pytest.approx(0.1 + 4 * TICK_S)
    assert c.times[8] == pytest.approx(0.1 + 8 * TICK_S)
    assert c.times[13] == pytest.approx(0.1 + 13 * TICK_S + late)
    assert c.started() == list(range(15))


def test_a_robot_that_comes_late_catches_up_at_rest_though_it_is_the_first(stage: Stage) -> None:
    """Others do not receive its TickStarts while it is behind, or they would wait for it."""
    a = member(stage, "a", 104)
    stage.alive("a", "c")
    begins(stage, "c", {tick: 0.5 + (tick - 100) * TICK_S for tick in range(100, 105)})
    assert a.play().tick == 104
    assert a.times[100] == pytest.approx(0.5)
    assert a.times[104] == pytest.approx(0.5 + 4 * TICK_S)
    assert a.field.missed == 100
    assert a.started() == [100, 101, 102, 103, 104]


def test_the_first_robot_catches_up_if_it_is_behind_the_others(stage: Stage) -> None:
    """As after a link between two parts of a group that began without each other."""
    a = member(stage, "a", 45)
    stage.alive("a", "b", "c", "d")
    begins(stage, "d", {tick: (tick - 30) * TICK_S + 0.05 for tick in range(33, 46)})
    assert a.play().tick == 45
    assert a.times[45] == pytest.approx(15 * TICK_S + 0.05)
    assert a.times[2] == pytest.approx(2 * TICK_S, abs=0.01)


def test_the_first_robot_does_not_count_the_ticks_of_others(stage: Stage) -> None:
    a = member(stage, "a", 9)
    stage.alive("a", "b", "c", "d")
    begins(stage, "b", {tick: (tick - 1.5) * TICK_S + 0.05 for tick in range(2, 10)})
    a.play()
    assert a.times[9] - a.times[0] == pytest.approx(9 * TICK_S)


def test_a_robot_begins_when_any_other_one_does(stage: Stage) -> None:
    """Here d, whose connection timeout was over first. It is after c in the mission."""
    c = member(stage, "c", 3)
    stage.alive("c", "d")
    begins(stage, "d", {0: 0.5})
    assert c.play().tick == 3
    assert c.times[0] == pytest.approx(0.5)


@pytest.mark.parametrize("robot", ["a", "c"])
def test_a_group_begins_without_those_that_do_not_come(
    robot: str, stage: Stage, capsys: pytest.CaptureFixture[str]
) -> None:
    one = member(stage, robot, 3)
    stage.alive("a", "c")
    assert one.play(2.0).tick == 3
    assert one.times[0] == pytest.approx(2.0)
    assert "b and d: not connected; the mission begins" in capsys.readouterr().err


def test_a_robot_of_a_group_that_is_alone_does_not_begin(stage: Stage) -> None:
    one = member(stage, "b", 3)
    stage.alive("b")
    with pytest.raises(NoStart, match="a and c and d: not connected; no robot has moved"):
        one.play(2.0)
    assert one.driver.commands == []


# --- false TickStarts ---------------------------------------------------------------------------------


def in_step(stage: Stage, robots: str, ticks: int, since: float = 0.1) -> None:
    """Let the drivers of honest `robots` begin tick 0 at the time `since`, one just after the other."""
    for place, robot in enumerate(robots):
        begins(stage, robot, {tick: since + 0.001 * place + tick * TICK_S for tick in range(ticks)})


@pytest.mark.parametrize("robot", ["a", "b", "c"])
@pytest.mark.parametrize("ahead", [1, 3, 20])
def test_a_robot_that_says_it_is_ahead_leads_none_of_those_that_tolerate_it(
    ahead: int, robot: str, stage: Stage
) -> None:
    """Robot d is ahead from before the start on, and ever more."""
    one = member(stage, robot, 30, tolerates=1)
    begins(stage, "d", {ahead * (1 + k): 0.05 + 0.5 * k * TICK_S for k in range(60)})
    stage.comes("alive", keys.robot_alive("r", robot))
    for other in "abcd".replace(robot, ""):
        stage.comes("alive", keys.robot_alive("r", other), after=0.09)
    in_step(stage, "abc".replace(robot, ""), 30)
    assert one.play().tick == 30
    assert one.times[30] - one.times[5] == pytest.approx(25 * TICK_S, rel=0.01)
    assert one.field.missed <= 1
    assert one.started()[-25:] == list(range(6, 31))


@pytest.mark.parametrize("robot", ["b", "c", "d"])
@pytest.mark.parametrize("lasts", [0.2, 0.9, 1.4])
def test_a_first_robot_with_a_false_clock_changes_no_ticks_of_those_that_tolerate_it(
    lasts: float, robot: str, stage: Stage
) -> None:
    """Robot a sends each TickStart twice, and its ticks last too short or too long."""
    one = member(stage, robot, 30, tolerates=1)
    stage.alive("a", "b", "c", "d")
    for repeated in (0.0, 0.1 * TICK_S):
        begins(stage, "a", {tick: 0.1 + repeated + lasts * tick * TICK_S for tick in range(60)})
    in_step(stage, "bcd".replace(robot, ""), 31)
    assert one.play().tick == 30
    assert one.times[30] - one.times[0] == pytest.approx(30 * TICK_S, rel=0.01)
    assert one.field.missed == 0


def test_a_robot_that_was_down_catches_up_with_honest_ones_beside_a_false_one(stage: Stage) -> None:
    b = member(stage, "b", 60, tolerates=1)
    b.field.resume(driver_history([], config_in_group("b"), Path("b")), latest=-1)
    stage.alive("a", "b", "c", "d")
    begins(stage, "a", {tick: 0.05 + (tick - 50) * TICK_S for tick in range(50, 90)})
    for robot in "cd":
        begins(stage, robot, {tick: 0.1 + (tick - 40) * TICK_S for tick in range(40, 61)})
    assert b.play().tick == 60
    assert b.times[60] == pytest.approx(0.1 + 20 * TICK_S, abs=0.1 * TICK_S)
    assert b.field.missed <= 43


def test_a_robot_that_is_ahead_of_all_others_waits_for_them_in_a_group_that_tolerates_false_ones(
    stage: Stage,
) -> None:
    a = member(stage, "a", 20, tolerates=1)
    stage.alive("a", "b", "c", "d")
    in_step(stage, "bcd", 20, since=1.5 * TICK_S)
    a.play()
    assert a.times[18] == pytest.approx(19.5 * TICK_S, abs=0.1 * TICK_S)


def test_a_first_robot_that_repeats_a_tick_start_delays_others_for_a_bounded_time(stage: Stage) -> None:
    c = member(stage, "c", 9)
    stage.alive("a", "b", "c", "d")
    begins(stage, "a", {tick: 0.1 + tick * TICK_S for tick in range(4)})
    repeated = encode(TickStart(3, "a"))
    for half in range(200):
        stage.comes("tick-start", keys.tick_start("r", "a"), repeated, (4 + half / 2) * TICK_S)
    assert c.play().tick == 9
    assert c.times[9] == pytest.approx(0.1 + 9 * TICK_S)


def test_a_false_tick_start_before_the_first_one_hides_no_results(stage: Stage) -> None:
    """Here the group tolerates no false robot, but the first one says at once that it begins."""
    c = member(stage, "c", 200, LOCALISED)
    stage.alive("a", "b", "c", "d")
    begins(stage, "d", {150: 0.1})
    in_step(stage, "ab", 1)
    for robot in "abd":
        stage.comes("tick-start", keys.tick_start("r", robot), encode(result(robot)), 0.1 + 7 * TICK_S)
    assert c.play().tick < 20


# --- the end ------------------------------------------------------------------------------------------


def result(robot: str, verdict: Verdict | None = LOCALISED, *, complete: bool = True) -> TickStart:
    return TickStart(7, robot, verdict, complete)


@pytest.fixture
def ending(stage: Stage) -> Ending:
    return Ending(config_in_group("a"), 800, 30.0, stage.monotonic)


def ends(ending: Ending, ticks: range, *, rests: bool = True) -> MissionEnd | None:
    """Return the first MissionEnd in `ticks`, in which a is localised."""
    for tick in ticks:
        ending.tick_start(tick)
        end = ending.after(tick, Command(tick, "a", 0.0, 0.0, 3, "any", LOCALISED, rests=rests))
        if end is not None:
            return end
    return None


def test_the_own_result_of_a_robot_does_not_end_its_mission_while_others_have_none(
    ending: Ending,
) -> None:
    for robot in "bc":
        assert ending.receive(result(robot))
    assert ends(ending, range(10, 700)) is None
    start = ending.tick_start(700)
    assert (start.verdict, start.complete) == (LOCALISED, False)


def test_the_mission_ends_when_all_know_that_all_have_results(ending: Ending) -> None:
    for robot in "bcd":
        ending.receive(result(robot, complete=robot != "c"))
    assert ends(ending, range(10, 50)) is None
    assert ending.tick_start(50) == TickStart(50, "a", LOCALISED, complete=True)
    assert ending.receive(result("c"))
    assert not ending.receive(result("c"))
    assert ends(ending, range(50, 90)) == MissionEnd(50 + LAST_WORDS, "localised")


def test_a_robot_that_is_killed_after_its_result_is_waited_for_until_it_knows_all_others(
    ending: Ending,
) -> None:
    """It has journaled which results it knows, and needs the rest when it is back."""
    for robot in "bcd":
        ending.receive(result(robot, complete=robot != "c"))
    assert ends(ending, range(10, 50)) is None
    ending.receive(result("c"))
    assert ends(ending, range(50, 90)) == MissionEnd(50 + LAST_WORDS, "localised")


def test_a_robot_with_a_result_that_stays_silent_is_not_waited_for(stage: Stage, ending: Ending) -> None:
    for robot in "bcd":
        ending.receive(result(robot, complete=robot != "c"))
    stage.now += 31.0
    for robot in "bd":
        ending.receive(result(robot))
    assert ends(ending, range(10, 50)) == MissionEnd(10 + LAST_WORDS, "localised")


def test_a_robot_that_catches_up_tells_the_others_that_it_waits_for_none_before_it_ends(
    ending: Ending,
) -> None:
    """While it catches up, it sends no TickStart."""
    for robot in "bcd":
        ending.receive(result(robot))
    localised = Command(10, "a", 0.0, 0.0, 3, "localised", LOCALISED)
    assert all(ending.after(tick, localised) is None for tick in range(10, 50))
    assert ends(ending, range(50, 90)) == MissionEnd(50 + LAST_WORDS - 1, "localised")


PLAN = 164
"""The tick before which all are localised, by the plan."""


@pytest.mark.parametrize(
    ("rests", "silent_s", "tick"),
    [
        (True, 31.0, PLAN + LAST_WORDS),
        (False, 31.0, 2 * PLAN - 1 + LAST_WORDS),
        (True, 29.0, 800),
    ],
)
def test_a_silent_robot_is_given_up_after_its_planned_time_and_a_visit(
    rests: bool, silent_s: float, tick: int, stage: Stage, ending: Ending
) -> None:
    """The timeout is 30 s. The bound of the plan is 163.3 s, at which b is localised."""
    ending.receive(result("c"))
    ending.receive(result("d"))
    stage.now += silent_s
    ending.receive(result("c"))
    end = ends(ending, range(10, 1000), rests=rests)
    assert end is not None
    assert (end.tick, end.outcome) == (tick, "undecided")
    assert reason_for(end) == "a is localised; no result of b received"


def test_a_robot_that_has_just_been_localised_does_not_give_up_a_silent_one(
    stage: Stage, ending: Ending
) -> None:
    """The planner of a may still wait for the verdict of its peer, before it goes to the silent robot."""
    stage.now += 31.0
    for robot in "cd":
        ending.receive(result(robot))
    assert ends(ending, range(200, 230), rests=False) is None
    end = ends(ending, range(230, 300))
    assert end is not None
    assert end.tick == 230 + LAST_WORDS


@pytest.mark.parametrize(
    ("verdict", "outcome", "reason"),
    [
        (LOCALISED, "localised", None),
        (Undecided("why"), "undecided", "c: why"),
        (Inconsistent("x"), "inconsistent", "c: its peer reports x"),
        (None, "undecided", "a is localised; no result of c received"),
    ],
)
def test_the_outcome_is_that_of_all_robots(
    verdict: Verdict | None, outcome: str, reason: str | None, ending: Ending
) -> None:
    for robot in "bd":
        ending.receive(result(robot))
    ending.receive(result("c", verdict))
    end = ends(ending, range(10, 801))
    assert end is not None
    assert (end.outcome, reason_for(end)) == (outcome, reason)


@pytest.mark.parametrize(
    ("verdicts", "outcome", "reason"),
    [
        (
            {"b": Undecided("why"), "c": Undecided("y"), "d": LOCALISED},
            "undecided",
            "b: why; c is not localised either",
        ),
        (
            {"d": Inconsistent("x"), "b": Undecided("why"), "c": Undecided("y")},
            "inconsistent",
            "d: its peer reports x; b, c are not localised either",
        ),
        ({"d": Undecided("why")}, "undecided", "d: why; no result of b, c received"),
    ],
)
def test_the_reason_names_all_robots_that_are_not_localised(
    verdicts: dict[str, Verdict], outcome: str, reason: str, ending: Ending
) -> None:
    for robot, verdict in verdicts.items():
        ending.receive(result(robot, verdict))
    end = ends(ending, range(10, 801))
    assert end is not None
    assert (end.outcome, reason_for(end)) == (outcome, reason)


def test_a_robot_without_a_result_ends_at_max_ticks(ending: Ending) -> None:
    for robot in "bcd":
        ending.receive(result(robot))
    moving = [ending.after(tick, command(tick)) for tick in range(801)]
    assert moving[:800] == [None] * 800
    assert moving[800] == MissionEnd(800, "undecided", (Cause("max-ticks", ("a",)),))


def test_results_are_journaled_once_when_they_are_received(stage: Stage) -> None:
    journal = MemoryJournal()
    a = member(stage, "a", 9, LOCALISED, journal)
    stage.alive("a", "b", "c", "d")
    for tick in range(3):
        for robot in "bc":
            start = encode(replace(result(robot), tick=tick))
            stage.comes("tick-start", keys.tick_start("r", robot), start, (0.5 + tick) * TICK_S)
    assert a.play().tick == 9
    history = driver_history([encode(config_in_group("a")), *journal.frames], config_in_group("a"), Path("a"))
    assert [one.robot for tick in history.ticks for one in tick.received] == ["b", "c"]


def test_a_tick_start_of_an_unexpected_tick_changes_nothing(stage: Stage) -> None:
    """One that a robot sent before its result arrives late; ticks far ahead are those of no robot."""
    journal = MemoryJournal()
    a = member(stage, "a", 9, LOCALISED, journal)
    stage.alive("a", "b", "c", "d")
    starts = [result("b"), replace(result("b", None), tick=1), replace(result("c"), tick=10_000)]
    for place, start in enumerate([replace(starts[0], tick=2), *starts[1:]]):
        key = keys.tick_start("r", start.robot)
        stage.comes("tick-start", key, encode(start), 2.5 * TICK_S + 0.001 * place)
    a.play()
    history = driver_history([encode(config_in_group("a")), *journal.frames], config_in_group("a"), Path("a"))
    received = [one for tick in history.ticks for one in tick.received]
    assert received == [replace(result("b"), tick=2)]


def test_results_that_were_received_are_known_after_a_restart(stage: Stage, tmp_path: Path) -> None:
    config = config_in_group("a")
    frames = [encode(config), encode(Observation(0, "a", None, 2.0)), encode(command(0, verdict=LOCALISED))]
    frames += [encode(result(robot)) for robot in "bcd"]
    history = driver_history(frames, config, tmp_path)
    assert [one.robot for one in history.ticks[0].received] == ["b", "c", "d"]
    a = member(stage, "a", 100, LOCALISED)
    a.field.resume(history, latest=0)
    stage.alive("a", "b", "c", "d")
    assert a.play() == MissionEnd(LAST_WORDS, "localised")
    with pytest.raises(CorruptJournal, match="it belongs to another mission"):
        driver_history(frames, config_in_group("b"), tmp_path)


# --- readings -----------------------------------------------------------------------------------------


def contacts(reading: Reading, robot: str = "a") -> tuple[Contact, ...]:
    return decode(observation_frame(reading, 3, config_in_group(robot)), Observation).contacts


def test_a_reading_may_have_ranges_to_several_robots() -> None:
    found = contacts(Reading(REST, 2.0, mutual_ranges={"d": 1.0, "b": None}))
    assert found == (Contact("b", None, None), Contact("d", 1.0, None))
    assert contacts(Reading(REST, 2.0)) == ()


def test_a_driver_of_a_pair_ranges_to_its_peer_in_both_ways() -> None:
    pair = config_of(parse(FAR, "four"), "a", MANOEUVRE_S)
    assert pair.peer == "d"
    both = Reading(REST, 2.0, 1.5), Reading(REST, 2.0, mutual_ranges={"d": 1.5})
    assert contacts(both[0]) == contacts(both[1]) == (Contact("d", 1.5, None),)
    assert contacts(Reading(REST, 2.0, contact=True)) == (Contact("d", None, None),)
    assert contacts(Reading(REST, 2.0, 1.5, mutual_ranges={"b": 1.0}))[1] == Contact("d", 1.5, None)


@pytest.mark.parametrize(
    ("ranges", "said"),
    [
        ({"a": 1.0}, "mutual_ranges: 'a' is none of b, c, d"),
        ({"x": 1.0}, "mutual_ranges: 'x' is none of b, c, d"),
        ({3: 1.0}, "mutual_ranges: 3 is none of b, c, d"),
        ({"b": -1.0}, "Expected `float` >= 0.0"),
        ({"b": float("nan")}, "Expected `float`"),
        ({"b": "1"}, "Expected `float"),
        ([("b", 1.0)], "mutual_ranges is a list, expected a mapping"),
        (None, "mutual_ranges is a NoneType, expected a mapping"),
    ],
)
def test_a_reading_with_invalid_ranges_is_refused(ranges: Any, said: str) -> None:
    with pytest.raises(InvalidReading, match=said):
        contacts(Reading(REST, 2.0, mutual_ranges=ranges))


def test_a_reading_with_two_contacts_with_the_peer_is_refused() -> None:
    with pytest.raises(InvalidReading, match="both mutual_ranges and the other fields have a contact with d"):
        contacts(Reading(REST, 2.0, 1.0, mutual_ranges={"d": 1.0}))


def test_a_robot_that_dies_by_the_scenario_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dies.toml").write_text(f"{FAR}dies = 5\n")
    with pytest.raises(UserError, match="dies: not available in hardware mode"):
        mission(str(tmp_path / "dies.toml"), "a")
