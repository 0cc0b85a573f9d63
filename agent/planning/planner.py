"""The planner contract: one robot's decisions as pure functions over frozen values.

A tick has two halves, because two robots in contact exchange their new measurements before either decides:

    observe(state, observation) -> state    adds the sensor data; `report(state)` is the message to the peer
    decide(state, reports)      -> state    adds the peer's reports; `command(state)` is the motion command

There is no I/O, no clock and no randomness, so simulation, network, replay and recovery make decisions that
are identical to the bit. A module with these functions is a planner; `registry` selects it, once per robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from agent.planning.manoeuvres import Manoeuvres
from agent.planning.state import RobotState
from protocol.messages import Command, Estimate, Observation, Report, RobotConfig
from protocol.mission import Mission


class Planner(Protocol):
    """The decisions of a robot. The current activity of the robot is one frozen value, `state.mode`."""

    @property
    def MANOEUVRES(self) -> Manoeuvres:  # noqa: N802  # a constant of the module that is the planner
        """The manoeuvres that the planner compares."""

    @property
    def ACTIVE_SENSING(self) -> bool:  # noqa: N802
        """True if robots choose each manoeuvre by the information of its next ranges."""

    def start(self, config: RobotConfig) -> RobotState:
        """Return the state of a robot that has measured nothing yet."""

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        """Return `state` with the sensor data of one tick: odometry, anchor range, contact and mutual range.

        The mode is also advanced, as far as it depends on the robot's own sensors.
        """

    def report(self, state: RobotState) -> Report:
        """Return the report of this tick to the peer."""

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the peer's `reports` and with the mode that follows from them."""

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the mode and the verdict."""

    def estimate(self, state: RobotState) -> Estimate:
        """Return all poses that the robot considers possible in its anchor's frame and in <W>."""

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
