"""A robot moves by Drives of its own agent, of this tick, in time, and by nothing else."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator

import pytest
import zenoh

from compose.driving import briefed
from compose.local import free_endpoint
from compose.scenario import parse
from protocol import keys, session
from protocol.endpoints import at, listening
from protocol.inbox import Inbox
from protocol.messages import (
    Alarm,
    Beat,
    Drive,
    End,
    Farewell,
    Localised,
    Ranged,
    Report,
    Sense,
    Undecided,
    Verdict,
)
from protocol.motion import ORIGIN, REST, Controls
from protocol.wire import MalformedFrame, decode, encode
from tests.commands import ASSURED, PAPER_1
from world.driver import THINKING, Reading
from world.ending import LAST_WORDS, Ending
from world.field import Field

Answer = Callable[[int], Iterable[bytes]]
"""what somebody says to the Sense of a tick"""
MANOEUVRE_S = 0.1
SCENARIO = parse(PAPER_1, "paper-1")
BRIEFING = briefed(SCENARIO, "a", MANOEUVRE_S)


class Recorded:
    """A driver that does nothing but to note what it was told, and when."""

    def __init__(self, fails_at: int | None = None, reading: Reading | None = None) -> None:
        self.drives: list[tuple[float, float]] = []
        self.ticks: list[tuple[int, float]] = []
        self.stopped = 0
        self._fails_at = fails_at
        self._reading = reading or Reading(REST, 2.0)

    def sense(self, tick: int) -> Reading:
        self.ticks.append((tick, time.monotonic()))
        if tick == self._fails_at:
            raise OSError("no such device")
        return self._reading

    def drive(self, v: float, omega: float) -> None:
        self.drives.append((v, omega))

    def stop(self) -> None:
        self.stopped += 1

    def close(self) -> None:
        pass


class Stranger:
    """Whoever answers in the agent's place."""

    def __init__(self, link: zenoh.Session, answer: Answer) -> None:
        self.ticks: list[int] = []
        self.end: End | None = None
        self._drive = session.publisher(link, keys.drive("r", "a"))
        self._answer = answer
        link.declare_subscriber(keys.sense("r", "a"), self._on_sense)
        self._tokens = [session.show_alive(link, keys.robot_alive("r", one)) for one in ("a", "b")]

    def _on_sense(self, sample: zenoh.Sample) -> None:
        try:
            message = decode(sample.payload.to_bytes(), Sense | End | Farewell)
        except MalformedFrame:
            return
        match message:
            case Sense(tick):
                self.ticks.append(tick)
                for frame in self._answer(tick):
                    self._drive.put(frame)
            case End():
                self.end = message
                self._drive.put(encode(FAREWELL))


FAREWELL = Farewell("a", 0, 0, None, None, None, None, None, None, None, None, None, 0, 0, 0, 0, 0, 0, 0)


def drive(tick: int, robot: str = "a", v: float = 0.5, verdict: Verdict | None = None) -> Drive:
    return Drive(tick, robot, v, 0.25, 1, "straight", verdict)


def played(
    driver: Recorded, answer: Answer, ticks: int = 5, manoeuvre_s: float = MANOEUVRE_S
) -> tuple[Field, End, Stranger]:
    endpoint, inbox = free_endpoint(), Inbox("field")
    field = Field(driver, BRIEFING, "r", inbox, max_ticks=ticks, manoeuvre_s=manoeuvre_s, patience=1.0)
    with (
        session.open_router(listening(endpoint)) as link,
        session.open_client(at(endpoint), lambda: None) as other,
    ):
        field.attach(link)
        stranger = Stranger(other, answer)
        end = field.play(10.0, lambda: None)
    return field, end, stranger


