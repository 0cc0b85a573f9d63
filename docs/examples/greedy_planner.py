"""A planner of one's own: an information-greedy baseline, compared with the shipped planners.

`uv run docs/examples/greedy_planner.py [FILE]` writes the figure to FILE (planners.png). In phase 3 the
robots drive to where the next ranges alone tell most about the most probable hypothesis. `assured` also looks
further ahead, and tells hypotheses apart.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

import tandem
from tandem.planning import Assured, Controls, Mission, PlanningHypothesis, Pose, step


class Greedy(Assured):
    """The phases of `assured` with noisy sensors, and greedy manoeuvres in contact with the peer."""

    def __init__(self, turns: int = 9) -> None:
        """`turns` is the number of turn rates that are compared."""
        self.turns = turns

    def joint_manoeuvres(
        self,
        hypotheses: Sequence[PlanningHypothesis],
        m2: tuple[float, float],
        rho: float,
        mission: Mission,
    ) -> tuple[Controls, Controls]:
        """Return the manoeuvres of a and b after which one range of each kind gives most information."""
        del rho  # for a safety distance, which this planner does not keep
        likeliest, reach = hypotheses[0], 0.9 * mission.sensing_range
        v = mission.first_straight / mission.period
        fastest = min(mission.max_turn_rate, np.pi / mission.period)
        ways = [
            Controls(speed, float(rate))
            for speed in (v, 0.5 * v, -0.5 * v, -v)
            for rate in np.linspace(-fastest, fastest, self.turns)
        ]
        a, b = (Pose(*map(float, likeliest.poses[i : i + 3])) for i in (0, 3))
        ends = [[step(pose, way.v, way.omega, mission.period) for way in ways] for pose in (a, b)]
        first, second = (np.array([(end.x, end.y) for end in some]) for some in ends)
        apart = second[None] - first[:, None]
        distance = np.maximum(np.hypot(apart[..., 0], apart[..., 1]), 1e-6)
        slope = np.zeros((len(ways), len(ways), 6))
        slope[..., 3:5] = apart / distance[..., None]
        slope[..., 0:2] = -slope[..., 3:5]
        gain = _gain(slope, likeliest.covariance, mission.noise.mutual_sigma)
        from_anchor = second - np.array(m2)
        home = np.maximum(np.hypot(from_anchor[:, 0], from_anchor[:, 1]), 1e-6)
        slope = np.zeros((1, len(ways), 6))
        slope[..., 3:5] = from_anchor / home[:, None]
        gain = gain + _gain(slope, likeliest.covariance, mission.noise.anchor_sigma)
        gain = np.where((distance > reach) | (home > reach), -distance - home, gain)
        i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
        return ways[int(i)], ways[int(j)]


def _gain(slope: np.ndarray, covariance: np.ndarray, sigma: float) -> np.ndarray:
    """Return the information in nats of a range whose derivatives by the six coordinates are `slope`."""
    variance = np.einsum("...i,ij,...j", slope, covariance, slope)
    return np.asarray(0.5 * np.log1p(variance / max(sigma, 1e-3) ** 2))


def main(file: str = "planners.png", trials: int = 200, workers: int | None = None) -> None:
    """Run the same `trials` missions with each planner, and draw the distributions of their ticks."""
    planners = {"assured": "assured", "greedy": Greedy, "paper": "paper"}
    results = tandem.sweep("noisy", {"planner.name": [*planners.values()]}, trials=trials, workers=workers)
    figure = Figure(figsize=(5.0, 3.5), layout="constrained")
    axes = figure.subplots()
    for cell, name in enumerate(planners):
        ticks = np.sort(results.trials.where(cell=cell, outcome="localised")["ticks"])
        axes.step([0, *ticks], np.arange(len(ticks) + 1) / trials, where="post", label=name)
        print(f"{name}: {len(ticks)} of {trials} localised, median {np.median(ticks) if len(ticks) else '-'}")
    less = results.differences
    for i, name in enumerate([*planners][1:]):
        mean, low, high = (less[column][i] for column in ("ticks", "ticks_low", "ticks_high"))
        pairs = less["both_localised"][i]
        found = f"{mean:+.1f} ticks ({low:+.1f} to {high:+.1f}), {pairs} pairs"
        print(f"{name} - assured:", found if pairs else "no pair localised")
    axes.set(xlabel="ticks", ylabel="part of missions that are localised", ylim=(0, 1))
    axes.legend()
    figure.savefig(file)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "planners.png")
