"""The path that an attacker reports about itself, beside the true one."""

from __future__ import annotations

from collections.abc import Sequence

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.run_data import RunData
from protocol.motion import Pose, compose, inverse

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
