"""Groups that tolerate one false robot, with one link under attack: `python -m tests.links [--cpu S]`.

Each mission has four or five robots, `tolerates = 1`, a sigma of ranges of 0.001 or 0.05 m, exact odometry,
and an attack on the ranges of one link, which is drawn. A table counts for each attack the claims of robots
that are not at the link and of those that are, the wrong ones, the missions in which a robot reports an
inconsistency, and the claims with which the ranges of the robot agree: their chi-square, with the starts near
the claimed ones that fit the ranges of all robots best, has a probability of at least LEAST_PROBABLE.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import time
from collections import Counter
from threading import Event
from typing import Any, NamedTuple

import numpy as np

from agent.estimation.gaussian.consistency import chi2_p_value
from agent.estimation.smoother import Array
from compose.launch.in_process import recorded
from compose.recording.run import Run
from compose.scenario.scenario_file import scenario_table, validate
from protocol.messages import Inconsistent, Localised
from protocol.motion import ORIGIN, Pose, compose, inverse, step
from world.referee import mistake

LENGTHS = (-1.0, -0.3, 0.3, 1.0)
"""The lengths in m that are added to the ranges."""
ATTACKS: dict[str, dict[str, Any]] = {
    "none": {"by": 0.0},
    **{f"mutual {by:+g} m": {"by": by} for by in LENGTHS},
    "mutual relayed, +1 m": {"by": 1.0, "relay": 3.0},
    "mutual jammed": {"jam": True},
    **{f"anchor {by:+g} m": {"by": by} for by in LENGTHS},
}
"""The attacks, by the names of their rows."""
COLUMNS = (
    "missions", "inconsistent", "claims of others", "wrong", "claims at the link", "wrong there", "agreeing",
    "wrong, agreeing",
)  # fmt: skip
"""The columns of the table: the numbers that are counted of each attack."""
MOST_TICKS = 1500
"""The ticks after which a mission ends: robots that contradict each other drive on."""
ITERATIONS = 8
"""The number of Gauss-Newton steps, which begin near the minimum."""
LEAST_PROBABLE = 0.001
"""The probability of the chi-square below which ranges contradict a claim."""


def table_of(attack: str, robots: int, sigma: float, draw: random.Random) -> tuple[dict[str, Any], list[str]]:
    """Return a scenario file as a table, and the robots at the attacked link."""
    table = scenario_table("random-group")
    noise = {"anchor_sigma": sigma, "mutual_sigma": sigma, "gyro_bias": 0.0}
    ends = sorted(draw.sample(range(1, robots + 1), 1 if attack.startswith("anchor") else 2))
    link = f"anchor/r{ends[0]}" if len(ends) == 1 else f"mutual/r{ends[0]}-r{ends[1]}"
    return {
        **table,
        "seed": draw.getrandbits(31),
        "max_ticks": MOST_TICKS,
        "group": table["group"] | {"robots": robots},
        "mission": table["mission"] | {"tolerates": 1, "accuracy": 0.3, "noise": noise},
        "world": {"range": {"model": "attacked", "options": {"link": link} | ATTACKS[attack]}},
    }, [f"r{one}" for one in ends]


class Claimant(NamedTuple):
    """A robot with a claim that stands, and its odometry."""

    tick: int
    """The tick of the claim."""
    start: Pose
    """The pose of tick 0 that follows from the claim."""
    track: list[Pose]
    """The pose in each tick, relative to that of tick 0."""


def claimants(run: Run) -> dict[str, Claimant]:
    """Return the robots with claims at the end of `run`."""
    found = {}
    for robot, verdict in run.verdicts().items():
        if not isinstance(verdict, Localised):
            continue
        steps = run.agents[robot].steps
        told = [one.command.verdict if one.command is not None else None for one in steps]
        tick = len(told)
        while tick and isinstance(claim := told[tick - 1], Localised):
            tick, pose = tick - 1, claim.pose
        track = [ORIGIN]
        for one in steps[1:]:
            moved = one.observation.executed
            assert moved is not None
            track.append(step(track[-1], moved.v, moved.omega, run.scenario.mission.period))
        found[robot] = Claimant(tick, compose(pose, inverse(track[tick])), track)
    return found


class Ranged(NamedTuple):
    """A range between two robots with claims, or between one and its anchor."""

    robot: int
    """The place of the robot among those with claims."""
    at: complex
    """The position of the robot in m, relative to its start."""
    peer: int | None
    """The place of the other robot; None for the anchor."""
    there: complex
    """The position of the other robot, relative to its start, or of the anchor."""
    range: float


def ranges(run: Run, claimed: dict[str, Claimant]) -> list[Ranged]:
    """Return the ranges between the robots in `claimed` and to their anchors, up to the later claim."""
    found, names = list[Ranged](), list(claimed)
    for i, name in enumerate(names):
        anchor = next(one.anchor for one in run.scenario.robots if one.id == name)
        assert anchor is not None
        tick, track = claimed[name].tick, claimed[name].track
        for one, at in zip([each.observation for each in run.agents[name].steps], track, strict=True):
            if one.anchor_range is not None and one.tick <= tick:
                beacon = complex(anchor.x, anchor.y)
                found.append(Ranged(i, complex(at.x, at.y), None, beacon, one.anchor_range))
            for contact in one.contacts:
                peer = claimed.get(contact.peer)
                if peer is None or contact.range is None or names.index(contact.peer) <= i:
                    continue
                if one.tick <= max(tick, peer.tick):
                    there = peer.track[one.tick]
                    place = names.index(contact.peer)
                    found.append(
                        Ranged(i, complex(at.x, at.y), place, complex(there.x, there.y), contact.range)
                    )
    return found


def agreeing(run: Run, claimed: dict[str, Claimant], sigma: float) -> set[str]:
    """Return the robots whose ranges agree with the starts near the claimed ones that fit all ranges best."""
    measured = ranges(run, claimed)
    starts = np.array([(one.start.x, one.start.y, one.start.heading) for one in claimed.values()])
    residual = np.zeros(len(measured))
    for _ in range(ITERATIONS):
        slopes = np.zeros((len(measured), starts.size))
        for row, one in enumerate(measured):
            gap, turned = _placed(starts[one.robot], one.at)
            other, other_turned = one.there, 0j
            if one.peer is not None:
                other, other_turned = _placed(starts[one.peer], one.there)
            gap -= other
            residual[row] = (abs(gap) - one.range) / sigma
            slopes[row, 3 * one.robot :][:3] = _slope(gap, turned) / sigma
            if one.peer is not None:
                slopes[row, 3 * one.peer :][:3] = -_slope(gap, other_turned) / sigma
        starts -= np.linalg.lstsq(slopes, residual, rcond=None)[0].reshape(starts.shape)
    at = [(one.robot, one.peer) for one in measured]
    return {name for k, name in enumerate(claimed) if _is_probable(residual[[k in one for one in at]])}


def _placed(start: Array, at: complex) -> tuple[complex, complex]:
    """Return the position `at` of a robot with `start`, and its part that turns with the start."""
    turned = complex(at * np.exp(1j * start[2]))
    return complex(start[0], start[1]) + turned, turned


def _slope(gap: complex, turned: complex) -> Array:
    """Return the derivative of |gap| with respect to the start of the robot at its first end."""
    return np.array((gap.real, gap.imag, (gap.conjugate() * 1j * turned).real)) / abs(gap)


def _is_probable(residuals: Array) -> bool:
    """Return whether the chi-square of `residuals` has at least LEAST_PROBABLE; three unknowns were fitted.

    With three ranges or fewer, nothing contradicts a claim.
    """
    free = len(residuals) - 3
    return free < 1 or chi2_p_value(float((residuals**2).sum()), free) >= LEAST_PROBABLE


def counted(run: Run, at_link: list[str], sigma: float) -> Counter[str]:
    """Return what a mission adds to COLUMNS."""
    reports = [one.report for agent in run.agents.values() for each in agent.steps for one in each.reports]
    inconsistent = any(isinstance(one.verdict, Inconsistent) for one in reports)
    assert run.end is not None
    inconsistent |= any(one.code == "inconsistent" for one in run.end.causes)
    found = Counter({"missions": 1, "inconsistent": int(inconsistent)})
    claimed, ids = claimants(run), [one.id for one in run.scenario.robots]
    agree = agreeing(run, claimed, sigma) if claimed else set()
    for robot, claimant in claimed.items():
        command = run.command(robot, claimant.tick)
        assert command is not None
        assert isinstance(command.verdict, Localised)
        truth = run.ticks[claimant.tick].truth.poses[ids.index(robot)]
        is_wrong = mistake(robot, command.verdict, truth, run.scenario.mission) is not None
        at = robot in at_link
        claims, wrong = ("claims at the link", "wrong there") if at else ("claims of others", "wrong")
        found[claims] += 1
        found[wrong] += is_wrong
        found["agreeing"] += robot in agree
        found["wrong, agreeing"] += is_wrong and robot in agree
    return found


def main(arguments: list[str]) -> int:
    """Run missions of all attacks in turn until the time is used or a signal comes, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cpu", type=float, default=600.0, help="the processor time in s")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    draw = random.Random(f"{options.seed}/links")
    rows: dict[tuple[str, float], Counter[str]] = {}
    stopped = Event()
    for signal_ in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_, lambda *_: stopped.set())
    while time.process_time() < options.cpu and not stopped.is_set():
        robots, sigma = draw.choice((4, 5)), draw.choice((0.001, 0.05))
        for attack in ATTACKS:
            table, at_link = table_of(attack, robots, sigma, draw)
            run = recorded(validate(table, "links").scenario, "links")
            found = counted(run, at_link, sigma)
            if found["wrong"] + found["wrong there"]:
                print(f"wrong: {attack}: {table}", file=sys.stderr, flush=True)
            rows.setdefault((attack, sigma), Counter()).update(found)
    print(f"| attack | sigma, m | {' | '.join(COLUMNS)} |\n{'| --- ' * (2 + len(COLUMNS))}|")
    for (attack, sigma), row in sorted(rows.items(), key=lambda one: one[0][1]):
        print(f"| {attack} | {sigma:g} | {' | '.join([str(row[one]) for one in COLUMNS])} |")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
