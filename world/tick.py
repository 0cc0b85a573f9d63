"""One tick of the simulation, as pure functions: the Observations of a World, and the World after it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from protocol.messages import Command, Contact, Localised, Observation, Verdict
from protocol.motion import REST, Controls, Pose
from world.channel import LinkState, link_faults, next_link_state
from world.referee import MissionOutcome, decide_outcome
from world.scenario import Scenario
from world.sensors import anchor_ranges, executed, mutual_ranges, odometry
from world.truth import Truth, limited_controls
from world.world_models import Radios, Transmission


class World(msgspec.Struct, frozen=True):
    """The complete state of the simulation at one tick."""

    scenario: Scenario
    """The scenario of the run."""
    truth: Truth
    """The true poses."""
    executed: tuple[Controls, ...] | None
    """The executed controls over the previous tick, in the order of the scenario; None at tick 0."""
    verdicts: dict[str, Verdict]
    """The first result of each robot that has one."""
    claimed: dict[str, Pose]
    """The true pose in <W> of each localised robot at the tick of its claim. Noise may move it afterwards."""
    pairs: tuple[tuple[int, int], ...]
    """The pairs of robots that may measure each other, as indices into the scenario's robots."""
    links: tuple[LinkState, ...] = ()
    """The state of the links: for each pair, from the first to the second robot, then back.

    Empty without faults.
    """
    executed_before: tuple[Controls, ...] | None = None
    """The executed controls over the tick before the previous one; None until tick 2."""


def release(scenario: Scenario) -> World:
    """Return the world at tick 0."""
    pairs = scenario.radio_pairs()
    origins = {place: scenario.robots[i].anchor for i, j in reversed(pairs) for place in (i, j)}
    local = tuple(
        Pose(robot.start.x - origins[i].x, robot.start.y - origins[i].y, robot.start.heading)
        for i, robot in enumerate(scenario.robots)
    )
    truth = Truth(0, local, tuple(origins[i] for i in range(len(local))))
    radio = scenario.radio
    fresh = LinkState() if radio is None else LinkState(radio=radio.start())
    still = (fresh,) * (2 * len(pairs)) if scenario.faults or radio is not None else ()
    return World(scenario, truth, None, {}, {}, pairs, _carried(still, scenario, truth, pairs))


def observations(world: World) -> list[Observation]:
    """Return the Observation of each robot at the current tick, in the order of the scenario."""
    scenario, truth, driven = world.scenario, world.truth, world.executed
    tick, robots = truth.tick, scenario.robots
    measured: Sequence[Controls | None] = driven or (None,) * len(robots)
    if driven is not None and not scenario.sensors.exact:
        before = world.executed_before or (REST,) * len(robots)
        measured = [
            odometry(driven[i], scenario, robot.id, tick, before[i]) for i, robot in enumerate(robots)
        ]
    contacts: list[tuple[Contact, ...]] = [()] * len(robots)
    mutuals = mutual_ranges(truth, scenario, world.pairs)
    for i, ((one, other), mutual) in enumerate(zip(world.pairs, mutuals, strict=True)):
        if mutual is not None:
            to_other, to_one = (
                world.links[2 * i : 2 * i + 2] if world.links else (LinkState((tick,)), LinkState((tick,)))
            )
            contacts[one] += (Contact(robots[other].id, mutual.range, to_one.heard, to_one.damaged),)
            contacts[other] += (Contact(robots[one].id, mutual.range, to_other.heard, to_other.damaged),)
    ranges = anchor_ranges(truth, scenario)
    return [
        Observation(tick, robot.id, measured[i], ranges[i], contacts[i]) for i, robot in enumerate(robots)
    ]


def advance(world: World, commands: Mapping[str, Command]) -> World | MissionOutcome:
    """Return the world one tick later, or the outcome of the run. A robot without a Command rests."""
    scenario, truth = world.scenario, world.truth
    verdicts, claimed = world.verdicts, world.claimed
    driven = []
    exact = scenario.sensors.exact
    for place, robot in enumerate(scenario.robots):
        command = commands.get(robot.id)
        controls = limited_controls(command, scenario.mission)
        driven.append(controls if exact else executed(controls, scenario, robot.id, truth.tick))
        if command is not None and command.verdict is not None and robot.id not in verdicts:
            verdicts = verdicts | {robot.id: command.verdict}
            if isinstance(command.verdict, Localised):
                claimed = claimed | {robot.id: truth.poses[place]}
    if verdicts or truth.tick >= scenario.max_ticks:
        mission_outcome = decide_outcome(scenario, truth, verdicts, claimed)
        if mission_outcome is not None:
            return mission_outcome
    moved = truth.moved(driven, scenario.mission.period)
    links = _carried(world.links, scenario, moved, world.pairs)
    return World(
        scenario, moved, tuple(driven), verdicts, claimed, world.pairs, links, executed_before=world.executed
    )


def _carried(
    before: Sequence[LinkState], scenario: Scenario, truth: Truth, pairs: Sequence[tuple[int, int]]
) -> tuple[LinkState, ...]:
    """Return the state of each link at the tick of `truth`, given its state in `before` one tick earlier."""
    if not before:
        return ()
    mutuals = mutual_ranges(truth, scenario, pairs)
    ids = [robot.id for robot in scenario.robots]
    links = [(way, mutual) for pair, mutual in zip(pairs, mutuals, strict=True) for way in (pair, pair[::-1])]
    senders = list(dict.fromkeys([sender for (sender, _), mutual in links if mutual is not None]))
    delivered = _delivered(before, scenario, truth, links, senders) if scenario.radio is not None else {}
    return tuple(
        [
            next_link_state(
                link,
                link_faults(scenario.faults, ids[sender], ids[receiver]),
                scenario.seed,
                truth.tick,
                in_contact=mutual is not None,
                delivered=delivered.get((sender, receiver), (link.radio, 0)),
            )
            for link, ((sender, receiver), mutual) in zip(before, links, strict=True)
        ]
    )


def _delivered(
    before: Sequence[LinkState],
    scenario: Scenario,
    truth: Truth,
    links: Sequence[tuple[tuple[int, ...], object]],
    senders: Sequence[int],
) -> dict[tuple[int, ...], tuple[Any, int | None]]:
    """Return the state and the delay of the report of each link of `senders`, by the radio model."""
    assert scenario.radio is not None
    places = [(pose.x, pose.y) for pose in truth.poses]
    ids, reach = [robot.id for robot in scenario.robots], scenario.sensors.reach
    sending = tuple([(ids[sender], places[sender]) for sender in senders])
    found: dict[tuple[int, ...], tuple[Any, int | None]] = {}
    for link, ((sender, receiver), mutual) in zip(before, links, strict=True):
        if mutual is not None:
            name = f"report/{ids[sender]}->{ids[receiver]}"
            radios = Radios(name, places[sender], places[receiver], truth.tick, scenario.seed)
            transmission = Transmission(radios, reach, scenario.mission.period, sending, ids[sender])
            found[sender, receiver] = scenario.radio.sent(link.radio, transmission)
    return found