def test_a_drive_in_time_is_driven_and_a_tick_is_a_manoeuvre_and_a_moment_to_think() -> None:
    driver = Recorded()
    field, end, stranger = played(driver, lambda tick: [encode(drive(tick))])
    assert (end.tick, end.outcome, field.missed) == (5, "undecided", 0)
    assert driver.drives == [(0.5, 0.25)] * 6
    assert [tick for tick, _ in driver.ticks] == [0, 1, 2, 3, 4, 5]
    assert stranger.end == end
    assert driver.stopped >= 1
    took = driver.ticks[-1][1] - driver.ticks[0][1]
    assert took == pytest.approx(5 * (1 + THINKING) * MANOEUVRE_S, rel=0.3)


NONSENSE: dict[str, Answer] = {
    "bytes": lambda _: [b"", b"\0" * 40, b"nonsense" * 400],
    "torn": lambda tick: [encode(drive(tick))[:-3]],
    "another's": lambda tick: [encode(drive(tick, "b"))],
    "a Sense": lambda tick: [encode(Sense(tick, "a", None, None))],
    "of a tick to come": lambda tick: [encode(drive(tick + 1))],
    "of a tick past": lambda tick: [encode(drive(max(0, tick - 1)))] if tick else [],
    "silence": lambda _: [],
    "no number": lambda tick: [encode(drive(tick, v=float("nan")))],
    "infinite": lambda tick: [encode(drive(tick, v=float("inf")))],
}


@pytest.mark.parametrize("kind", NONSENSE)
def test_a_robot_whose_agent_speaks_nonsense_stands_still(kind: str) -> None:
    driver = Recorded()
    field, end, _ = played(driver, NONSENSE[kind])
    assert driver.drives == []
    assert field.missed == end.tick + 1
    assert end.outcome == "undecided"


def test_nobody_drives_faster_than_the_mission_says() -> None:
    driver = Recorded()
    played(driver, lambda tick: [encode(Drive(tick, "a", -7.0, 1e6, 1, "straight"))], ticks=1)
    assert driver.drives == [(-1.0, 3.141592653589793)] * 2


def test_a_drive_that_comes_late_is_not_driven() -> None:
    driver, late = Recorded(), threading.Event()

    def answer(_: int) -> Iterator[bytes]:
        late.wait(0.6 * MANOEUVRE_S)
        yield encode(drive(_))

    field, end, _ = played(driver, answer)
    assert driver.drives == []
    assert field.missed == end.tick + 1


@pytest.mark.parametrize(
    ("driver", "said"),
    [
        (Recorded(fails_at=3), "a's driver: sense(3): OSError: no such device"),
        (Recorded(reading=Reading(Controls(float("nan"), 0.0))), "a's driver: sense(1): Expected"),
        (Recorded(reading=Reading(REST, -1.0)), "a's driver: sense(0): Expected"),
        (Recorded(reading=Reading(REST, None, float("inf"))), "a's driver: sense(0): Expected"),
        (Recorded(reading="2.0"), "a's driver: sense(0): gives str, expected a Reading"),  # type: ignore[arg-type]
    ],
)
def test_a_driver_that_cannot_go_on_ends_the_mission_and_stands(driver: Recorded, said: str) -> None:
    _, end, stranger = played(driver, lambda tick: [encode(drive(tick))])
    assert end.outcome == "failed"
    assert end.reason is not None
    assert end.reason.startswith(said)
    assert driver.stopped >= 1
    assert stranger.end == end


def test_an_agent_that_never_answers_ends_the_mission_after_the_patience() -> None:
    _, end, _ = played(Recorded(), lambda _: [], ticks=1000)
    assert end.outcome == "failed"
    assert end.reason is not None
    assert end.reason.startswith("no answer from a's agent for 1.")


# --- the end ------------------------------------------------------------------------------------------


def report(tick: int, heard: int, verdict: Verdict | None) -> Report:
    return Report(tick, "b", 3, "standing", ORIGIN, 0, 0, (), 0, (Ranged(0, 1.0),), heard, 1, verdict)


def ended(own: Verdict | None, said: Report | None, patience: float = 60.0, ticks: int = 30) -> End | None:
    """The End of a mission in which a comes to `own` at tick 10, and hears `said` at tick 12."""
    ending = Ending(BRIEFING, 25, patience)
    for tick in range(ticks):
        if tick == 12 and said is not None:
            ending.told(said)
        verdict = own if tick >= 10 else None
        end = ending.after(tick, drive(tick, verdict=verdict), peer_there=True)
        if end is not None:
            return end
    return None


