"""The meetings of a group: which one each robot is in, tick by tick, as its commands show.

A robot goes on to its next meeting with a command of the state "travelling", once the robot that it has met
has a verdict. It may travel to the same robot again if it has lost contact with it before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from compose.recording.run import Run
from compose.recording.run_setup import RunSetup
from protocol.messages import Command

TRAVELLING = "travelling"
"""The state of a robot that drives to the next robot of its group."""

Meetings = Mapping[str, int]
"""The number of meetings that each robot has left; robots in their first meeting may be absent."""


def meetings_after(
    setup: RunSetup,
    meetings: Meetings,
    earlier: Mapping[str, Command],
    commands: Mapping[str, Command],
) -> Meetings:
    """Return the meetings in a tick with `commands`; `meetings` are those before, `earlier` the last commands.

    Without an earlier command of a robot, for a viewer that has missed the start, its meeting is the first one
    whose peer has no verdict yet.
    """
    changed = {}
    for robot, partners in setup.partners.items():
        command = commands.get(robot)
        if command is None or len(partners) == 1:
            continue
        now = meetings.get(robot, 0)
        if robot not in earlier and command.tick > 0:
            changed[robot] = _unmet(partners, commands, command)
        elif command.state == TRAVELLING and now + 1 < len(partners):
            before = earlier.get(robot)
            goes_on = before is None or before.state != TRAVELLING
            if goes_on and (now == 0 or _has_verdict(partners[now], earlier)):
                changed[robot] = now + 1
    return {**meetings, **changed} if changed else meetings


def meeting_begins(run: Run) -> dict[str, tuple[int, ...]]:
    """Return the ticks in which the meetings of each robot begin, as far as the run has them.

    A meeting begins when the robot leaves for it, and the first one in tick 0. Empty if the robots are pairs.
    """
    setup = run.setup
    if setup is None or not setup.visits:
        return {}
    begins: dict[str, tuple[int, ...]] = dict.fromkeys(setup.ids, (0,))
    meetings: Meetings = {}
    latest: dict[str, Command] = {}
    for tick in range(run.length):
        found = {robot: run.command(robot, tick) for robot in setup.ids}
        commands = {robot: command for robot, command in found.items() if command is not None}
        after = meetings_after(setup, meetings, latest, commands)
        for robot in after:
            if after[robot] != meetings.get(robot, 0):
                begins[robot] = (*begins[robot], tick)
        meetings, latest = after, {**latest, **commands}
    return begins


def _unmet(partners: Sequence[str], commands: Mapping[str, Command], own: Command) -> int:
    """Return the meeting of a robot of which only the present command is known."""
    if own.verdict is None:
        return 0
    met = next((i for i, peer in enumerate(partners) if not _has_verdict(peer, commands)), len(partners) - 1)
    return met if own.state == TRAVELLING or own.phase == 3 else max(0, met - 1)


def _has_verdict(robot: str, commands: Mapping[str, Command]) -> bool:
    command = commands.get(robot)
    return command is not None and command.verdict is not None
