"""`tandem figures`: draw the figures of a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from compose.cli.recording import read_noted
from compose.errors import ENDED, FAILED, writing
from compose.extras import need
from compose.figures import FIGURE_FORMATS, PICTURES
from compose.recording.recording_files import agent_journal, user_errors
from compose.recording.run import Run
from compose.terminal.outcome import counting
from protocol import files
from protocol.journal.journal_file import CorruptJournal
from protocol.output import say

if TYPE_CHECKING:
    from compose.figures.agent_replay import AgentReplay
    from compose.figures.catalogue import Picture
    from compose.figures.pair import PairRecord
    from compose.figures.style import Medium
    from compose.recording.group_localisation import PastMeeting


def main(options: argparse.Namespace) -> int:
    """Draw each pair of the recording, or its team, into DIR/figures.

    Return FAILED if the journal of a robot is missing or cannot be replayed to its end.
    """
    need("matplotlib")
    from compose.figures import catalogue, style, team_figures  # noqa: PLC0415
    from compose.figures.pair import encounters  # noqa: PLC0415

    with user_errors(options.recording):
        run = read_noted(options.recording, "figures")
    folder, status = options.out or options.recording / "figures", ENDED
    medium = (style.PAPER if options.paper else style.SCREEN)._replace(keyed=not options.no_legend)
    kinds = [kind for kind in PICTURES if kind in (options.only or PICTURES)]
    formats = [one for one in FIGURE_FORMATS if one in (options.format or FIGURE_FORMATS)]
    pairs = encounters(run)
    replays: dict[str, AgentReplay] = {}
    team = run.setup is not None and run.setup.team
    paired = dict.fromkeys(run.robots if team else [robot for one in pairs for robot in (one.a, one.b)])
    drawn: list[Path] = []
    with ExitStack() as stack:
        stack.callback(
            lambda: say(*map(str, drawn)) if drawn else None
        )  # a reader may leave at the first line
        done = stack.enter_context(counting("tandem figures", len(paired) + len(pairs) * len(kinds)))
        for robot in paired:
            replay = _replay(run, robot)
            if replay is not None:
                replays[robot] = replay
            if replay is None or replay.broken is not None:
                status = FAILED
            done()
        if team:
            if others := [kind for kind in kinds if kind not in team_figures.DRAWN]:
                _say(
                    f"no {', '.join(others)}: the robots of a team share all measurements, and form no pairs"
                )
            torn = run.world is None or run.world.end is None
            for kind in kinds:
                drawn += draw(
                    partial(catalogue.of_team, run, kind), formats, folder, torn=torn, medium=medium
                )
        for meeting in pairs:
            pair, early = _pair(run, meeting, replays)
            if pair is None:
                status = FAILED
                continue
            for kind in kinds:
                pictures = partial(catalogue.pictures, pair, kind)
                drawn += draw(pictures, formats, folder, torn=early, medium=medium)
                done()
    return status


def draw(
    pictures: Callable[[Medium], Iterable[Picture]],
    formats: Sequence[str],
    folder: Path,
    *,
    torn: bool,
    medium: Medium,
) -> list[Path]:
    """Save the figures of one kind, print why one does not apply, and return the paths of the files.

    `torn` states that the recording is incomplete, so that an event that it lacks may have happened.
    Raises UserError if they cannot be written.
    """
    from compose.figures import style  # noqa: PLC0415
    from compose.figures.sheet import Absent  # noqa: PLC0415

    paths: list[Path] = []
    with writing(folder), style.look(medium):
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in pictures(medium):
            if isinstance(figure, Absent):
                _say(f"no {name}: {figure.why}{' (in the incomplete recording)' if torn else ''}")
            else:
                paths += style.save(figure, folder / name, formats, medium.dpi)
                if not medium.keyed:
                    paths.append(folder / f"{name}.txt")
                    files.write(paths[-1], f"{figure.get_label()}\n")
    return paths


def _pair(
    run: Run, meeting: PastMeeting, replays: Mapping[str, AgentReplay]
) -> tuple[PairRecord | None, bool]:
    """Return the data of a meeting, and whether its recording is incomplete; print what is missing."""
    from compose.figures.pair import pair_of  # noqa: PLC0415

    robots = dict.fromkeys((meeting.a, meeting.b))
    histories = {robot: replays[robot].history for robot in robots if robot in replays}
    torn = [robot for robot, one in histories.items() if one is not None and one.end is None]
    torn += ["the world"] if run.world is not None and run.world.end is None else []
    if torn:
        _say(f"the recording of {' and '.join(torn)} ends before the mission does")
    if (pair := pair_of(run, meeting, replays)) is None:
        _say(f"no figure of {' and '.join(robots)}: the recording has no data")
    return pair, bool(torn)


def _replay(run: Run, robot: str) -> AgentReplay | None:
    """Return the replay of a robot; print why and return None if its journal cannot be read."""
    from compose.figures.agent_replay import agent_replay  # noqa: PLC0415

    try:
        found = agent_replay(run, robot)
    except FileNotFoundError:
        why = f"{agent_journal(robot)} is missing"
    except OSError as error:
        why = f"{agent_journal(robot)} cannot be read: {error.strerror or error}"
    except CorruptJournal as error:
        why = str(error)
    else:
        if found.broken is not None:
            _say(f"figures of {robot} end where its journal cannot be replayed: {found.broken}")
        return found
    _say(f"no figure of {robot}: {why}")
    return None


def _say(words: str) -> None:
    say(f"tandem figures: {words}", error=True)
