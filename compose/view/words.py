"""What a robot is doing, in a sentence."""

from __future__ import annotations

from compose.view.cast import Seat
from protocol.messages import Inconsistent, Undecided, Verdict

SEEKING = {
    "straight": "{robot} drives straight ahead, for a second range to {beacon}",
    "backing": "{robot} has left the range of {beacon} ahead, and drives back past where it turned to it",
    "turning": "{robot} has left the range of {beacon}, and turns by a quarter on the spot",
    "circling": "{robot} circles until {beacon} ranges it",
    "surveying": "{robot} drives where the next ranges to {beacon} tell most",
}
"""in phase 1 the beacon is the robot's anchor, in phase 3 the peer"""

DOING = {
    "asleep": "{robot} has not sensed anything yet",
    "third-point": "{robot} drives to where a third range tells its two branches apart",
    "homing": "{robot} has lost its anchor, and drives back to where that was ranged last",
    "aligning": "{robot} turns to head straight away from its anchor",
    "radial": "{robot} drives along the radius to its orbit",
    "tangent": "{robot} turns from the radius onto its orbit",
    "orbiting": "{robot} goes round its anchor, and looks for {peer}",
    "standing": "{robot} stands still; waits for {peer}'s second range",
    "waiting": "{robot} stands still; waits for {peer}'s last manoeuvre",
    "last-manoeuvre": "{robot} drives to where the placements that are left predict different ranges",
    "returning": "{robot} has left {peer}'s range, and drives the same arc back to tell it",
    "retreating": "{robot} has left {peer}'s range, and drives back as it came, and as far again",
    "listening": "{robot} stands in {peer}'s range; waits for what it has not been told yet",
    "localised": "{robot} knows where it is, and stands",
}
WAITING = "{robot} waits beside its anchor until {peer} comes by"
"""orbiting, where the plan gives it no speed"""


def doing(seat: Seat, phase: int, state: str, verdict: Verdict | None) -> str:
    """What a robot is doing whose Command says so."""
    beacon = seat.peer if phase == 3 else "its anchor"
    match verdict:
        case Undecided(reason):
            return f"{seat.id} cannot go on: {reason}"
        case Inconsistent(claim):
            return f"{seat.id} does not believe {seat.peer}, which tells {claim}"
    sentence = SEEKING.get(state) or DOING.get(state) or "{robot}: " + state
    if state == "orbiting" and seat.orbit.v == 0.0:
        sentence = WAITING
    return sentence.format(robot=seat.id, peer=seat.peer, beacon=beacon)
