"""The tables of the results of peers.py, for the pages of the documentation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from docs.picture import Source, code_of
from docs.recorded_claims import REGION

DOCS = Path(__file__).parent
RESULTS = DOCS / "peers.json"
DATA = DOCS.parent / "tests" / "data" / "uwb"
TIERS, RAW = DATA / "tiers-first-60-s.pyfg.xz", DATA / "tiers-raw.csv.xz"
FAR_M = 1.0
TANDEM = "Tandem"
HEADLINE = (
    TANDEM,
    "gtsam LM Huber, one random start",
    "gtsam LM Huber, best of 8",
    "gtsam iSAM2, best of 8",
    "scipy, biases, best of 12",
    "particle filter, 50 000 particles",
    "EKF, the likeliest of 4 096",
)
"""The rows of the short table."""


class Trial(NamedTuple):
    """The result of an estimator in a window."""

    recording: str
    ranges: str
    window: str
    estimator: str
    errors_m: tuple[float | None, ...]
    """The distance of each robot from its true position at the end; None without an estimate."""
    nees: tuple[float | None, ...]
    cpu_s: float
    claims: int
    """The number of poses that the robots may claim; only Tandem claims."""


class Results(msgspec.Struct):
    """The content of RESULTS."""

    code: str
    """A hash of the code and of the data that are shipped."""
    environment: str
    packages: dict[str, str]
    trials: list[Trial]


@cache
def results() -> Results:
    """Return the results in RESULTS."""
    return msgspec.json.decode(RESULTS.read_bytes(), type=Results)


HEAD = ("error p50 / p90, m", "more than 1 m off", "NEES, median", "99 % region holds", "CPU", "claims")


def full_table(recording: str) -> str:
    """Return the table of a recording in Markdown: all estimators."""
    chosen = [one for one in results().trials if one.recording == recording]
    return _markdown(("ranges", "estimator", *HEAD), table(chosen))


def short_table() -> str:
    """Return the table of the headline: ranges of TIERS as recorded / those of raw radios in their place."""
    chosen = [one for one in results().trials if one.recording == "TIERS" and one.estimator in HEADLINE]
    as_recorded, raw = (
        table([one for one in chosen if one.ranges == ranges]) for ranges in ("as recorded", "raw radios")
    )
    rows = []
    for (_, name, error, far, _, holds, cpu, _), (_, _, *other) in zip(as_recorded, raw, strict=True):
        errors = [one.partition(" / ")[0] for one in (error, other[0])]
        rows.append([name, *map(" / ".join, (errors, (far, other[1]), (holds, other[3]), (cpu, other[4])))])
    return _markdown(
        ("estimator", "median error, m", "more than 1 m off", "99 % region holds the truth", "CPU"), rows
    )


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *rows))


def table(trials: Iterable[Trial]) -> list[list[str]]:
    """Return the rows of a table: one for each case and estimator."""
    cases: dict[tuple[str, str], dict[str, list[Trial]]] = {}
    for one in trials:
        cases.setdefault((one.recording, one.ranges), {}).setdefault(one.estimator, []).append(one)
    rows = []
    for (recording, ranges), by_estimator in cases.items():
        usual = sum(one.cpu_s for one in by_estimator[TANDEM])
        for name, own in by_estimator.items():
            errors = np.array([math.inf if one is None else one for trial in own for one in trial.errors_m])
            nees = np.array([math.inf if one is None else one for trial in own for one in trial.nees])
            case = f"{recording}, {ranges}: {len(errors)} poses" if name == TANDEM else ""
            p50, p90 = np.quantile(errors, (0.5, 0.9), method="higher")
            rows.append(
                [
                    *(case, f"**{name}**" if name == TANDEM else name, f"{_short(p50)} / {_short(p90)}"),
                    f"{100.0 * np.mean(errors > FAR_M):.0f} %",
                    _short(float(np.median(nees))),
                    f"{100.0 * np.mean(nees <= REGION):.0f} %",
                    f"{sum(one.cpu_s for one in own) / usual:.2g}",
                    str(sum(one.claims for one in own)) if name == TANDEM else "-",
                ]
            )
    return rows


def _short(value: float) -> str:
    if math.isinf(value):
        return "none"
    return f"{value:.2f}" if value < 10 else f"{value:.0f}" if value < 1e4 else f"{value:.0e}"


def code_hash() -> str:
    """Return a hash of the code of the comparison, and of the data that are shipped."""
    code = tuple(
        [
            path.relative_to(DOCS.parent).as_posix()
            for path in (DOCS / "peers.py", DOCS / "peer_estimators.py", TIERS, RAW)
        ]
    )
    return code_of(Source({}, code, lambda *_: None, lambda _: {}), "peers")
