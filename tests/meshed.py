"""A router that connects to others: `python -m tests.meshed NAME OWN [OTHER...]`, with their endpoints.

It declares what a robot in hardware mode declares, prints "linked" once it has seen the token of every robot
in the standard input, one name a line, and ends with the input.
"""

from __future__ import annotations

import sys

from protocol.network import keys, session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import NO_ARRIVAL, Inbox
from protocol.output import leave

RUN = "mesh"

if __name__ == "__main__":
    name, own, *others = sys.argv[1:]
    awaited = set(sys.stdin.readline().split())
    with session.open_router(Endpoints(tuple(others), (own,)), 5.0, closes=False) as link:
        inbox = Inbox(name)
        starts = session.publisher(link, keys.tick_start(RUN, name))
        for robot in sorted(awaited):
            session.subscribe(link, keys.tick_start(RUN, robot), inbox, "tick-start")
        session.watch_liveliness(link, keys.robot_alive(RUN, "*"), inbox)
        token = session.show_alive(link, keys.robot_alive(RUN, name))
        while awaited:
            arrival = inbox.next(0.05)
            if arrival.topic == "alive":
                awaited.discard(arrival.source.robot)
            elif arrival is NO_ARRIVAL:
                starts.put(b"")
        assert token is not None  # a token that is not kept is withdrawn
        print("linked", flush=True)
        sys.stdin.read()
    leave(0)
