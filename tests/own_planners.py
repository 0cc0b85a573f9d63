# ruff: noqa: ARG002
"""Planners of a user: one with reports of its own, and some with one mistake each."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import msgspec
from msgspec.structs import replace

from protocol.network import watchdog
from tandem.planning import (
    Assured,
    Command,
    Estimate,
    Localised,
    Mission,
    Observation,
    Planner,
    Pose,
    Report,
    RobotConfig,
    RobotState,
    Summary,
    Undecided,
)


class Parcel(msgspec.Struct, frozen=True, array_like=True):
    """A report of the planner Wrapping: a log, and a number that its decoder checks."""

    log: Report
    double: int
    """Twice the tick of the log."""


class Counting(Planner[tuple[RobotConfig, int, int], int]):
    """A planner for teams, from the contract alone: it ends once all have counted ranges to three anchors."""

    BODY = int

    def start(self, config: RobotConfig) -> tuple[RobotConfig, int, int]:
        return config, -1, 0

    def observe(
        self, state: tuple[RobotConfig, int, int], observation: Observation
    ) -> tuple[RobotConfig, int, int]:
        return state[0], observation.tick, state[2] + len(observation.anchors)

    def report_to(self, state: tuple[RobotConfig, int, int], peer: str) -> int:
        return state[2]

    def decide(
        self, state: tuple[RobotConfig, int, int], reports: Sequence[int] = ()
    ) -> tuple[RobotConfig, int, int]:
        return state[0], state[1], max(state[2], *reports, 0)

    def command(self, state: tuple[RobotConfig, int, int]) -> Command:
        config, tick, counted = state
        assert config.team is not None
        enough = counted >= 3 * len(config.team.anchors)
        verdict = Undecided(f"{counted} ranges counted") if enough else None
        return Command(tick, config.robot, 0.5, 0.5, 1, "counting", verdict=verdict)

    def estimate(self, state: tuple[RobotConfig, int, int]) -> Estimate:
        return Estimate(state[1], state[0].robot, (), (), localised=False)


class Wrapping(Planner[RobotState, Parcel]):
    """The planner `assured` with exact sensors, with reports of a type of its own."""

    BODY = Parcel
    REQUIRED_PLACES = 3

    def __init__(self, note: str = "", weight: int = 1) -> None:
        if weight < 0:
            raise ValueError(f"weight {weight} is negative")
        self.note, self.weight = note, weight
        self.inner = Assured()

    def start(self, config: RobotConfig) -> RobotState:
        return self.inner.start(config)

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        return self.inner.observe(state, observation)

    def report(self, state: RobotState) -> Parcel:
        return Parcel(self.inner.report(state), 2 * state.tick)

    def decide(self, state: RobotState, reports: Sequence[Parcel] = ()) -> RobotState:
        return self.inner.decide(state, [one.log for one in reports])

    def command(self, state: RobotState) -> Command:
        return self.inner.command(state)

    def estimate(self, state: RobotState) -> Estimate:
        return self.inner.estimate(state)

    def malformed(self, body: Parcel) -> str | None:
        if body.double != 2 * body.log.tick:
            return f"{body.double} is not twice {body.log.tick}"
        return self.inner.malformed(body.log)

    def summary(self, state: RobotState) -> Summary:
        return Summary(hypotheses=len(state.posterior.placements), blocking_reason=self.note or None)


class Idle(Planner[int, None]):
    """A planner that does nothing, with the least code; its state is the tick."""

    def start(self, config: RobotConfig) -> int:
        self.robot = config.robot  # a mistake that no other instance shows
        return 0

    def observe(self, state: int, observation: Observation) -> int:
        return observation.tick

    def decide(self, state: int, reports: Sequence[None] = ()) -> int:
        return state

    def command(self, state: int) -> Command:
        return Command(state, self.robot, 0.0, 0.0, 1, "idle")

    def estimate(self, state: int) -> Estimate:
        return Estimate(state, self.robot, (), (), localised=False)


# --- mistakes ---------------------------------------------------------------------------------------


class Incomplete(Planner[int, None]):
    """It defines nothing."""


class Hanging(Assured):
    """The planner `assured`, whose process hangs in a call of Zenoh once, at tick 5 of b.

    The file that the environment variable HUNG_ONCE names tells that it has.
    """

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        hung = Path(os.environ["HUNG_ONCE"])
        if state.config.robot == "b" and state.tick == 5 and not hung.exists():
            hung.touch()
            watchdog.CALL.longest_s = 1.0
            with watchdog.CALL:
                threading.Event().wait()
        return super().decide(state, reports)


class Suited(Assured):
    """It has a method that no version calls any more."""

    def suited(self, mission: Mission) -> Assured:
        """Return another planner."""
        del mission
        return Assured()


class Drawing(Assured):
    """It draws random numbers."""

    def command(self, state: RobotState) -> Command:
        one = super().command(state)
        return replace(one, omega=one.omega * (1.0 - 1e-9 * Random().random()))


class Sound(Assured):
    """The planner `assured` with exact sensors, under another name."""


class Clock(Assured):
    """It asks for the time."""

    def command(self, state: RobotState) -> Command:
        one = super().command(state)
        return replace(one, v=one.v * (1.0 - 1e-12 * (time.time_ns() % 1000)))


class Remembers(Assured):
    """It counts its calls outside of the state."""

    def __init__(self) -> None:
        self.calls = 0

    def command(self, state: RobotState) -> Command:
        self.calls += 1
        one = super().command(state)
        return replace(one, v=one.v if self.calls % 7 else 0.5 * one.v)


class Mutable(Planner[dict[str, Any], None]):
    """It changes the state that it is given."""

    def start(self, config: RobotConfig) -> dict[str, Any]:
        return {"tick": 0, "robot": config.robot, "seen": []}

    def observe(self, state: dict[str, Any], observation: Observation) -> dict[str, Any]:
        state["seen"].append(observation.tick)
        return {**state, "tick": observation.tick}

    def decide(self, state: dict[str, Any], reports: Sequence[None] = ()) -> dict[str, Any]:
        return state

    def command(self, state: dict[str, Any]) -> Command:
        return Command(state["tick"], state["robot"], 0.0, 0.0, 1, "idle")

    def estimate(self, state: dict[str, Any]) -> Estimate:
        return Estimate(state["tick"], state["robot"], (), (), localised=False)


class Unpicklable(Assured):
    """A planner whose state holds a function of itself."""

    def start(self, config: RobotConfig) -> Any:
        return Local(super().start(config), lambda: 0)

    def observe(self, state: Any, observation: Observation) -> Any:
        return Local(super().observe(state.inner, observation), state.extra)

    def report(self, state: Any) -> Report:
        return super().report(state.inner)

    def decide(self, state: Any, reports: Sequence[Report] = ()) -> Any:
        return Local(super().decide(state.inner, reports), state.extra)

    def command(self, state: Any) -> Command:
        return super().command(state.inner)

    def estimate(self, state: Any) -> Estimate:
        return super().estimate(state.inner)

    def summary(self, state: Any) -> Summary:
        return super().summary(state.inner)


class Local:
    """A state with something that only this process has."""

    def __init__(self, inner: RobotState, extra: Any) -> None:
        self.inner, self.extra = inner, extra


class Fast(Assured):
    """It drives faster than v_max."""

    def command(self, state: RobotState) -> Command:
        one = super().command(state)
        return replace(one, v=1.5 * one.v)


class Stranger(Assured):
    """It meets a robot that does not exist."""

    def command(self, state: RobotState) -> Command:
        return replace(super().command(state), peer="nobody")


class NotANumber(Assured):
    """It commands NaN at tick 5."""

    def command(self, state: RobotState) -> Command:
        one = super().command(state)
        return replace(one, v=math.nan) if state.tick == 5 else one


class Talkative(Wrapping):
    """A planner whose reports are too long."""

    BODY = list  # type: ignore[assignment]

    def report(self, state: RobotState) -> Any:
        return ["x" * 5000]

    def malformed(self, body: Any) -> str | None:
        return None


class Gullible(Wrapping):
    """It fails on reports whose number it does not like; its decoder does not check it."""

    def malformed(self, body: Parcel) -> str | None:
        return self.inner.malformed(body.log)

    def decide(self, state: RobotState, reports: Sequence[Parcel] = ()) -> RobotState:
        for one in reports:
            _ = 1 // (one.double == 2 * one.log.tick)
        return super().decide(state, reports)


class Bragging(Assured):
    """It claims at once that it is at the origin."""

    def command(self, state: RobotState) -> Command:
        one = super().command(state)
        return replace(one, verdict=Localised(Pose(0.0, 0.0, 0.0))) if state.tick > 2 else one


class Fickle(Assured):
    """Robot a takes its claim back."""

    def command(self, state: RobotState) -> Command:
        one = super().command(state)
        if state.tick == 3 and state.config.role == "a":
            return replace(one, verdict=Localised(Pose(0.0, 0.0, 0.0)))
        return one


class Failing(Assured):
    """It raises an error at tick 7."""

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        if observation.tick == 7:
            raise KeyError("seven")
        return super().observe(state, observation)


class Undecodable(Wrapping):
    """A planner whose reports are not of its BODY."""

    BODY = int  # type: ignore[assignment]


class Rendezvousless(Assured):
    """A planner whose orbits are none."""

    def rendezvous(self, mission: Mission, distance: float) -> Any:
        return None
