"""One caption of a mission, and the words that captions share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import msgspec

from compose.recording.run_setup import RobotSetup
from compose.view.events import Event
from compose.view.pair_data import PairData
from protocol.messages import Inconsistent, Undecided

CaptionKind = Literal[
    "rules", "ranging", "mirrored", "branch", "path", "search", "contact", "contact-lost", "configurations",
    "manoeuvre", "measured", "ruled-out", "claim", "undecided", "inconsistent", "down", "back", "late",
    "report-lost", "report-damaged", "report-late", "report-doubled", "end",
]  # fmt: skip
FAULTS: dict[CaptionKind, str] = {
    "down": "processes are gone",
    "back": "processes are back",
    "late": "deadlines are missed",
    "report-lost": "reports are lost",
    "report-damaged": "reports arrive damaged",
    "report-late": "reports arrive late",
    "report-doubled": "reports arrive more than once",
}
"""The kinds of captions about kills and faults, which are kinds of events, and words for several of these."""
MOST_TOLD = 2
"""The largest number of events of one kind that a caption tells one by one."""
COUNTS = (
    "no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve",
)  # fmt: skip
"""Small numbers as words."""


class Caption(msgspec.Struct, frozen=True, omit_defaults=True):
    """One caption. Several captions of a tick are shown one after the other."""

    kind: CaptionKind
    text: str
    robots: tuple[str, ...] = ()
    """The pair that the caption is about; empty if it is about all robots."""
    truth: str | None = None
    """A further sentence that follows from the ground truth or the scenario only; None if there is none."""


def count_word(number: int) -> str:
    """Return a number as a word, if it is small."""
    return COUNTS[number] if number < len(COUNTS) else str(number)


def listed(robots: Sequence[str]) -> str:
    """Return the ids of robots, joined by "and"."""
    return " and ".join(robots)


def stopped(text: str) -> str:
    """Return `text` as the end of a sentence."""
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def sentence(text: str) -> str:
    """Return `text` as a sentence."""
    return stopped(text[0].upper() + text[1:])


def faults(events: Sequence[Event], robots: tuple[str, ...] | None = None) -> Iterator[Caption]:
    """Yield a caption for each kind of kills and faults among the events of a tick.

    It is about `robots`; without them, about those of its events.
    """
    for kind, several in FAULTS.items():
        found = [one for one in events if one.kind == kind]
        if found:
            many = f"{count_word(len(found)).capitalize()} {several}."
            text = many if len(found) > MOST_TOLD else " ".join([stopped(one.text) for one in found])
            whom = tuple(sorted({one.robot for one in found if one.robot is not None}))
            yield Caption(kind, text, whom if robots is None else robots)


def attacked(pair: PairData, reports: str) -> str | None:
    """Return a sentence about the attackers; None if there are none. `reports` is its verb."""
    attackers = [robot.id for robot in pair.robots if robot.attack is not None]
    return f"{listed(attackers)} {reports} false data about itself." if attackers else None


def without_claim(
    robot: RobotSetup, verdict: Undecided | Inconsistent, truth: str | None = None
) -> tuple[CaptionKind, str, str | None]:
    """Return kind and text for a robot that ends without a claim, and `truth` for a contradiction."""
    match verdict:
        case Undecided(reason):
            return "undecided", f"{robot.id} stops without a claim: {stopped(reason)}", None
        case Inconsistent(what):
            text = f"{robot.id} finds that the reports of {robot.peer} contradict what it measured: "
            return "inconsistent", text + stopped(what), truth
