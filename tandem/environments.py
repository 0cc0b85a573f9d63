"""The environment that `tandem.parallel_env` returns; it needs the extra `rl`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv

from agent.estimation.following import RETESTED, ClaimRule, Following
from agent.estimation.judged import FEWEST_FOR_CLAIM
from agent.estimation.team_measurements import TeamMeasurements
from agent.peer.team_log import Entry, Ranging, TeamLog
from compose.errors import UserError, no_such
from protocol.messages import Command, Localised, Observation, RobotConfig, Team, TeamAnchor
from protocol.motion import ORIGIN, REST, Controls, step, wrap
from tandem.scenarios import Scenario
from tandem.worlds import World

Array = NDArray[np.float32]
Stepped = tuple[
    dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]
"""Observations, rewards, terminations, truncations and infos, by robot."""
NO_RANGE = -1.0
"""The element of an observation for a beacon that is out of range."""


class MissionEnvironment(ParallelEnv[str, Array, Array]):  # type: ignore[misc]  # it has no types
    """The robots of a scenario as agents that choose (v, omega), until all have claimed their poses.

    Measurements are shared and poses claimed as in a team: each robot estimates from what it has measured and
    heard of. A report has all that its sender knows.
    """

    metadata = {"name": "tandem", "render_modes": []}  # noqa: RUF012  # as in ParallelEnv

    def __init__(self, scenario: Scenario) -> None:
        self.world = World(scenario)
        """The world in this tick: true poses, tick and outcome."""
        self.claims: dict[str, Localised] = {}
        """The claims of robots in this mission."""
        self.possible_agents = list(scenario.robots)
        self.agents: list[str] = []
        self._begun = False
        self._mission, self._max_ticks = (one := scenario.template.scenario).mission, one.max_ticks
        configs = {robot: self.world.config(robot) for robot in self.possible_agents}
        self._team = _team_of(configs)
        self._place, self._anchors = (
            {name: i for i, name in enumerate(names)}
            for names in (self._team.robots, [anchor.id for anchor in self._team.anchors])
        )
        self._beacons = {
            robot: [*_anchors_of(config), *[other for other in configs if other != robot]]
            for robot, config in configs.items()
        }
        fastest = np.array((self._mission.max_speed, self._mission.max_turn_rate), np.float32)
        self.action_spaces = {robot: Box(-fastest, fastest) for robot in configs}
        self.observation_spaces = {robot: _space(len(own)) for robot, own in self._beacons.items()}

    def observation_space(self, agent: str) -> Box:
        """Return the space of the observations of a robot."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Return the space of (v, omega) in m/s and rad/s: the limits of the mission."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Begin the mission with this seed; by default that of the scenario, later the next one each time."""
        del options
        scenario = self.world.scenario
        self.world = World(scenario, seed=(scenario.seed + self._begun) % 2**63 if seed is None else seed)
        self._begun = True
        self.agents, self.claims = [*self.possible_agents], {}
        none = [0] * len(self.agents)
        self._logs: list[list[Entry]] = [[] for _ in none]
        self._counts = [[0] for _ in none]
        """The number of ranges of each robot that decide about poses, before each tick."""
        self._known = [[none] for _ in none]
        """The number of ticks of each robot that each robot knows, before each tick."""
        self._estimated = dict.fromkeys(self.agents, (TeamMeasurements(), Following()))
        self._asked = dict.fromkeys(self.agents, 0)
        self._poses = dict.fromkeys(self.agents, ORIGIN)
        return self._sensed(), {robot: {} for robot in self.agents}

    def step(self, actions: Mapping[str, ArrayLike]) -> Stepped:
        """Move all robots for a tick, and return what they observe then; a robot without an action rests.

        Raises UserError for an action that is not (v, omega) or of no robot, and outside a mission.
        """
        if not (robots := self.agents):
            raise UserError("the mission has not begun, or is over: call reset()")
        for robot in actions:
            if robot not in robots:
                raise UserError(f"actions: {no_such(str(robot), robots)}")
        driven = {robot: _controls(robot, actions[robot]) if robot in actions else REST for robot in robots}
        self.world = self.world._advanced(self._commands(driven))
        seen = self._sensed()
        localised = len(self.claims) == len(robots)
        late = not localised and self.world.tick >= self._max_ticks
        info: dict[str, Any] = {}
        if localised or late:
            self.world = self.world._advanced(self._commands(dict.fromkeys(robots, REST)))
            info = {"outcome": self.world.outcome, "reason": self.world.reason}
            self.agents = []
        return (
            seen,
            dict.fromkeys(robots, -1.0),
            dict.fromkeys(robots, localised),
            dict.fromkeys(robots, late),
            {robot: dict(info) for robot in robots},
        )

    def _commands(self, driven: Mapping[str, Controls]) -> dict[str, Command]:
        """Return the commands of this tick, with the claims."""
        tick, claims = self.world.tick, self.claims
        return {
            robot: Command(tick, robot, one.v, one.omega, 1, "", claims.get(robot))
            for robot, one in driven.items()
        }

    def _sensed(self) -> dict[str, Array]:
        """Return the observations of this tick, once robots have exchanged reports and claimed poses."""
        observed = self.world.observe()
        seen = {robot: self._seen(one) for robot, one in observed.items()}
        for robot, one in observed.items():
            self._receive(self._place[robot], one)
        found: dict[Any, tuple[TeamMeasurements, Following]] = {}
        for robot in observed:
            if robot not in self.claims:
                self._estimate(robot, found)
            seen[robot][6] = robot in self.claims
        return seen

    def _seen(self, observed: Observation) -> Array:
        """Return an Observation as an array, once its measurements are in the log of the robot."""
        robot, driven = observed.robot, observed.executed or REST
        own, anchors, robots = self._place[robot], self._anchors, self._place
        to_anchors = {one.anchor: one.range for one in observed.anchors}
        if observed.anchor_range is not None:
            to_anchors[_own_anchor(robot)] = observed.anchor_range
        to_robots = {one.peer: one.range for one in observed.contacts if one.range is not None}
        self._logs[own].append(
            Entry(
                observed.executed,
                tuple([Ranging(anchors[name], rho) for name, rho in to_anchors.items()]),
                tuple([Ranging(robots[name], rho) for name, rho in to_robots.items()]),
            )
        )
        more = len(to_robots) + (len(to_anchors) if observed.anchors else 0)
        self._counts[own].append(self._counts[own][-1] + more)
        pose = self._poses[robot] = step(self._poses[robot], driven.v, driven.omega, self._mission.period)
        progress = observed.tick / self._max_ticks
        ranges = to_anchors | to_robots
        beacons = [ranges.get(name, NO_RANGE) for name in self._beacons[robot]]
        own_motion = (driven.v, driven.omega, pose.x, pose.y, wrap(pose.heading))
        return np.array([*own_motion, progress, 0.0, *beacons], np.float32)

    def _receive(self, own: int, observed: Observation) -> None:
        """Add what the robot has heard in this tick to what it knows: all that the senders knew then."""
        known = [*self._known[own][-1]]
        known[own] = observed.tick + 1
        for contact in observed.contacts:
            sender = self._place[contact.peer]
            for sent in contact.heard or ():
                known = [*map(max, known, self._known[sender][sent])]
                known[sender] = max(known[sender], sent + 1)
        self._known[own].append(known)

    def _estimate(self, robot: str, found: dict[Any, tuple[TeamMeasurements, Following]]) -> None:
        """Estimate the poses of all robots, and claim that of `robot` if nothing prevents it.

        That is done when the ranges that decide have grown by RETESTED. `found` has the estimates of this
        tick: robots that know the same estimate the same.
        """
        known, before = self._known[self._place[robot]][-1], self._estimated[robot]
        count = sum([ranges[ticks] for ranges, ticks in zip(self._counts, known, strict=True)])
        if count < max(FEWEST_FOR_CLAIM, RETESTED * self._asked[robot]):
            return
        self._asked[robot], key = count, (id(before), *known)
        if key not in found:
            logs = [tuple(log[:ticks]) for log, ticks in zip(self._logs, known, strict=True)]
            measured = before[0].grown(TeamLog(tuple(logs), ()), self._team, self._mission)
            used, rule = (
                measured.joint(self._team, self._mission),
                ClaimRule(self._mission.accuracy, self._mission.confidence),
            )
            found[key] = measured, before[1].after(used, rule, "team", self._team.robots)
        _, after = self._estimated[robot] = found[key]
        if after.reasons.get(robot) == "":
            self.claims[robot] = after.judged[robot].localised


def _controls(robot: str, action: ArrayLike) -> Controls:
    """Return an action as controls. Raises UserError."""
    try:
        v, omega = np.asarray(action, float).tolist()
    except (TypeError, ValueError):
        v = omega = math.nan
    if not math.isfinite(v + omega):
        raise UserError(f"actions: {robot}: not (v, omega) in m/s and rad/s: {action!r}")
    return Controls(v, omega)


def _space(beacons: int) -> Box:
    """Return the space of observations with ranges to that many beacons."""
    low = [-math.inf] * 4 + [-math.pi, 0.0, 0.0] + [NO_RANGE] * beacons
    high = [math.inf] * 4 + [math.pi, 1.0, 1.0] + [math.inf] * beacons
    return Box(np.array(low, np.float32), np.array(high, np.float32))


def _own_anchor(robot: str) -> str:
    """Return the name of a robot's own anchor, which no robot can have."""
    return f"anchor of {robot}"


def _anchors_of(config: RobotConfig) -> tuple[str, ...]:
    """Return the anchors that a robot may range."""
    if config.team is not None:
        return config.ranges
    return (_own_anchor(config.robot),) if config.given_anchor is not None else ()


def _team_of(configs: Mapping[str, RobotConfig]) -> Team:
    """Return the robots of a mission and their anchors as a team."""
    for config in configs.values():
        if config.team is not None:
            return config.team
    anchors = [
        TeamAnchor(_own_anchor(robot), one.given_anchor)
        for robot, one in configs.items()
        if one.given_anchor is not None
    ]
    return Team(tuple(configs), tuple(anchors))