LOCALISED = Localised(ORIGIN)


@pytest.mark.parametrize(
    ("own", "said", "tick", "outcome", "reason"),
    [
        (LOCALISED, report(12, 11, LOCALISED), 12 + LAST_WORDS, "localised", None),
        (LOCALISED, report(12, 9, LOCALISED), 25, "localised", None),
        (LOCALISED, report(12, 11, None), 25, "undecided", "a is localised; b was not heard to be"),
        (LOCALISED, None, 25, "undecided", "a is localised; b was not heard to be"),
        (LOCALISED, report(12, 11, Undecided("why")), 12 + LAST_WORDS, "undecided", "b: why"),
        (LOCALISED, report(12, 11, Alarm("lies")), 12 + LAST_WORDS, "alarm", "b: a tells lies"),
        (Alarm("lies"), report(12, 11, LOCALISED), 12 + LAST_WORDS, "alarm", "a: b tells lies"),
        (Undecided("why"), report(12, 11, None), 25, "undecided", "a: why"),
        (None, report(12, 11, LOCALISED), 25, "undecided", "max_ticks: a not localised by then"),
    ],
)
def test_it_is_over_when_each_knows_that_the_other_knows(
    own: Verdict | None, said: Report | None, tick: int, outcome: str, reason: str | None
) -> None:
    end = ended(own, said)
    assert end is not None
    assert (end.tick, end.outcome, end.reason) == (tick, outcome, reason)


def test_it_is_over_when_the_peer_is_silent_for_too_long() -> None:
    end = ended(LOCALISED, None, patience=-1.0)
    assert end is not None
    assert (end.tick, end.outcome) == (10, "undecided")


# --- the clock ----------------------------------------------------------------------------------------


def test_b_begins_when_a_does_and_counts_a_s_ticks() -> None:
    """Late by seven ticks, it goes through those at once, standing; then it drives in a's."""
    driver, endpoint = Recorded(), free_endpoint()
    briefing = briefed(parse(ASSURED, "assured"), "b", MANOEUVRE_S)
    inbox = Inbox("field")
    field = Field(driver, briefing, "r", inbox, max_ticks=12, manoeuvre_s=MANOEUVRE_S)
    with (
        session.open_router(listening(endpoint)) as link,
        session.open_client(at(endpoint), lambda: None) as other,
    ):
        field.attach(link)
        answers = session.publisher(other, keys.drive("r", "b"))

        def answer(sample: zenoh.Sample) -> None:
            sense = decode(sample.payload.to_bytes(), Sense | End | Farewell)
            if isinstance(sense, Sense):
                answers.put(encode(drive(sense.tick, "b")))
            elif isinstance(sense, End):
                answers.put(encode(FAREWELL))

        other.declare_subscriber(keys.sense("r", "b"), answer)
        token = session.show_alive(other, keys.robot_alive("r", "b"))
        beat = session.publisher(other, keys.beat("r", "a"))
        assert token is not None

        def say(tick: int) -> None:
            beat.put(encode(Beat(tick, "a")))

        threading.Timer(0.5, say, [7]).start()
        threading.Timer(0.5 + 2.5 * MANOEUVRE_S, say, [0]).start()  # of an a that has lost its past
        threading.Timer(0.5 + 2.5 * MANOEUVRE_S, say, [500]).start()
        before = time.monotonic()
        end = field.play(10.0, lambda: None)
    assert end.tick == 12
    assert driver.ticks[0][1] - before >= 0.4
    assert [tick for tick, _ in driver.ticks] == list(range(13))
    assert driver.ticks[7][1] - driver.ticks[0][1] < 2 * MANOEUVRE_S
    assert field.missed == 7
    assert inbox.refused["beat"] == 2
    assert len(driver.drives) == 6
