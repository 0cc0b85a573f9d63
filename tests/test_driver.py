"""A driver executes only Commands of its own agent, of the current tick and in time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path

import pytest

from compose.launch.driver_loader import config_of
from compose.recording.reasons import reason_for
from compose.scenario.scenario_file import parse
from protocol.journal.journal_file import MemoryJournal
from protocol.messages import (
    Cause,
    Command,
    Estimate,
    FinalReport,
    Inconsistent,
    Localised,
    MissionEnd,
    Observation,
    RobotConfig,
    TickStart,
    Undecided,
    Verdict,
)
from protocol.motion import ORIGIN, REST, Controls
from protocol.network import keys
from protocol.network.session import SILENCE_S
from protocol.wire import decode, encode
from tests.commands import ASSURED, PAPER_1
from tests.stage import FINAL_REPORT, LINK, MANOEUVRE_S, TICK_S, Member, Recorded, Stage, begins, command
from world.hardware import bridge
from world.hardware.bridge import ASTRAY, Field, NoStart
from world.hardware.driver import THINKING, Reading
from world.hardware.driver_journal import DrivenTick, DriverHistory, driver_history
from world.hardware.termination import LAST_WORDS, Ending
from world.hardware.tick_source import UNHEARD

Answer = Callable[[int], Iterable[bytes]]
"""The frames that are sent in answer to the Observation of a tick."""
SCENARIO = parse(PAPER_1, "paper-1")
CONFIG = config_of(SCENARIO, "a", MANOEUVRE_S)


def assured(robot: str) -> RobotConfig:
    """Return the configuration of a robot that tolerates any number of missed deadlines."""
    return config_of(parse(ASSURED, "assured"), robot, MANOEUVRE_S)


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    return Stage(monkeypatch)


Play = Callable[..., tuple[Field, MissionEnd, list[MissionEnd]]]


@pytest.fixture
def played(stage: Stage) -> Play:
    """Return a function that runs a mission of a with a driver and a simulated agent.

    The agent sends `answer` to each Observation, `after` some seconds. The function returns the field, the
    MissionEnd that it reached, and those that it sent.
    """

    def play(
        driver: Recorded, answer: Answer, ticks: int = 5, timeout: float = 60.0, after: float = 0.001
    ) -> tuple[Field, MissionEnd, list[MissionEnd]]:
        driver.clock = stage.monotonic
        ends: list[MissionEnd] = []

        def said(key: str, frame: bytes) -> None:
            if key != keys.observation("r", "a"):
                return
            match decode(frame, Observation | MissionEnd | FinalReport):
                case Observation(tick):
                    for one in answer(tick):
                        stage.comes("command", keys.command("r", "a"), one, after)
                case MissionEnd() as end:
                    ends.append(end)
                    stage.comes("command", keys.command("r", "a"), encode(FINAL_REPORT))

        stage.answer = said
        stage.alive("a", "b")
        field = Field(driver, CONFIG, "r", stage, max_ticks=ticks, manoeuvre_s=MANOEUVRE_S, timeout=timeout)
        field.attach(LINK)
        return field, field.run_mission(10.0, lambda: None), ends

    return play


def test_a_command_in_time_is_executed_and_a_tick_lasts_a_manoeuvre_and_a_decision(played: Play) -> None:
    driver = Recorded()
    field, end, told = played(driver, lambda tick: [encode(command(tick))])
    assert (end.tick, end.outcome, field.missed) == (5, "undecided", 0)
    assert driver.commands == [(0.5, 0.25)] * 6
    assert [tick for tick, _ in driver.ticks] == [0, 1, 2, 3, 4, 5]
    assert told == [end]
    assert driver.stopped >= 1
    took = driver.ticks[-1][1] - driver.ticks[0][1]
    assert took == pytest.approx(5 * TICK_S)


NONSENSE: dict[str, Answer] = {
    "bytes": lambda _: [b"", b"\0" * 40, b"nonsense" * 400],
    "torn": lambda tick: [encode(command(tick))[:-3]],
    "another's": lambda tick: [encode(command(tick, "b"))],
    "a Sense": lambda tick: [encode(Observation(tick, "a", None, None))],
    "of a tick to come": lambda tick: [encode(command(tick + 1))],
    "of a tick past": lambda tick: [encode(command(max(0, tick - 1)))] if tick else [],
    "silence": lambda _: [],
    "no number": lambda tick: [encode(command(tick, v=float("nan")))],
    "infinite": lambda tick: [encode(command(tick, v=float("inf")))],
}


@pytest.mark.parametrize("kind", NONSENSE)
def test_a_robot_whose_agent_sends_invalid_frames_stands_still(kind: str, played: Play) -> None:
    driver = Recorded()
    field, end, _ = played(driver, NONSENSE[kind])
    assert driver.commands == []
    assert field.missed == end.tick + 1
    assert end.outcome == "undecided"


def test_no_robot_drives_faster_than_the_mission_allows(played: Play) -> None:
    driver = Recorded()
    played(driver, lambda tick: [encode(Command(tick, "a", -7.0, 1e6, 1, "straight"))], ticks=1)
    assert driver.commands == [(-1.0, 3.141592653589793)] * 2


class Told(Recorded):
    """A driver that takes estimates, and fails at some tick."""

    def __init__(self, fails_at: int | None = None) -> None:
        super().__init__()
        self.estimates: list[Estimate] = []
        self._last = fails_at

    def estimated(self, estimate: Estimate) -> None:
        self.estimates.append(estimate)
        if estimate.tick == self._last:
            raise OSError("no such map")


def test_a_driver_that_takes_estimates_gets_those_of_its_agent(stage: Stage, played: Play) -> None:
    def answer(tick: int) -> list[bytes]:
        for robot in ("b", "a"):
            estimate = Estimate(tick, robot, (), (ORIGIN,), localised=True)
            stage.comes("estimate", keys.estimate("r", "a"), encode(estimate))
        return [encode(command(tick))]

    driver = Told()
    _, end, _ = played(driver, answer)
    assert [(one.tick, one.robot) for one in driver.estimates] == [
        (tick, "a") for tick in range(end.tick + 1)
    ]
    _, end, _ = played(Told(fails_at=2), answer)
    assert reason_for(end) == "a's driver: estimated(): OSError: no such map"


def test_a_late_command_is_not_executed(played: Play) -> None:
    driver = Recorded()
    late = THINKING * MANOEUVRE_S
    field, end, _ = played(driver, lambda tick: [encode(command(tick))], after=1.01 * late)
    assert driver.commands == []
    assert field.missed == end.tick + 1
    in_time = Recorded()
    field, end, _ = played(in_time, lambda tick: [encode(command(tick))], after=0.99 * late)
    assert len(in_time.commands) == end.tick + 1


@pytest.mark.parametrize(
    ("driver", "said"),
    [
        (Recorded(fails_at=3), "a's driver: sense(3): OSError: no such device"),
        (Recorded(reading=Reading(Controls(float("nan"), 0.0))), "a's driver: sense(1): Expected"),
        (Recorded(reading=Reading(REST, -1.0)), "a's driver: sense(0): Expected"),
        (Recorded(reading=Reading(REST, None, float("inf"))), "a's driver: sense(0): Expected"),
        (Recorded(reading="2.0"), "a's driver: sense(0): returns str, expected a Reading"),  # type: ignore[arg-type]
    ],
)
def test_a_driver_that_fails_ends_the_mission_and_stops_the_robot(
    driver: Recorded, said: str, played: Play
) -> None:
    _, end, told = played(driver, lambda tick: [encode(command(tick))])
    assert end.outcome == "failed"
    assert str(reason_for(end)).startswith(said)
    assert driver.stopped >= 1
    assert told == [end]


def test_an_agent_that_never_answers_ends_the_mission_after_the_timeout(played: Play) -> None:
    _, end, _ = played(Recorded(), lambda _: [], ticks=1000, timeout=1.0)
    assert end.outcome == "failed"
    assert str(reason_for(end)).startswith("no answer from a's agent for 1.")


def test_an_agent_that_only_reconnects_ends_the_mission_after_the_timeout(stage: Stage, played: Play) -> None:
    """An agent that dies at once is restarted each time, and has sent no answer."""
    for second in range(1000):
        stage.comes("alive", keys.robot_alive("r", "a"), after=float(second))
    _, end, _ = played(Recorded(), lambda _: [], ticks=1000, timeout=3.0)
    assert end.outcome == "failed"
    assert str(reason_for(end)).startswith("no answer from a's agent for ")
    assert stage.now < 20.0


# --- the end of a mission -----------------------------------------------------------------------------


def told(tick: int, verdict: Verdict | None, *, complete: bool = True) -> TickStart:
    return TickStart(tick, "b", verdict, complete)


def ended(
    own: Verdict | None, said: TickStart | None, timeout: float = 60.0, ticks: int = 30
) -> MissionEnd | None:
    """Return the MissionEnd if a reaches the verdict `own` at tick 10 and receives `said` at tick 12."""
    ending = Ending(CONFIG, 25, timeout, time.monotonic)
    for tick in range(ticks):
        if tick == 12 and said is not None:
            ending.receive(said)
        ending.tick_start(tick)
        verdict = own if tick >= 10 else None
        end = ending.after(tick, command(tick, verdict=verdict))
        if end is not None:
            return end
    return None


LOCALISED = Localised(ORIGIN)


@pytest.mark.parametrize(
    ("own", "said", "tick", "outcome", "reason"),
    [
        (LOCALISED, told(12, LOCALISED), 12 + LAST_WORDS, "localised", None),
        (LOCALISED, told(12, LOCALISED, complete=False), 25, "localised", None),
        (LOCALISED, told(12, None), 25, "undecided", "a is localised; no result of b received"),
        (LOCALISED, None, 25, "undecided", "a is localised; no result of b received"),
        (LOCALISED, told(12, Undecided("why")), 12 + LAST_WORDS, "undecided", "b: why"),
        (LOCALISED, told(12, Inconsistent("x")), 12 + LAST_WORDS, "inconsistent", "b: a reports x"),
        (Inconsistent("x"), told(12, LOCALISED), 12 + LAST_WORDS, "inconsistent", "a: b reports x"),
        (Undecided("why"), told(12, None), 25, "undecided", "a: why"),
        (None, told(12, LOCALISED), 25, "undecided", "max_ticks: a not localised by then"),
    ],
)
def test_the_mission_ends_when_each_robot_knows_that_the_other_knows(
    own: Verdict | None, said: TickStart | None, tick: int, outcome: str, reason: str | None
) -> None:
    end = ended(own, said)
    assert end is not None
    assert (end.tick, end.outcome, reason_for(end)) == (tick, outcome, reason)


def test_the_mission_ends_when_the_peer_sends_nothing_for_too_long() -> None:
    end = ended(LOCALISED, None, timeout=-1.0)
    assert end is not None
    assert (end.tick, end.outcome) == (10 + LAST_WORDS, "undecided")


def test_a_peer_that_is_killed_between_its_claim_and_its_last_report_is_waited_for(
    stage: Stage, played: Play
) -> None:
    """It needs this robot's result when it is back."""

    def starts(tick: int) -> None:
        frame = encode(told(tick, LOCALISED, complete=tick > 5))
        stage.comes("tick-start", keys.tick_start("r", "b"), frame)

    def answer(tick: int) -> list[bytes]:
        if tick == 5:
            starts(tick)
            stage.comes("gone", keys.robot_alive("r", "b"), after=0.01)
        if tick == 40:
            stage.alive("b")
            starts(tick)
        return [encode(command(tick, verdict=LOCALISED if tick >= 5 else None))]

    _, end, _ = played(Recorded(), answer, ticks=100)
    assert end == MissionEnd(40 + LAST_WORDS, "localised")


