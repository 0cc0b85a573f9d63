"""A planner of one's own for groups: localised robots report their poses, and the others believe them.

The first two robots are localised by `assured`. Then each drives to one that waits, as the group plans. There
both drive circles, and the poses and ranges of one give the pose of the other. Sensors are exact.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from scipy.optimize import least_squares  # type: ignore[import-untyped]

from tandem import planning, run
from tandem.planning import Command, Estimate, Localised, Observation, Pose, RobotConfig, compose, inverse

ASSURED = planning.Assured()


class Word(msgspec.Struct, frozen=True):
    """A report: the log of `assured` in the first meeting, and the pose in <W> of a localised robot."""

    tick: int
    log: planning.Report | None = None
    pose: Pose | None = None


class State(msgspec.Struct, frozen=True):
    """A robot: what `assured` knows of it, its claim, and later its ranges to a localised robot."""

    first: planning.RobotState
    later: bool = False  # True from the second meeting on
    claim: Localised | None = None
    frame: Pose | None = None  # the pose in <W> of the frame of the odometry
    ranges: tuple[tuple[int, float, Pose], ...] = ()  # the tick, the range to the peer, the own odometry
    places: tuple[tuple[int, Pose], ...] = ()  # the tick, the pose that the peer has reported


class Believing(planning.Planner[State, Word]):
    """The planner. It is no subclass of those that are shipped."""

    BODY = Word

    def start(self, config: RobotConfig) -> State:
        """Return the state of a robot that has measured nothing yet."""
        return State(ASSURED.start(config))

    def meet(self, state: State, config: RobotConfig) -> State:
        """Return the state in another meeting, without what it knew of the earlier peer."""
        return State(replace(state.first, config=config), True, state.claim, state.frame)

    def observe(self, state: State, observation: Observation) -> State:
        """Return the state with the odometry and the ranges of one tick."""
        first, near = ASSURED.observe(state.first, observation), observation.contacts
        new = [(observation.tick, one.range, first.odometry) for one in near if one.range is not None]
        return replace(state, first=first, ranges=(*state.ranges, *new))

    def report(self, state: State) -> Word:
        """Return the log in the first meeting, and the pose of a localised robot."""
        pose = compose(state.frame, state.first.odometry) if state.frame is not None else None
        return Word(state.first.tick, None if state.later else ASSURED.report(state.first), pose)

    def decide(self, state: State, reports: Sequence[Word] = ()) -> State:
        """Return the state with the peer's words, and with a claim once they determine the own pose."""
        if not state.later:
            logs = [one.log for one in reports if one.log is not None]
            state = replace(state, first=ASSURED.decide(state.first, logs))
        if state.claim is not None:
            return state
        heard = [(one.tick, one.pose) for one in reports if one.pose is not None]
        state = replace(state, places=state.places + tuple(heard))
        claim = state.first.verdict if isinstance(state.first.verdict, Localised) else claim_of(state)
        frame = compose(claim.pose, inverse(state.first.odometry)) if claim is not None else None
        return replace(state, claim=claim, frame=frame)

    def command(self, state: State) -> Command:
        """Return a circle in the meeting of a localised robot with another one, else what `assured` does."""
        command, mission = ASSURED.command(state.first), state.first.config.mission
        if state.later or state.places:
            omega = (0.6 if state.frame is not None else -0.4) / mission.period
            radius = 0.05 * mission.sensing_range
            command = replace(command, v=radius * abs(omega), omega=omega, phase=3, task="circling")
        return replace(command, verdict=state.claim)

    def estimate(self, state: State) -> Estimate:
        """Return the pose of a localised robot; before, those of the hypotheses of `assured`."""
        estimate, pose = ASSURED.estimate(state.first), self.report(state).pose
        return replace(estimate, world=(pose,), localised=True) if pose is not None else estimate


def claim_of(state: State) -> Localised | None:
    """Return the present pose in <W>, if the ranges to the peer and its poses leave exactly one."""
    there = dict(state.places)
    pairs = [(own, there[tick], rho) for tick, rho, own in state.ranges if tick in there]
    own = np.array([(one.x, one.y) for one, _, _ in pairs])
    peer = np.array([(one.x, one.y) for _, one, _ in pairs])
    rho, found = np.array([one for _, _, one in pairs]), list[np.ndarray]()

    def misfit(at: np.ndarray) -> np.ndarray:
        c, s = np.cos(at[2]), np.sin(at[2])
        return np.asarray(np.hypot(*(own @ np.array(((c, s), (-s, c))) + at[:2] - peer).T) - rho)

    for way, turn in ((way, turn) for way in range(6) for turn in range(6) if len(pairs) >= 8):
        start = (*(peer[-1] + rho[-1] * np.array((np.cos(way), np.sin(way)))), turn)
        fit = least_squares(misfit, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        if np.abs(fit.fun).max() < 1e-9 and all(np.hypot(*(fit.x - one)[:2]) > 1e-3 for one in found):
            found.append(fit.x)
    return Localised(compose(Pose(*found[0].tolist()), state.first.odometry)) if len(found) == 1 else None


def main() -> None:
    """Run a group of eight robots."""
    print(run("group-8", planner=Believing))


if __name__ == "__main__":
    main()
