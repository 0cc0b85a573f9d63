"""The `paper` planner: the algorithm as published, with exact and with noisy sensors.

With noisy sensors, the planner continues with the most probable branch and claims a pose only if it meets the
mission's requirements. The few ranges that the paper's manoeuvres collect are mostly not enough, and never
with outliers. The verdict Undecided then states what is missing.
"""

from __future__ import annotations

from agent.planning import phase1_anchor, phase2_orbit, phase3_encounter
from agent.planning.exchange import LogPlanner, Steps
from agent.planning.planner import Manoeuvres
from protocol.mission import Mission
from protocol.orbits import Rendezvous, rendezvous


class Paper(LogPlanner):
    """The algorithm as published. Subclasses may plan another last manoeuvre."""

    MANOEUVRES = Manoeuvres(directions=(1.0,), sides=(1.0,), last_speeds=None, fewest_out_of_range=False)
    """Forward, to the left in phase 1, and at v_max."""
    DEAD_RECKONED = Steps(
        phase1_anchor.unranged,
        phase1_anchor.as_published,
        phase2_orbit.continued,
        phase3_encounter.met_on_orbits,
        phase3_encounter.as_published,
    )
    CORRECTED = DEAD_RECKONED._replace(unranged=lambda state: state)
    """A first range may be missing by chance."""

    def rendezvous(self, mission: Mission, distance: float) -> Rendezvous:
        """Return the orbits of eq. (6)."""
        return rendezvous(mission, distance, "paper")
