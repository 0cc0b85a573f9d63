"""The pose of a robot that helps others, from its facts and those of the robot with which it was localised.

Nobody has to believe its claim: the pose follows from two logs and the ranges between them, with the
estimator of a pair.
"""

from __future__ import annotations

from msgspec.structs import replace

from agent.estimation import precision
from agent.estimation.estimator import PairEstimate
from agent.estimation.exact import Branch
from agent.estimation.exact_estimator import EXACT
from agent.estimation.knowledge import Belief, Knowledge
from agent.peer.facts import TO_ROBOT, FactSet
from agent.peer.peer_state import PeerState
from protocol.messages import RobotConfig
from protocol.motion import ORIGIN, Pose


def host_estimate(
    facts: FactSet, meeting: RobotConfig, starts: tuple[Pose, Pose], tick: int
) -> PairEstimate | None:
    """Return the estimate of the pair in `meeting`, the configuration of the helper, up to `tick`.

    `starts` are the poses of tick 0 that the helper and its peer have reported, each in its anchor's frame.
    The verdict is Inconsistent if the facts contradict each other. The result is None if they do not suffice.
    Exact sensors only.
    """
    log, peer = facts.log(meeting.robot), facts.log(meeting.peer)
    ranges = facts.ranges(meeting.robot, TO_ROBOT + meeting.peer)
    knowledge = Knowledge(
        meeting,
        tick=tick,
        odometry=log.pose(ORIGIN, tick, meeting.mission.period),
        log=log,
        mutual=tuple([one for one in ranges if one.tick <= tick]),
        belief=Belief(branch=Branch(0.0, starts[0])),
        peer_state=PeerState(peer=peer, start=starts[1]),
    )
    own = precision.anchor(knowledge, starts[0], log).error
    knowledge = replace(knowledge, belief=replace(knowledge.belief, own_anchor=own))
    return EXACT.pair(knowledge, 0, 0, second_range=True)
