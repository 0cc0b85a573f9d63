"""Run a mission in this process, and plot the paths and the errors of the estimates.

`uv run docs/examples/run_and_plot.py [FILE]` writes the figure to FILE (run.png).
"""

from __future__ import annotations

import sys

from matplotlib.figure import Figure

import tandem


def main(file: str = "run.png") -> None:
    """Run the scenario `noisy`, print its outcome, and write the figure to `file`."""
    run = tandem.run("noisy", seed=7)
    print(run, *run.claims["position_error_m"])
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    plane, errors = figure.subplots(1, 2)
    for robot in run.robots:
        path = run.truth.where(robot=robot)
        plane.plot(path["x"], path["y"], label=robot)
        estimate = run.estimates.where(robot=robot, frame="world", hypothesis=0)
        errors.semilogy(estimate["time_s"], estimate["position_error_m"], label=robot)
    plane.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    errors.set(xlabel="time [s]", ylabel="position error [m]")
    errors.legend()
    figure.savefig(file)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "run.png")