def test_only_results_near_the_tick_of_the_mission_are_used_and_journaled(stage: Stage) -> None:
    """One that comes before tick 0 would be the first frame of a journal that cannot be resumed."""
    journal = MemoryJournal()
    field = Field(Recorded(), CONFIG, "r", stage, max_ticks=99, manoeuvre_s=MANOEUVRE_S, journal=journal)
    field.attach(LINK)
    genuine = told(6, Undecided("why"))
    early = [told(0, LOCALISED), told(90, LOCALISED)]
    at_3 = [told(3 + ASTRAY + 1, LOCALISED), told(10**6, LOCALISED)]
    late = [genuine, told(7, Undecided("why")), told(1, LOCALISED)]  # repetitions change nothing

    def comes(*starts: TickStart) -> None:
        for one in starts:
            stage.comes("tick-start", keys.tick_start("r", "b"), encode(one))

    def answer(key: str, frame: bytes) -> None:
        if key == keys.observation("r", "a"):
            match decode(frame, Observation | TickStart | MissionEnd | FinalReport):
                case TickStart():  # a waits for b
                    comes(*early)
                    stage.alive("b")
                case Observation(tick):
                    verdict = Undecided("why") if tick >= 5 else None
                    stage.comes("command", keys.command("r", "a"), encode(command(tick, verdict=verdict)))
                    comes(*{3: at_3, 6: late}.get(tick, ()))
                case MissionEnd():
                    stage.comes("command", keys.command("r", "a"), encode(FINAL_REPORT))

    stage.answer = answer
    stage.alive("a")
    assert field.run_mission(10.0, lambda: None) == MissionEnd(
        6 + LAST_WORDS, "undecided", (Cause("undecided", ("a",), text="why"),)
    )
    history = driver_history([encode(CONFIG), *journal.frames], CONFIG, Path("a"))
    assert [one.received for one in history.ticks if one.received] == [(genuine,)]


