"""One caption of a mission, and the words that captions share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec

from compose.view.pair_data import PairData

CaptionKind = Literal[
    "rules", "ranging", "mirrored", "branch", "path", "search", "contact", "contact-lost", "configurations",
    "manoeuvre", "measured", "ruled-out", "claim", "undecided", "inconsistent", "report-lost", "process",
    "end",
]  # fmt: skip
COUNTS = (
    "no",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
)
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


def attacked(pair: PairData, reports: str) -> str | None:
    """Return a sentence about the attackers; None if there are none. `reports` is its verb."""
    attackers = [robot.id for robot in pair.robots if robot.attack is not None]
    return f"{listed(attackers)} {reports} false data about itself." if attackers else None
