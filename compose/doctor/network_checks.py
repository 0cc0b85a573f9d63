"""Checks of the network: the routers, their clocks and missions, and the protocol version."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from typing import Any

import zenoh
from msgspec.structs import replace

from compose.doctor import running_missions
from compose.doctor.running_missions import ASK_S, Unreached, linked
from compose.terminal.finding import Finding, fix, ok, untried
from protocol.network import access_control, keys, session
from protocol.network.endpoints import Endpoints, is_encrypted
from protocol.wire import VERSION, version_of

APART_S = 60.0
"""The difference in s from which clocks must be set, because certificates may be refused."""


def network(endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    """Check each router separately, and listen to each mission for `wait` s."""
    if not endpoints.connect:
        yield untried("network: there is no --connect")
    for endpoint in endpoints.connect:
        yield from _at(replace(endpoints, connect=(endpoint,), listen=()), wait)


def _at(endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    try:
        with linked(endpoints) as link, linked(endpoints) as other:
            way = "over TLS" if all(map(is_encrypted, endpoints.connect)) else "in the clear"
            yield ok(f"router: {endpoints} answers, {way}")
            yield _clock(link, other, endpoints)
            yield from _missions(link, endpoints, wait)
    except Unreached as error:
        yield fix(f"router: {error}")


def _clock(link: zenoh.Session, other: zenoh.Session, endpoints: Endpoints) -> Finding:
    """Compare the clock of the router with this host's.

    The router adds its time to a sample that passes from `other` to `link`, between the times at which it
    is sent and received here. Its time is at most 0.5 s ahead of its host's, if another router's time was.
    The sample is on the key of a Report in a run that does not exist.
    """
    if endpoints.participant == access_control.VIEWER:
        return untried("clock: the test publishes a sample, which a viewer may not; test with a robot's keys")
    robot = _robot(endpoints)
    key = keys.report(f"doctor-{random.SystemRandom().getrandbits(64):016x}", robot, robot)
    subscriber: Any = link.declare_subscriber(key, zenoh.handlers.RingChannel(1))
    _settle(link, other)
    sent = time.time()
    other.put(key, b"")
    _settle(other, link)
    sample = subscriber.try_recv()
    subscriber.undeclare()
    if sample is None or sample.timestamp is None:
        return untried("clock: the router does not let the sample pass, or adds no time to it")
    return compared(sample.timestamp.get_time().timestamp() - sent, time.time() - sent)


def _robot(endpoints: Endpoints) -> str:
    """Return the robot whose keys are used, or a name if there are none."""
    return (endpoints.participant or "doctor").removeprefix(access_control.agent(""))


def _settle(*links: zenoh.Session) -> None:
    """Wait until earlier messages of `links` have passed the router, with a query on each."""
    for link in links:
        session.alive(link, keys.world_alive("*"), ASK_S)


def compared(ahead: float, took: float) -> Finding:
    """Return the finding on a router's clock.

    `ahead` is the router's timestamp of a sample minus the time of sending it here, in s. `took` is the time
    from sending to receiving it, in s.
    """
    least, most = ahead - took, ahead
    if least <= 0.0 <= most:
        return ok(f"clock: the router's agrees with this host's within {took:.3f} s")
    apart = f"between {abs(min(least, most, key=abs)):.3f} and {abs(max(least, most, key=abs)):.3f} s"
    way = "ahead" if least > 0.0 else "behind"
    if min(abs(least), abs(most)) > APART_S:
        why = "decisions do not depend on it, but certificates do"
        return fix(f"clock: the router's is {apart} {way}; set one of the two (`timedatectl`): {why}")
    return ok(f"clock: the router's is {apart} {way}; decisions do not depend on it")


def _missions(link: zenoh.Session, endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    if (endpoints.participant or "").startswith(access_control.agent("")):
        found = list(_missions_of_robot(link, _robot(endpoints)))
    else:
        found = [_mission(one) for one in running_missions.look(link, wait)]
    yield from found or [ok("alive: no mission is running on this network")]


def _mission(mission: running_missions.RunningMission) -> Finding:
    present = ", ".join(
        [*(["its world"] if mission.world else []), *(one.robot for one in mission.robots if one.there)]
    )
    missing = f"; not alive: {', '.join(mission.missing)}" if mission.missing else ""
    if wrong := [version for version in mission.versions if version != VERSION]:
        return _foreign(mission.run, wrong[0])
    version = ", all with this protocol version" if mission.versions else ""
    return ok(f"alive: {mission.run}: {present}{version}{missing}")


def _foreign(run: str, version: int) -> Finding:
    return fix(
        f"versions: {run} has protocol version {version}, and this machine {VERSION}; "
        "install the same tandem-ranging everywhere"
    )


def _missions_of_robot(link: zenoh.Session, robot: str) -> Iterator[Finding]:
    """Check each running mission as far as the keys of `robot` allow: its world and its own agent."""
    for run in [key.run for key in session.alive(link, keys.world_alive("*"), ASK_S)]:
        answer = session.ask(link, keys.config(run, robot), ASK_S)
        if answer is None:
            yield fix(f"alive: {run}: its world does not answer; check that it runs and is not suspended")
        elif isinstance(answer, str):
            yield fix(f"alive: {run}: {answer}")
        elif (version := version_of(answer)) is not None and version != VERSION:
            yield _foreign(run, version)
        else:
            agents = session.alive(link, keys.robot_alive(run, robot), ASK_S)
            own = f"{robot}'s agent" if agents else f"not alive: {robot}'s agent"
            yield ok(f"alive: {run}: its world, with this protocol version; {own}")