@pytest.mark.parametrize("is_end_recorded", [True, False])
def test_a_robot_that_is_restarted_after_the_end_only_records_the_end_if_that_is_missing(
    stage: Stage, is_end_recorded: bool
) -> None:
    end, journal = MissionEnd(5, "undecided", (Cause("max-ticks", ("a",)),)), MemoryJournal()
    ticks = [DrivenTick(Observation(tick, "a", None, 1.0), b"", command(tick)) for tick in range(6)]
    field = Field(Recorded(), CONFIG, "r", stage, max_ticks=5, manoeuvre_s=MANOEUVRE_S, journal=journal)
    field.resume(DriverHistory(tuple(ticks), (), end if is_end_recorded else None), 5)
    field.attach(LINK)
    stage.comes("tick-start", keys.tick_start("r", "b"), encode(told(6, Undecided("why"))))
    stage.alive("a")
    assert field.run_mission(10.0, lambda: None) == end
    assert journal.frames == ([] if is_end_recorded else [encode(end)])


def test_an_agent_is_told_that_its_driver_waits_for_the_peer(stage: Stage) -> None:
    """Otherwise it would take its link, and at last the driver, for lost."""
    told: list[tuple[float, object]] = []

    def said(key: str, frame: bytes) -> None:
        if key == keys.observation("r", "a"):
            told.append((stage.now, decode(frame, TickStart)))

    stage.answer = said
    stage.alive("a")
    field = Field(Recorded(), CONFIG, "r", stage, max_ticks=5, manoeuvre_s=MANOEUVRE_S)
    field.attach(LINK)
    with pytest.raises(NoStart):
        field.run_mission(10.0, lambda: None)
    assert {start for _, start in told} == {TickStart(0, "a")}
    assert max(later - before for (before, _), (later, _) in pairwise(told)) < SILENCE_S
    assert stage.now - told[-1][0] < SILENCE_S


