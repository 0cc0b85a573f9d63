"""The record of a run: what its journals hold, and the views of it that a run leaves behind."""

from __future__ import annotations

import csv
import io
import math
import platform
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
from msgspec.structs import astuple

from compose.claim import Claim, claim, matrix
from compose.installed import version
from compose.status import UserError
from protocol import journal
from protocol.messages import Drive, End, Estimate, Farewell, Localised, Outcome
from protocol.motion import Pose, wrap
from world.history import history, scenario_of
from world.scenario import Scenario
from world.sensors import anchor_ranges, executed, mutual_ranges
from world.truth import Truth, asked

if TYPE_CHECKING:
    from agent.past import Past

Mode = Literal["processes", "in-process"]
WORLD_JOURNAL = "world.journal"
SUMMARY = "summary.json"


def agent_journal(robot: str) -> str:
    """The name of the file that `robot` keeps its record in."""
    return f"agent-{robot}.journal"


def robot_of(path: Path) -> str:
    """Whose record an agent's journal is, by its name."""
    return path.stem.removeprefix("agent-")


def journals_in(folder: Path) -> list[Path]:
    """Those of a record that are there, the world's first."""
    world = folder / WORLD_JOURNAL
    return [*([world] if world.exists() else []), *sorted(folder.glob(agent_journal("*")))]


@contextmanager
def folder_for(out: Path | None) -> Iterator[Path]:
    """Where a record goes: `out`, or a folder that is gone afterwards. Raises UserError."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
            yield Path(folder)
        return
    make(out)
    yield out


def make(out: Path) -> None:
    """See to it that `out` is a folder that can be written. Raises UserError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UserError(cannot_write(out, error)) from None


def cannot_write(out: Path, error: OSError) -> str:
    """What to tell the user of `error`."""
    return f"--out: {out} cannot be written: {error.strerror or error}"


class Moment(msgspec.Struct, frozen=True):
    """One tick: where everyone was, and what everyone then set out to do."""

    truth: Truth
    drives: dict[str, Drive]


class Record(msgspec.Struct, frozen=True):
    """A run, whole."""

    scenario: Scenario
    moments: tuple[Moment, ...]
    end: End | None
    """none if the record breaks off"""
    farewells: dict[str, Farewell]


class Book(msgspec.Struct, frozen=True):
    """A journal, as it is found."""

    frames: list[bytes]
    torn: int
    """bytes of a torn write behind them"""


def books(folder: Path, *, alone: bool = False) -> dict[str, Book]:
    """Every journal of the record in `folder`, by its name; the world's is the first.

    With `alone`, there need not be one if there are robots'.

    Raises OSError if that is not there or one cannot be read, journal.CorruptJournal where something stands
    that is no frame.
    """
    names = sorted([path.name for path in folder.glob(agent_journal("*"))])
    if not names or not alone or (folder / WORLD_JOURNAL).exists():
        names.insert(0, WORLD_JOURNAL)
    return {name: Book(*journal.torn(folder / name)) for name in names}


def read(folder: Path) -> Record:
    """The record of the run in `folder`: its world's journal, folded.

    Raises OSError if there is none, journal.CorruptJournal if it is damaged before its end.
    """
    path = folder / WORLD_JOURNAL
    told = history(journal.read(path), path)
    if told.disorder is not None:
        raise journal.CorruptJournal(f"{path}: {told.disorder.what}")
    moments = tuple([Moment(tick.world.truth, tick.drives) for tick in told.ticks])
    return Record(told.scenario, moments, told.end, told.farewells)


def estimates(folder: Path, robot: str) -> tuple[Estimate, ...]:
    """What `robot` held possible, tick by tick: of its own journal in the record in `folder`.

    Raises OSError if there is none, journal.CorruptJournal if it is damaged before its end, or another's.
    """
    told = past_of(folder, robot)
    return told.estimates if told is not None else ()


def past_of(folder: Path, robot: str) -> Past | None:
    """What `robot` journaled in the record in `folder`; None if it was killed before it was briefed.

    Raises like `estimates`.
    """
    from agent.past import past  # noqa: PLC0415  # whoever launches, and reads how it went, needs no planner

    path = folder / agent_journal(robot)
    frames = list(journal.read(path))
    if not frames:
        return None
    told = past(frames, path)
    if told.briefing.robot != robot:
        raise journal.CorruptJournal(f"{path} is the journal of {told.briefing.robot}")
    world = folder / WORLD_JOURNAL
    first = next(iter(journal.read(world)), None) if world.exists() else None
    if first is not None and not scenario_of(first, world).is_of(told.briefing):
        raise journal.CorruptJournal(f"{path}: another run's: its briefing is not this world's")
    return told


@contextmanager
def legible(folder: Path) -> Iterator[None]:
    """Whatever keeps the record in `folder` from being read is a line for the user. Raises UserError."""
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"{folder} holds no record: there is no {WORLD_JOURNAL}") from None
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except journal.CorruptJournal as error:
        raise UserError(str(error)) from None


class Row(msgspec.Struct, frozen=True):
    """One robot in one tick, as `ticks.csv` has it; what is none is an empty field there."""

    tick: int
    robot: str
    x: float | None
    """true; none where there was no world to know it"""
    y: float | None
    heading: float | None
    """in (-pi, pi]"""
    v: float | None
    """driven until the next tick; none in the last"""
    omega: float | None
    anchor_range: float | None
    mutual_range: float | None
    phase: int | None
    state: str | None

    @property
    def pose(self) -> Pose | None:
        """The true one."""
        if self.x is None or self.y is None or self.heading is None:
            return None
        return Pose(self.x, self.y, self.heading)


