"""Scenes of the run in a recording."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from compose.errors import UserError
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal, robot_of
from compose.recording.run import Run
from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.captions import Caption
from compose.view.run_data import RunData
from compose.view.scene import Scene, scene
from protocol.motion import Pose, compose, inverse


def run_data(run: Run) -> RunData:
    """Return the data of a recording. The world's journal takes precedence over those of the agents."""
    known = RunData()
    if run.world is not None:
        for tick in run.world.ticks:
            known.add_tick(tick)
        if run.world.ahead is not None:
            known.add_world(run.world.ahead)
    for name, journal in run.journals.items():
        if name != WORLD_JOURNAL:
            for message in journal.messages:
                known.add(message, robot_of(name))
    if run.world is not None:
        known.add_observations(run.world.worlds)
    if run.end is not None:
        known.conclude(run.end)
    known.final_reports.update(run.final_reports)
    known.add_kills(run.kills)
    return known


def scenes_of(run: Run) -> tuple[Scene, ...]:
    """Return the scenes of a recording; none if no journal has a configuration."""
    return scenes(run.setup, run_data(run)) if run.setup is not None else ()


def scenes(setup: RunSetup, known: RunData, first: int = 0, last: int | None = None) -> tuple[Scene, ...]:
    """Return the scenes of the known ticks from `first` to `last`, inclusive."""
    last = known.last if last is None else min(last, known.last)
    paths = reported_paths(setup, known, last)
    shown = []
    for tick in known.between(first, last):
        before, now = known.ticks.get(tick - 1), known.ticks[tick]
        reported = {robot: path[tick] for robot, path in paths.items() if tick < len(path)}
        found = scene(known.setup_at(setup, tick), before, now, known.end, reported)
        if known.end is not None and tick == known.end.tick and known.costs:
            cost = Caption("cost", "", truth=" ".join(known.costs))
            found = replace(found, captions=(*found.captions, cost))
        shown.append(found)
    return tuple(shown)


def checked(run: Run) -> tuple[Sequence[str], RunSetup]:
    """Return all robots of `run`, also those without a journal, and its static data.

    Raises OSError or CorruptJournal if a journal cannot be read to its end, UserError if there is no
    configuration.
    """
    run.readable(*run.journals)
    for robot in run.robots:
        if agent_journal(robot) in run.journals:
            run.agent(robot)
    setup = run.setup
    if setup is None:
        raise UserError(
            f"{run.source}: there is no {WORLD_JOURNAL}, and no robot's journal has a configuration"
        )
    peers = [one.peer for one in setup.robots if one.peer is not None and run.world is None]
    return list(dict.fromkeys([*run.robots, *sorted(peers)])), setup


# --- the paths that attackers report ----------------------------------------------------------------

LAST_DRAWN_TICK = 100_000
"""The largest tick up to which a path is computed: a frame may report any number of ticks."""


def reported_paths(setup: RunSetup, known: RunData, last: int) -> dict[str, Sequence[Pose]]:
    """Return the reported poses in <W> of each attacker, from tick 0 to at most `last`.

    A path has the reported manoeuvres, from the reported start in the attacker's true anchor frame. There is
    none without the ground truth of tick 0 or before the first report. Headings are not wrapped.
    """
    paths: dict[str, Sequence[Pose]] = {}
    for robot in setup.robots:
        start, log = _reported_start(robot, known), known.reported_logs.get(robot.id)
        if start is not None and log is not None:
            end = min(last, log.through, LAST_DRAWN_TICK)
            paths[robot.id] = log.track(start, 0, end, setup.mission.period)
    return paths


def _reported_start(robot: RobotSetup, known: RunData) -> Pose | None:
    first = known.ticks.get(0)
    true = first.truth.get(robot.id) if first is not None else None
    if robot.attack is None or robot.frame is None or true is None:
        return None
    from agent.peer import false_reports  # noqa: PLC0415  # the agent's code, for attackers only

    local = compose(inverse(robot.frame), true)
    return compose(robot.frame, false_reports.start(local, robot.attack))