# --- the clock ----------------------------------------------------------------------------------------


def test_b_begins_when_a_does_and_counts_a_s_ticks(stage: Stage) -> None:
    """b is seven ticks late: it passes through these at once without moving, then drives in a's ticks."""
    b = Member(stage, assured("b"), 12)
    stage.alive("b")
    later = 0.5 + 2.5 * MANOEUVRE_S
    for tick, after in ((7, 0.5), (0, later), (500, later)):  # tick 0 is of an a that lost its journal
        begins(stage, "a", {tick: after})
    assert b.play().tick == 12
    assert b.times[0] == pytest.approx(0.5)
    assert [*b.times] == list(range(13))
    assert b.times[7] == pytest.approx(0.5)
    assert b.field.missed == 7
    assert stage.refused["tick-start"] == 2
    assert len(b.driver.commands) == 6


def history_of(ticks: int, *, robot: str) -> DriverHistory:
    """Return the recording of a driver after `ticks` ticks, which drove in every second one."""
    observations = [Observation(tick, robot, REST if tick else None, 2.0) for tick in range(ticks)]
    return DriverHistory(
        tuple(
            [
                DrivenTick(one, encode(one), command(one.tick, robot) if one.tick % 2 == 0 else None)
                for one in observations
            ]
        )
    )


@pytest.mark.parametrize(("robot", "peer"), ["ab", "ba"])
def test_a_robot_that_was_down_catches_up_with_its_peer_standing(robot: str, peer: str, stage: Stage) -> None:
    """For any number of ticks without the process; it then continues in the ticks of the peer."""
    one = Member(stage, assured(robot), 305)
    one.field.resume(history_of(20, robot=robot), latest=17)
    stage.alive(robot)
    begins(stage, peer, {300: 0.01})
    assert one.play().tick == 305
    sent = [
        decode(frame, Observation | MissionEnd | FinalReport)
        for key, frame in stage.put_frames
        if key == keys.observation("r", robot)
    ]
    assert [seen.tick for seen in sent if isinstance(seen, Observation)] == list(range(18, 306))
    assert [*one.times] == list(range(20, 306))
    assert one.times[299] - one.times[21] < 2 * TICK_S
    assert one.times[305] - one.times[301] == pytest.approx(4 * TICK_S)
    assert 5 <= len(one.driver.commands) <= 7


