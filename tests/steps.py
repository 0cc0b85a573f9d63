"""A mission that runs the planner and the world directly, tick by tick."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from msgspec.structs import replace

from agent.planning import tasks
from agent.planning.planner import Planner
from agent.planning.state import RobotState
from compose.launch.planner_loader import planner_class
from compose.scenario.scenario_file import load
from protocol.messages import Command, Observation, Report
from world.scenario import Scenario
from world.tick import World, advance, observations, release

NAMES = [
    name
    for one in vars(tasks).values()
    if isinstance(one, type) and isinstance(name := getattr(one, "name", None), str)
]
"""The names of all tasks but those of a verdict and of a planner of the user."""


class Step(NamedTuple):
    """One tick: the inputs and outputs of `observe` and `decide` of each robot."""

    world: World
    sensed: list[Observation]
    before: dict[str, RobotState]
    observed: dict[str, RobotState]
    heard: dict[str, list[Report]]
    commands: dict[str, Command]


def planner_of(state: RobotState) -> Planner[RobotState, Report]:
    """Return the planner of the robot with this state."""
    return planner_class(state.config.planner_name)()


def steps(scenario: str | Scenario, *, at_rest: int = 0) -> Iterator[Step]:
    """Yield the ticks of a scenario or of the one of this name, and check that it ends localised.

    In the first `at_rest` ticks, all robots miss the deadline.
    """
    world = release(load(scenario) if isinstance(scenario, str) else scenario)
    play = planner_class(world.scenario.planner_name)()
    states = {robot.id: play.start(world.scenario.config(robot.id)) for robot in world.scenario.robots}
    while True:
        sensed = observations(world)
        observed = {
            observation.robot: play.observe(states[observation.robot], observation) for observation in sensed
        }
        heard = {
            observation.robot: [play.report(observed[contact.peer]) for contact in observation.contacts]
            for observation in sensed
        }
        before, states = (
            states,
            {robot: play.decide(state, heard[robot]) for robot, state in observed.items()},
        )
        commands = {robot: play.command(state) for robot, state in states.items()}
        yield Step(world, sensed, before, observed, heard, commands)
        late = world.truth.tick < at_rest
        onward = advance(
            world,
            {robot: replace(one, v=0.0, omega=0.0) for robot, one in commands.items()} if late else commands,
        )
        if not isinstance(onward, World):
            assert onward.outcome == "localised"
            return
        world = onward
