"""The simulator of the true robots, their sensors and their radio, one tick at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compose.errors import UserError
from compose.extras import need
from compose.recording.reasons import reason_for
from protocol.messages import Command, MissionEnd, Observation, RobotConfig
from protocol.motion import Controls, Pose
from protocol.spelling import did_you_mean
from protocol.wire import decode, encode
from tandem.scenarios import Scenario, plain, scenario_of
from world.tick import advance, observations, release

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tandem.environments import MissionEnvironment


class World:
    """The simulated world at one tick, for controllers of one's own.

    It is immutable: two steps from one world are two futures of it, with the same noise in each sensor.

    >>> import tandem
    >>> world = tandem.World("noisy")
    >>> there = world.step({"a": (0.25, 0.0)})
    >>> there.tick, there.truth["b"] == world.truth["b"]
    (1, True)
    >>> there.observe()["a"].anchor_range
    2.494...
    """

    def __init__(
        self, scenario: Scenario | str | Path | Mapping[str, Any], *, seed: int | None = None
    ) -> None:
        """`scenario` and `seed` are those of `tandem.run`; its planner has no effect. Raises UserError."""
        chosen = scenario_of(scenario)
        self.scenario = chosen if seed is None else chosen.with_(seed=seed)
        """The scenario."""
        self._state = release(self.scenario.template.scenario)
        self._end: MissionEnd | None = None

    @property
    def tick(self) -> int:
        """The tick k."""
        return self._state.truth.tick

    @property
    def truth(self) -> dict[str, Pose]:
        """The true pose of each robot in the world frame: m, m and rad, not wrapped."""
        return dict(zip(self.scenario.robots, self._state.truth.poses, strict=True))

    @property
    def outcome(self) -> str | None:
        """The outcome, as that of `tandem.run`; None until it is decided, at `max_ticks` at the latest."""
        return None if self._end is None else self._end.outcome

    @property
    def reason(self) -> str | None:
        """The reason for an outcome other than `localised`."""
        return None if self._end is None else reason_for(self._end)

    def config(self, robot: str) -> RobotConfig:
        """Return what `robot` is told before it starts, with which its `Planner` starts. Raises UserError."""
        if robot not in (ids := self.scenario.robots):
            raise UserError(f"no robot '{robot}'; there are {', '.join(ids)}{did_you_mean(str(robot), ids)}")
        return self.scenario.template.scenario.config(robot)

    def observe(self) -> dict[str, Observation]:
        """Return what each robot measures and receives in this tick; the same whenever it is called."""
        return {one.robot: one for one in observations(self._state)}

    def step(self, commands: Mapping[str, Sequence[float] | NDArray[Any] | Controls | Command]) -> World:
        """Return the world one tick later, or with its outcome, after which there is no further step.

        A command is (v, omega) in m/s and rad/s, `Controls`, or a `Command` whose verdict is the robot's
        claim. A robot without one rests. Velocities are limited to those of the mission. Raises UserError
        for an unknown robot, for a command that is none of these, and after the end.
        """
        if not isinstance(commands, Mapping):
            raise UserError(f"commands: not a dict of commands by robot: {type(commands).__name__}")
        if self._end is not None:
            raise UserError(f"the world has ended: {self._end.outcome}")
        return self._advanced({robot: self._command(robot, one) for robot, one in commands.items()})

    def _advanced(self, commands: Mapping[str, Command]) -> World:
        """Return the world after valid `commands`, as `step`."""
        after = copy(self)
        onward = advance(self._state, commands)
        if isinstance(onward, MissionEnd):
            after._end = onward
        else:
            after._state = onward
        return after

    def _command(self, robot: str, given: object) -> Command:
        """Return the command `given` to `robot`. Raises UserError."""
        if robot not in (ids := self.scenario.robots):
            near = did_you_mean(str(robot), ids)
            raise UserError(f"commands: no robot '{robot}'; there are {', '.join(ids)}{near}")
        match command := plain(given):
            case Controls(v=v, omega=omega) | [int() | float() as v, int() | float() as omega]:
                command = Command(self.tick, robot, v, omega, 1, "")
            case Command(robot=sender, tick=tick) if (sender, tick) != (robot, self.tick):
                raise UserError(f"commands: {robot}: a Command of {sender} in tick {tick}, not {self.tick}")
        try:
            return decode(encode(command), Command)
        except (TypeError, ValueError, OverflowError) as error:
            if isinstance(given, Command):
                raise UserError(f"commands: {robot}: a Command that cannot be sent: {error}") from None
            raise UserError(f"commands: {robot}: not (v, omega) in m/s and rad/s: {given!r}") from None

    def __repr__(self) -> str:
        return f"<World {self.scenario.name}, seed {self.scenario.seed}: tick {self.tick}>"


def parallel_env(
    scenario: Scenario | str | Path | Mapping[str, Any], *, seed: int | None = None
) -> MissionEnvironment:
    """Return a PettingZoo `ParallelEnv` in which a policy drives the robots of `scenario`.

    `seed` is that of the first mission, by default that of the scenario. Raises UserError for invalid
    arguments, and without the extra `rl`.

    >>> import tandem
    >>> env = tandem.parallel_env("random")
    >>> seen, infos = env.reset(seed=7)
    >>> env.step({robot: env.action_space(robot).sample() for robot in env.agents})[1]
    {'a': -1.0, 'b': -1.0}
    """
    need("gymnasium", "pettingzoo", extra="rl")
    from tandem.environments import MissionEnvironment  # noqa: PLC0415  # optional

    chosen = scenario_of(scenario)
    return MissionEnvironment(chosen if seed is None else chosen.with_(seed=seed))