def test_a_restarted_robot_whose_peer_comes_later_is_no_more_behind_than_the_peer(stage: Stage) -> None:
    """A robot whose driver waits in each tick for its peer, to measure the range; the peer counts its ticks.

    It has nothing to catch up with, so it says where it is. Otherwise the peer would count its own ticks, and
    this robot would be late in all of them.
    """
    peer = {"starts": 3.0}

    class Waits(Recorded):
        def sense(self, tick: int) -> Reading:
            stage.now = max(stage.now, peer["starts"])
            peer["starts"] += TICK_S
            return super().sense(tick)

    a = Member(stage, CONFIG, 90, driver=Waits())
    a.field.resume(history_of(20, robot="a"), latest=19)
    agent = stage.answer

    def answer(key: str, frame: bytes) -> None:
        if key == keys.tick_start("r", "a"):
            peer["starts"] = min(peer["starts"], max(stage.now, 3.0))
        agent(key, frame)

    stage.answer = answer
    stage.alive("a", "b")
    a.play()
    assert a.started() == list(range(20, 91))
    assert len(a.driver.commands) > 40


def test_an_a_that_was_not_down_does_not_go_by_its_peers_ticks(stage: Stage, played: Play) -> None:
    driver = Recorded()
    stage.comes("tick-start", keys.tick_start("r", "b"), encode(TickStart(4, "b")), 0.05)
    played(driver, lambda tick: [encode(command(tick))])
    assert driver.ticks[-1][1] - driver.ticks[0][1] == pytest.approx(5 * TICK_S)


@pytest.mark.parametrize("killed", [True, False])
def test_a_b_that_has_missed_the_start_of_tick_0_begins_though_a_waits_for_it(
    killed: bool, stage: Stage
) -> None:
    """a is present, but sends nothing. When it does, it is behind, and b waits for it."""
    b = Member(stage, assured("b"), 9)
    if killed:
        b.field.resume(DriverHistory(), latest=-1)
    stage.alive("a", "b")
    begins(stage, "a", {0: 9.5 * TICK_S})
    assert b.play().tick == 9
    assert b.times[0] == pytest.approx(UNHEARD * TICK_S, abs=1e-3)  # it counts from the connection on
    assert b.times[5] == pytest.approx(b.times[0] + 5 * TICK_S)
    assert b.times[6] == pytest.approx((9.5 + 6) * TICK_S)


def test_a_mission_ends_though_zenoh_takes_its_end_never(
    stage: Stage, played: Play, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridge, "PUT_S", 0.05)
    released = threading.Event()
    sent = stage._on_put

    def put(key: str, frame: bytes) -> None:
        if key == keys.observation("r", "a") and isinstance(
            decode(frame, Observation | MissionEnd | FinalReport), MissionEnd
        ):
            released.wait()
        else:
            sent(key, frame)

    monkeypatch.setattr(stage, "_on_put", put)
    _, end, _ = played(Recorded(), lambda tick: [encode(command(tick))])
    released.set()
    assert (end.tick, end.outcome) == (5, "undecided")
    assert "no FinalReport of a: Zenoh does not take the MissionEnd" in capsys.readouterr().err


def test_a_robot_prints_the_reason_for_a_missing_final_report(
    stage: Stage, capsys: pytest.CaptureFixture[str]
) -> None:
    stage.alive("a", "b")
    field = Field(Recorded(), CONFIG, "r", stage, max_ticks=2, manoeuvre_s=MANOEUVRE_S)
    field.attach(LINK)
    field.run_mission(10.0, lambda: None)
    assert "no FinalReport of a: no answer to the MissionEnd" in capsys.readouterr().err


@pytest.mark.parametrize("robot", ["a", "b"])
def test_a_robot_that_was_killed_waits_for_its_agent_however_long_its_peer_is_there(
    robot: str, stage: Stage
) -> None:
    one = Member(stage, assured(robot), 25)
    one.field.resume(history_of(20, robot=robot), latest=19)
    stage.alive("b" if robot == "a" else "a")
    stage.comes("alive", keys.robot_alive("r", robot), after=3.0)
    assert one.play().tick == 25
    assert one.driver.ticks[0] == pytest.approx((20, 3.0))


def test_a_robot_with_a_slow_driver_receives_the_commands_of_its_agent(stage: Stage, played: Play) -> None:
    class Slow(Recorded):
        def sense(self, tick: int) -> Reading:
            stage.now += 2.0 * MANOEUVRE_S
            return super().sense(tick)

    _, end, _ = played(Slow(), lambda tick: [encode(command(tick))], ticks=100, timeout=1.0)
    assert (end.outcome, end.tick) == ("undecided", 100)
