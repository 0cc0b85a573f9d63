"""What random starts do at Section IV's parameters: `uv run docs/random_starts.py [STARTS]` (5000)."""

from __future__ import annotations

import sys
from collections import Counter
from statistics import quantiles

from rich.progress import track

from compose import inline, record, scenario


def main(starts: int) -> None:
    """Play them in this process, both variants, and print what came of it."""
    for variant in ("assured", "paper"):
        text = scenario.shipped()["random"].read_text() + f'\n[planner]\nvariant = "{variant}"\n'
        outcomes: Counter[str] = Counter()
        ticks: list[int] = []
        worst = 0.0
        for seed in track(range(starts), variant, transient=True):
            summary = record.summary(
                inline.play(scenario.parse(text, "random", seed=seed)), "in-process", None
            )
            outcomes[summary["outcome"]] += 1
            ticks.append(summary["ticks"])
            errors = [robot["position_error_m"] for robot in summary["robots"].values()]
            worst = max([worst, *(error for error in errors if error is not None)])
        counts = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())
        percentiles = quantiles(ticks, n=100, method="inclusive")
        print(f"{variant}: {counts} of {starts}; worst error {worst:.1e} m;", end=" ")
        print(f"ticks {percentiles[49]:.0f} median, {percentiles[94]:.0f} 95 %, {max(ticks)} most")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5000)
