"""The names with which a solver is written: the contract, and the measurements that it fits.

A planner has one as its `SOLVER`; `tandem.estimate` takes one as its `solver`.
"""

from __future__ import annotations

from agent.estimation.fit import Start
from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges, PosePrior
from agent.estimation.gaussian.odometry_noise import Array, Track
from agent.estimation.gaussian.odometry_noise import Errors as OdometryErrors
from agent.estimation.solver import Solution, Solver
from protocol.noise import Noise

__all__ = [
    "Array",
    "JointMeasurements",
    "JointRanges",
    "Noise",
    "OdometryErrors",
    "PosePrior",
    "Solution",
    "Solver",
    "Start",
    "Track",
]
