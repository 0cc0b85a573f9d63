"""One tick of the simulation, as pure functions: the Observations of a World, and the World after it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec

from protocol.messages import Command, Contact, Localised, LostReport, MissionEnd, Observation, Verdict
from protocol.motion import REST, Controls, Pose
from world.channel import LinkState, idle_link_state, link_faults, next_link_state
from world.referee import decide_outcome
from world.scenario import Scenario
from world.sensors import Mutual, anchor_ranges, executed, in_contact, odometry
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
    contacts: dict[tuple[int, int], Mutual]
    """The measurements of those of `pairs` whose robots are in range of each other."""
    links: dict[tuple[int, int], LinkState] | None = None
    """The state of each link whose robots have been in contact, by the places of sender and receiver.

    None if all reports are delivered.
    """
    executed_before: tuple[Controls, ...] | None = None
    """The executed controls over the tick before the previous one; None until tick 2."""


def release(scenario: Scenario) -> World:
    """Return the world at tick 0."""
    pairs = scenario.radio_pairs()
    origins = {0: scenario.home(0)}  # of one that is alone
    origins |= {place: scenario.home(i) for i, j in reversed(pairs) for place in (i, j)}
    local = tuple(
        Pose(robot.start.x - origins[i].x, robot.start.y - origins[i].y, robot.start.heading)
        for i, robot in enumerate(scenario.robots)
    )
    truth = Truth(0, local, tuple(origins[i] for i in range(len(local))))
    still: dict[tuple[int, int], LinkState] | None = None
    if scenario.faults or scenario.radio is not None:
        still = {}
    contacts = in_contact(truth, scenario, pairs)
    links = _carried(still, scenario, truth, contacts)
    return World(scenario, truth, None, {}, {}, pairs, contacts, links)


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
    at_once = LinkState((tick,))
    for (one, other), mutual in world.contacts.items():
        to_other, to_one = at_once, at_once
        if world.links is not None:
            to_other, to_one = world.links[one, other], world.links[other, one]
        contacts[one] += (Contact(robots[other].id, mutual.range, to_one.heard, to_one.damaged),)
        contacts[other] += (Contact(robots[one].id, mutual.range, to_other.heard, to_other.damaged),)
    ranges = anchor_ranges(truth, scenario)
    if scenario.deaths:
        ranges = [
            [] if scenario.is_dead(robot.id, tick) else measured
            for robot, measured in zip(robots, ranges, strict=True)
        ]
    lost: list[tuple[LostReport, ...]] = [()] * len(robots)
    for (sender, receiver), link in (world.links or {}).items():
        if link.lost:
            lost[receiver] += tuple([LostReport(robots[sender].id, sent) for sent in link.lost])
    if scenario.team is not None:
        return [
            Observation(tick, robot.id, measured[i], None, contacts[i], lost[i], tuple(ranges[i]))
            for i, robot in enumerate(robots)
        ]
    return [
        Observation(
            tick, robot.id, measured[i], ranges[i][0].range if ranges[i] else None, contacts[i], lost[i]
        )
        for i, robot in enumerate(robots)
    ]


def advance(world: World, commands: Mapping[str, Command]) -> World | MissionEnd:
    """Return the world one tick later, or the end of the run.

    A robot without a Command rests, and so does a dead one.
    """
    scenario, truth, claimed = world.scenario, world.truth, world.claimed
    verdicts = verdicts_after(world, commands)
    driven = []
    exact = scenario.sensors.exact
    for index, robot in enumerate(scenario.robots):
        if scenario.is_dead(robot.id, truth.tick):
            driven.append(REST)
            continue
        command = commands.get(robot.id)
        controls = limited_controls(command, scenario.mission)
        driven.append(controls if exact else executed(controls, scenario, robot.id, truth.tick))
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Localised) and verdict is not world.verdicts.get(robot.id):
            claimed = claimed | {robot.id: truth.poses[index]}
    if verdicts or truth.tick >= scenario.max_ticks:
        end = decide_outcome(scenario, truth, verdicts, claimed)
        if end is not None:
            return end
    moved = truth.moved(driven, scenario.mission.period)
    contacts = in_contact(moved, scenario, world.pairs)
    links = _carried(world.links, scenario, moved, contacts)
    return World(
        scenario, moved, tuple(driven), verdicts, claimed, world.pairs, contacts, links, world.executed
    )


def verdicts_after(world: World, commands: Mapping[str, Command]) -> dict[str, Verdict]:
    """Return the verdicts of the robots after the `commands` of this tick, by robot.

    The first verdict of a robot of a pair is final. In a group or a team, later measurements may contradict a
    claim, which is then withdrawn.
    """
    scenario, verdicts = world.scenario, world.verdicts
    for robot in scenario.robots:
        command, given = commands.get(robot.id), verdicts.get(robot.id)
        if command is None or command.verdict == given or scenario.is_dead(robot.id, world.truth.tick):
            continue
        if given is None or not scenario.in_pairs:
            verdicts = {name: one for name, one in verdicts.items() if name != robot.id}
            if command.verdict is not None:
                verdicts[robot.id] = command.verdict
    return verdicts


def _carried(
    before: Mapping[tuple[int, int], LinkState] | None,
    scenario: Scenario,
    truth: Truth,
    contacts: Iterable[tuple[int, int]],
) -> dict[tuple[int, int], LinkState] | None:
    """Return the state of each link at the tick of `truth`, given its state in `before` one tick earlier.

    `contacts` are the pairs whose robots are in range of each other.
    """
    if before is None:
        return None
    ids, radio, tick = [robot.id for robot in scenario.robots], scenario.radio, truth.tick
    sending = [way for pair in contacts for way in (pair, pair[::-1])]
    links = {way: link_faults(scenario.faults, ids[way[0]], ids[way[1]]) for way in (*before, *sending)}
    states = dict(before)
    for way in sending:
        if way not in states:
            states[way] = idle_link_state(links[way], tick, None if radio is None else radio.start())
    delivered = _delivered(states, scenario, truth, sending) if radio is not None else {}
    together = set(sending)
    return {
        way: next_link_state(
            link,
            links[way],
            scenario.seed,
            tick,
            in_contact=way in together,
            delivered=delivered.get(way, (link.radio, 0)),
        )
        for way, link in states.items()
    }


def _delivered(
    before: Mapping[tuple[int, int], LinkState],
    scenario: Scenario,
    truth: Truth,
    links: Sequence[tuple[int, int]],
) -> dict[tuple[int, int], tuple[Any, int | None]]:
    """Return the state and the delay of the report of each of `links`, by the radio model."""
    assert scenario.radio is not None
    places = [(pose.x, pose.y) for pose in truth.poses]
    ids, reach = [robot.id for robot in scenario.robots], scenario.sensors.reach
    senders = dict.fromkeys([sender for sender, _ in links])
    sending = tuple([(ids[sender], places[sender]) for sender in senders])
    delivered: dict[tuple[int, int], tuple[Any, int | None]] = {}
    for sender, receiver in links:
        name = f"report/{ids[sender]}->{ids[receiver]}"
        radios = Radios(name, places[sender], places[receiver], truth.tick, scenario.seed)
        transmission = Transmission(radios, reach, scenario.mission.period, sending, ids[sender])
        delivered[sender, receiver] = scenario.radio.sent(before[sender, receiver].radio, transmission)
    return delivered