def rows(record: Record) -> Iterator[Row]:
    """One per tick and robot, tick 0 included."""
    scenario = record.scenario
    last = record.moments[-1].truth.tick if record.moments else 0
    for moment in record.moments:
        tick = moment.truth.tick
        anchor = anchor_ranges(moment.truth, scenario)
        mutual = _mutual(scenario, moment.truth)
        for i, (robot, pose) in enumerate(zip(scenario.robots, moment.truth.poses, strict=True)):
            drive = moment.drives.get(robot.id)
            v = omega = None
            if tick != last:
                done = executed(asked(drive, scenario.mission), scenario, robot.id, tick)
                v, omega = done.v, done.omega
            yield Row(
                *(tick, robot.id, pose.x, pose.y, wrap(pose.heading), v, omega),
                *(anchor[i], mutual.get(robot.id)),
                *((drive.phase, drive.state) if drive is not None else (None, None)),
            )


def ticks_csv(record: Record) -> str:
    """One row per tick and robot."""
    return table(rows(record))


def table(rows: Iterable[Row]) -> str:
    """`rows` as `ticks.csv` has them: floats in their shortest exact form."""
    out = io.StringIO()
    written = csv.writer(out, lineterminator="\n")
    written.writerow(Row.__struct_fields__)
    written.writerows([["" if one is None else one for one in astuple(row)] for row in rows])
    return out.getvalue()


def _mutual(scenario: Scenario, truth: Truth) -> dict[str, float]:
    """Everyone's range to its peer, if there is one."""
    pairs = scenario.pairs()
    return {
        scenario.robots[i].id: mutual.range
        for pair, mutual in zip(pairs, mutual_ranges(truth, scenario, pairs), strict=True)
        if mutual is not None and mutual.range is not None
        for i in pair
    }


def summary(record: Record, mode: Mode, wall_s: float | None) -> dict[str, Any]:
    """What `summary.json` says; what does not apply is None."""
    scenario, moments = record.scenario, record.moments
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "mode": mode,
        "outcome": record.end.outcome if record.end is not None else "failed",
        "reason": record.end.reason if record.end is not None else "the record breaks off",
        "ticks": moments[-1].truth.tick if moments else 0,
        "wall_s": wall_s,
        "first_contact_tick": first_contact(record),
        "t_max_s": max(robot.rendezvous.bound for robot in scenario.robots),
        "min_separation_m": min(
            (
                math.hypot(one.x - other.x, one.y - other.y)
                for moment in moments
                for one, other in combinations(moment.truth.poses, 2)
            ),
            default=None,
        ),
        "parameters": {
            **msgspec.to_builtins(scenario.mission),
            "variant": scenario.variant,
            "max_ticks": scenario.max_ticks,
        },
        "versions": versions(),
        "robots": {robot.id: _robot_summary(record, i) for i, robot in enumerate(scenario.robots)},
    }


def first_contact(record: Record) -> int | None:
    """The first tick at which two peers were in range of each other."""
    pairs = record.scenario.pairs()
    for moment in record.moments:
        if any(mutual is not None for mutual in mutual_ranges(moment.truth, record.scenario, pairs)):
            return moment.truth.tick
    return None


def first_claim(record: Record, place: int) -> Claim | None:
    """The first claim to know its pose of the robot at that place in the scenario."""
    robot = record.scenario.robots[place].id
    for moment in record.moments:
        drive = moment.drives.get(robot)
        if drive is not None and isinstance(drive.verdict, Localised):
            return claim(moment.truth.tick, drive.verdict, moment.truth.poses[place])
    return None


def _robot_summary(record: Record, place: int) -> dict[str, Any]:
    robot = record.scenario.robots[place].id
    farewell = record.farewells.get(robot)
    claimed = first_claim(record, place)
    covariance = claimed.covariance if claimed is not None else None
    return {
        "localised": claimed is not None,
        "localised_tick": claimed.tick if claimed is not None else None,
        "estimate": _listed(claimed.pose) if claimed is not None else None,
        "covariance": matrix(covariance) if covariance is not None else None,
        "truth": _listed(record.moments[-1].truth.poses[place]) if record.moments else None,
        "position_error_m": claimed.position_error if claimed is not None else None,
        "heading_error_rad": claimed.heading_error if claimed is not None else None,
        "position_sigma_m": covariance.position_sigma if covariance is not None else None,
        "heading_sigma_rad": covariance.heading_sigma if covariance is not None else None,
        "nees": claimed.nees if claimed is not None else None,
        **{field: getattr(farewell, field, None) for field in _SAID},
        "deadlines_missed": sum([robot not in moment.drives for moment in record.moments[:-1]]),
    }


_SAID = [field for field in Farewell.__struct_fields__ if field != "robot"]


def _listed(pose: Pose) -> list[float]:
    return [pose.x, pose.y, wrap(pose.heading)]


@cache
def versions() -> dict[str, str | None]:
    """Of everything that a run's figures may depend on."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("tandem-ranging", "eclipse-zenoh", "numpy", "scipy", "msgspec", "msgpack"):
        found[package] = version(package)
    return found


def leave(record: Record, summary: Mapping[str, Any], folder: Path) -> None:
    """Write `ticks.csv` and `summary.json` into `folder`."""
    (folder / "ticks.csv").write_text(ticks_csv(record), encoding="utf-8")
    (folder / SUMMARY).write_bytes(msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")


def outcome_line(summary: Mapping[str, Any]) -> str:
    """The outcome, in one line."""
    return ended(summary["outcome"], summary["ticks"], summary["reason"])


def ended(outcome: Outcome, ticks: int, reason: str | None) -> str:
    """How a run ended, in one line."""
    return f"{outcome} after {ticks} ticks{f' ({reason})' if reason else ''}"
