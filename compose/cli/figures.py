"""`tandem figures`: pictures of a record."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from compose.errors import ENDED, FAILED, UserError
from compose.extras import need
from compose.figures import FORMATS, PICTURES
from compose.recording.robots import alone, casts
from compose.recording.run import Recording, agent_journal, legible, read
from compose.terminal.outcome import counting
from protocol.journal.journal_file import CorruptJournal
from protocol.output import say

if TYPE_CHECKING:
    from compose.figures.account import Account
    from compose.figures.pair import PairRecord


def main(options: argparse.Namespace) -> int:
    """Draw each pair of the record; FAILED if a robot has left no journal that can be followed to its end."""
    need("matplotlib")
    with legible(options.recording):
        recording = None if alone(options.recording) else read(options.recording)
        pairs = _casts(options.recording, recording)
    folder, status = options.recording / "figures", ENDED
    kinds = [kind for kind in PICTURES if kind in (options.only or PICTURES)]
    formats = [one for one in FORMATS if one in (options.format or FORMATS)]
    with counting("tandem figures", sum([len(robots) + len(kinds) for robots in pairs])) as done:
        for robots in pairs:
            accounts = {}
            for robot in robots:
                account = _account(options.recording, robot)
                if account is not None:
                    accounts[robot] = account
                if account is None or account.broken is not None:
                    status = FAILED
                done()
            torn = [name for name, one in accounts.items() if one.past is not None and one.past.end is None]
            torn += ["the world"] if recording is not None and recording.end is None else []
            if torn:
                _say(f"the record of {' and '.join(torn)} breaks off before the mission's end")
            pair = _pair(recording, robots, accounts)
            if pair is None:
                _say(f"no picture of {' and '.join(robots)}: nothing is on record")
                status = FAILED
                continue
            try:
                draw(pair, kinds, formats, folder, done, torn=bool(torn))
            except BrokenPipeError:
                raise
            except OSError as error:
                raise UserError(f"{folder} cannot be written: {error.strerror or error}") from None
    return status


def _casts(folder: Path, recording: Recording | None) -> list[tuple[str, ...]]:
    """The robots of each pair, a first; of one that has left a journal, where there was no world."""
    if recording is None:
        return casts(folder)
    robots = recording.scenario.robots
    return [(robots[a].id, robots[b].id) for a, b in recording.scenario.pairs()]


def _pair(
    recording: Recording | None, robots: Sequence[str], accounts: Mapping[str, Account]
) -> PairRecord | None:
    """None of those of whom nothing is known."""
    from compose.figures.pair import of_record, of_robots  # noqa: PLC0415

    if recording is not None:
        places = {robot.id: place for place, robot in enumerate(recording.scenario.robots)}
        return of_record(recording, (places[robots[0]], places[robots[1]]), accounts)
    told = {robot: account for robot, account in accounts.items() if account.past is not None}
    return of_robots(told) if told else None


def draw(
    pair: PairRecord,
    kinds: Sequence[str],
    formats: Sequence[str],
    folder: Path,
    done: Callable[[], None],
    *,
    torn: bool,
) -> None:
    """Print a line for each file that is written, and for each picture that does not apply.

    `done` is called after each kind. `torn`: the record breaks off, and what it lacks may have happened.
    Raises OSError.
    """
    from compose.figures import catalogue, style  # noqa: PLC0415
    from compose.figures.sheet import Absent  # noqa: PLC0415

    folder.mkdir(exist_ok=True)
    for kind in kinds:
        with catalogue.settings(kind):
            for name, figure in catalogue.pictures(pair, kind):
                if isinstance(figure, Absent):
                    _say(f"no {name}: {figure.why}{' (as far as the record goes)' if torn else ''}")
                    continue
                for path in style.save(figure, folder / name, formats):
                    say(str(path))
        done()


def _account(folder: Path, robot: str) -> Account | None:
    """None, and a line that says why, where its journal cannot be read."""
    from compose.figures.account import account  # noqa: PLC0415

    try:
        found = account(folder, robot)
    except FileNotFoundError:
        why = f"{agent_journal(robot)} is missing"
    except OSError as error:
        why = f"{agent_journal(robot)} cannot be read: {error.strerror or error}"
    except CorruptJournal as error:
        why = str(error)
    else:
        if found.broken is not None:
            _say(f"of {robot} only up to where its journal can be followed: {found.broken}")
        return found
    _say(f"no picture of {robot}: {why}")
    return None


def _say(words: str) -> None:
    say(f"tandem figures: {words}", error=True)
