"""What a mission needs of its network: routers that answer, by this protocol, with clocks that agree."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack

import zenoh
from msgspec.structs import replace

from compose.doctor import access_checks, running_missions
from compose.doctor.access_checks import ASK_S, SessionPair, probe_run
from compose.doctor.finding import Finding, fix, ok, untried
from compose.doctor.router_session import Unreached, linked
from protocol.network import access_control, keys, session
from protocol.network.endpoints import Endpoints, is_encrypted
from protocol.wire import VERSION, version_of

APART_S = 60.0
"""clocks that differ by more are to be set: records would be hard to compare, certificates may be refused"""


def network(endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    """Of each router by itself; listens for `wait` s to a mission."""
    if not endpoints.connect:
        yield untried("network: there is no --connect")
    for endpoint in endpoints.connect:
        yield from _at(replace(endpoints, connect=(endpoint,), listen=()), wait)


def _at(endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    with ExitStack() as stack:
        try:
            pair = SessionPair(*(stack.enter_context(linked(endpoints)) for _ in range(2)))
        except Unreached as error:
            yield fix(f"router: {error}")
            return
        way = "over TLS" if all(map(is_encrypted, endpoints.connect)) else "in the clear"
        yield ok(f"router: {endpoints} answers, {way}")
        yield from access_checks.tried(pair, endpoints, wait)
        yield _clock(pair, endpoints)
        yield from _missions(pair.hearer, endpoints, wait)


def _clock(pair: SessionPair, endpoints: Endpoints) -> Finding:
    """A router stamps what passes it with its own time, between the moments when it is sent and comes.

    That time is at most 0.5 s ahead of its host's, where another router's was.
    """
    who = endpoints.participant
    if who == access_control.VIEWER:
        return untried(
            "clock: the router stamps what is said, and viewers say nothing; try by a robot's keys"
        )
    me = who.removeprefix(access_control.agent("")) if who is not None else "doctor"
    sent = time.time()
    came = pair.passed({"Report": keys.report(probe_run(), me, me)}).get("Report")
    if came is None or came.timestamp is None:
        return untried("clock: the router lets nothing pass, or puts no time on it")
    return compared(came.timestamp.get_time().timestamp() - sent, time.time() - sent)


def compared(ahead: float, took: float) -> Finding:
    """Of a router's clock that was `ahead` of when a frame was sent here, and took so long to come, in s."""
    least, most = ahead - took, ahead
    if least <= 0.0 <= most:
        return ok(f"clock: the router's is this host's, to {took:.3f} s")
    apart = f"between {abs(min(least, most, key=abs)):.3f} and {abs(max(least, most, key=abs)):.3f} s"
    way = "ahead" if least > 0.0 else "behind"
    if min(abs(least), abs(most)) > APART_S:
        why = "no decision needs it, but certificates and people do"
        return fix(f"clock: the router's is {apart} {way}; set one of the two (`timedatectl`): {why}")
    return ok(f"clock: the router's is {apart} {way}, which no decision depends on")


def _missions(link: zenoh.Session, endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    who = endpoints.participant
    if who is not None and who.startswith(access_control.agent("")):
        found = list(_of_robot(link, who.removeprefix(access_control.agent(""))))
    else:
        found = [_told(one) for one in running_missions.look(link, wait)]
    yield from found or [ok("alive: nobody; no mission is on this network")]


def _told(mission: running_missions.RunningMission) -> Finding:
    there = ", ".join(
        [*(["its world"] if mission.world else []), *(one.robot for one in mission.robots if one.there)]
    )
    missing = f"; not there: {', '.join(mission.missing)}" if mission.missing else ""
    if wrong := [version for version in mission.versions if version != VERSION]:
        return _foreign(mission.run, wrong[0])
    spoken = ", all by this protocol version" if mission.versions else ""
    return ok(f"alive: {mission.run}: {there}{spoken}{missing}")


def _foreign(run: str, version: int) -> Finding:
    return fix(
        f"versions: {run} speaks protocol version {version}, and this machine {VERSION}; "
        "install the same tandem-ranging everywhere"
    )


def _of_robot(link: zenoh.Session, robot: str) -> Iterator[Finding]:
    """A robot is told of worlds, of what they have for it, and of itself."""
    for run in [key.run for key in session.alive(link, keys.world_alive("*"), ASK_S)]:
        answer = session.ask(link, keys.config(run, robot), ASK_S)
        if answer is None:
            yield fix(f"alive: {run}: its world does not answer; check that it runs, and is not stopped")
        elif isinstance(answer, str):
            yield fix(f"alive: {run}: {answer}")
        elif (version := version_of(answer)) is not None and version != VERSION:
            yield _foreign(run, version)
        else:
            played = session.alive(link, keys.robot_alive(run, robot), ASK_S)
            own = f"{robot}'s agent, too" if played else f"{robot}'s agent is not there"
            yield ok(f"alive: {run}: its world, by this protocol version; {own}")
