"""The `assured` planner: it handles the failure cases of the paper, with exact and with noisy sensors.

With exact sensors, it follows the paper's phases with more manoeuvres to choose from, until one placement is
left and a redundant range has confirmed it. With noisy sensors, it measures until the poses are as accurate
as the mission asks, in the phases of the paper (`phase1_anchor`, `phase2_orbit`, `phase3_encounter`).
"""

from __future__ import annotations

from agent.planning import drive, phase1_anchor, phase2_orbit, phase3_encounter, tasks
from agent.planning.exchange import LogPlanner, Steps
from agent.planning.phase3_last_manoeuvre import LAST_SPEEDS
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from protocol.messages import Command
from protocol.motion import REST


class Assured(LogPlanner):
    """The planner `assured`. Subclasses may plan other manoeuvres of phase 3, and choose a `SOLVER`."""

    MANOEUVRES = Manoeuvres(
        directions=(1.0, -1.0), sides=(1.0, -1.0), last_speeds=LAST_SPEEDS, fewest_out_of_range=True
    )
    """Both ways, to both sides in phase 1, and at several speeds."""
    DEAD_RECKONED = Steps(
        phase1_anchor.unranged, phase1_anchor.until_accurate, phase2_orbit.continued, phase3_encounter.met
    )
    """The paper's steps, with more manoeuvres to choose from."""
    CORRECTED = Steps(
        phase1_anchor.still_unranged, phase1_anchor.surveyed, phase2_orbit.surveyed, phase3_encounter.surveyed
    )
    ACTIVE_SENSING = True

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        return drive.command(state, REST if _must_wait(state) else drive.controls(state))


def _must_wait(state: RobotState) -> bool:
    """Return whether the robot stands still, in range of a peer with which phase 3 cannot begin yet.

    The peer is then in phase 1, or none of its reports has been received, or it is b and too near its anchor.
    """
    return (
        state.in_contact
        and (state.peer_state.start is None or state.config.role == "a")
        and isinstance(state.task, tasks.Orbital | tasks.Travelling)
    )
