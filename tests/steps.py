"""A mission by the bare planner and world, tick by tick."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from agent.planning import planner
from agent.planning.state import RobotState
from compose.scenario.scenario_file import load
from protocol.messages import Command, Observation, Report
from world.tick import World, advance, release, senses


class Step(NamedTuple):
    """One tick: what went into each of its halves, and what came out."""

    world: World
    sensed: list[Observation]
    before: dict[str, RobotState]
    observed: dict[str, RobotState]
    heard: dict[str, list[Report]]
    drives: dict[str, Command]


def steps(name: str) -> Iterator[Step]:
    """The ticks of the scenario `name`, which ends localised."""
    world = release(load(name))
    minds = {robot.id: RobotState(world.scenario.briefing(robot.id)) for robot in world.scenario.robots}
    while True:
        sensed = senses(world)
        observed = {sense.robot: planner.observe(minds[sense.robot], sense) for sense in sensed}
        heard = {
            sense.robot: [planner.report(observed[contact.peer]) for contact in sense.contacts]
            for sense in sensed
        }
        before, minds = minds, {robot: planner.decide(mind, heard[robot]) for robot, mind in observed.items()}
        drives = {robot: planner.drive(mind) for robot, mind in minds.items()}
        yield Step(world, sensed, before, observed, heard, drives)
        onward = advance(world, drives)
        if not isinstance(onward, World):
            assert onward.outcome == "localised"
            return
        world = onward
