"""Another last manoeuvre: b turns as fast as it can, whatever the placements predict."""

from __future__ import annotations

import tandem
from tandem.planning import Assured, Controls, Mission, Plan, Question


class Hasty(Assured):
    """The planner `assured` with exact sensors, without eq. (8)."""

    def last_manoeuvre(self, question: Question, mission: Mission) -> Plan | None:
        """Return a tight arc."""
        v = mission.first_straight / mission.period
        return Plan(Controls(0.5 * v, 0.5 * mission.max_turn_rate), None, question)


def main() -> None:
    """Compare the ticks of both planners, and check the runs of the new one, also as processes."""
    for seed in range(5):
        runs = [tandem.run("random", seed=seed, planner=one) for one in (Hasty, "assured")]
        print(seed, *[f"{run.outcome} after {run.ticks} ticks" for run in runs])
    run = tandem.run("random", planner=Hasty, processes=True)
    assert run.audit().violations == ()


if __name__ == "__main__":
    main()
