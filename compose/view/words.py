"""Sentences that describe the task of a robot."""

from __future__ import annotations

from compose.recording.run_setup import RobotSetup
from protocol.messages import Inconsistent, Undecided, Verdict

SEEKING = {
    "straight": "{robot} drives straight ahead to get a second range to {beacon}",
    "backing": "{robot} has left the range of {beacon} and drives back past its first range position",
    "turning": "{robot} has left the range of {beacon} and makes a quarter turn on the spot",
    "circling": "{robot} drives in a circle until it gets a second range to {beacon}",
    "surveying": "{robot} drives to where the next ranges to {beacon} are most informative",
}
"""Sentences by state name, of states in which a robot drives to get ranges.

The beacon is the robot's own anchor in phase 1 and the peer in phase 3.
"""

DOING = {
    "asleep": "{robot} has not received an observation yet",
    "third-point": "{robot} drives to where a third range distinguishes its two hypotheses",
    "homing": "{robot} drives back to its anchor to measure its pose again",
    "aligning": "{robot} turns until it points straight away from its anchor",
    "radial": "{robot} drives along the radius to its orbit",
    "tangent": "{robot} turns from the radius onto its orbit",
    "orbiting": "{robot} drives on its orbit until {peer} is in range",
    "travelling": "{robot} drives to {peer} to localise it",
    "sweeping": "{robot} covers an area to find robots without an anchor",
    "looping": "{robot} drives loops, so that a robot without an anchor is localised by ranges",
    "standing": "{robot} stands still and waits for {peer}'s second range",
    "waiting": "{robot} stands still and waits for {peer}'s last manoeuvre",
    "last-manoeuvre": "{robot} drives to where the remaining hypotheses predict different ranges",
    "returning": "{robot} has left {peer}'s range and drives the same arc back to report to it",
    "retreating": "{robot} has left {peer}'s range and drives back along its path, and as far again",
    "listening": "{robot} stands still within {peer}'s range and waits for missing reports",
    "localised": "{robot} is localised and stands still",
    "unconfirmed": "{robot} knows a pose by {peer}, and waits until another robot confirms it",
}
"""Sentences by state name, of all other states."""
TRAVELLING = "travelling"
"""The state of a robot that drives to another one of its group."""
OF_TEAMS = {
    "asleep": DOING["asleep"],
    "circling": "{robot} drives a loop and ranges what is near",
    "orbiting": "{robot} drives to where another anchor is in range",
    "surveying": "{robot} drives to where its next ranges are most informative",
    "localised": "{robot} is localised",
    "homing": "{robot} drives back to where it had a range",
    "searching": "{robot} searches for robots that have no range yet",
    "waiting": "{robot} waits until another robot finds it",
    "unlocated": "no pose of {robot} is estimated",
    "doubtful": "the pose of {robot} may not be claimed yet",
}
"""Sentences by state name, of robots of a team."""
WAITING = "{robot} waits beside its anchor until {peer} comes into range"
"""The sentence of the state "orbiting" of a robot whose plan has no speed."""


def doing(robot_setup: RobotSetup, phase: int, state: str, verdict: Verdict | None) -> str:
    """Return a sentence for the phase, state and verdict of a robot's Command.

    The state of a planner of the user is a word whose meaning only the user knows.
    """
    beacon = robot_setup.peer if phase == 3 else "its anchor"
    match verdict:
        case Undecided(reason):
            return f"{robot_setup.id} is undecided: {reason}"
        case Inconsistent(claim):
            where = f"reports of {robot_setup.peer}" if robot_setup.peer is not None else "measurements"
            return f"{robot_setup.id} found an inconsistency in the {where}: {claim}"
    if robot_setup.own_planner:
        return f"{robot_setup.id}: {state}"
    if robot_setup.peer is None:
        return (OF_TEAMS.get(state) or "{robot}: " + state).format(robot=robot_setup.id)
    if robot_setup.given_anchor is None and state == "standing":
        return f"{robot_setup.id} has no anchor, and stands still until a localised robot is in range"
    sentence = SEEKING.get(state) or DOING.get(state) or "{robot}: " + state
    if state == "orbiting" and robot_setup.orbit.v == 0.0:
        sentence = WAITING
    return sentence.format(robot=robot_setup.id, peer=robot_setup.peer, beacon=beacon)
