"""Which reports reach whom in this tick: the air between two robots, one way.

Without faults every report is heard in the tick in which it is sent. A report is heard only if the tick of
sending and the tick of hearing are both in contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from world.faults import Fault
from world.random_streams import uniform


class InFlight(NamedTuple):
    """A copy of a report under way."""

    due: int
    """the tick in which it comes"""
    tick: int
    """of the report"""
    overtaken: bool
    """whether it comes after those that were sent in the tick in which it is due"""
    damaged: bool
    copy: int
    """which of the copies: bit i is set where the fault at place i has made it"""


class LinkState(msgspec.Struct, frozen=True):
    """One link, after a tick: what it carries, and what has come in it."""

    heard: tuple[int, ...] = ()
    """the ticks of the reports that came in this tick, in order"""
    damaged: tuple[int, ...] = ()
    """of those that came damaged"""
    flying: tuple[InFlight, ...] = ()
    contacts: int = 0
    """ticks in which the two have been in contact"""
    bursts: tuple[bool, ...] = ()
    """of each fault of the link: whether it is in a burst"""
    room: tuple[float, ...] = ()
    """of each: how many reports may come yet"""


class LinkFaults(NamedTuple):
    """The faults on one link, each with its place in the plan."""

    sender: str
    receiver: str
    faults: tuple[tuple[int, Fault], ...]

    @property
    def name(self) -> str:
        """a->b"""
        return f"{self.sender}->{self.receiver}"


def of_plan(plan: Sequence[Fault], sender: str, receiver: str) -> LinkFaults:
    """What of `plan` is on the way from `sender` to `receiver`."""
    on_it = [(i, fault) for i, fault in enumerate(plan) if fault.on(sender, receiver)]
    return LinkFaults(sender, receiver, tuple(on_it))


def carried(air: LinkState, links: LinkFaults, seed: int, tick: int, *, in_contact: bool) -> LinkState:
    """The air one tick on: at `tick`, in which the sender says its report if the two are in contact.

    What is due out of contact is lost.
    """
    flying = air.flying
    bursts = air.bursts or (False,) * len(links.faults)
    if in_contact:
        active = [fault.active(tick, air.contacts) for _, fault in links.faults]
        bursts = tuple(
            [
                _burst(burst if air.contacts else None, fault, _draw(seed, i, "burst", links, tick))
                for (i, fault), burst in zip(links.faults, bursts, strict=True)
            ]
        )
        flying += tuple(_sent(links, bursts, active, seed, tick))
    due = sorted([one for one in flying if one.due <= tick], key=lambda one: one.overtaken)
    coming, room = _let_through(due if in_contact else [], links, air, tick)
    return LinkState(
        heard=tuple([one.tick for one in coming if not one.damaged]),
        damaged=tuple([one.tick for one in coming if one.damaged]),
        flying=tuple([one for one in flying if one.due > tick]),
        contacts=air.contacts + in_contact,
        bursts=bursts,
        room=room,
    )


def _burst(burst: bool | None, fault: Fault, draw: float) -> bool:
    """The chain's next state; its first is as if it had always gone on, as it does outside windows."""
    if burst is None:
        return draw < fault.bursty
    return draw >= fault.burst_end if burst else draw < fault.burst_start


def _draw(seed: int, fault: int, what: str, links: LinkFaults, tick: int) -> float:
    return uniform(seed, f"fault/{fault}/{what}", links.name, tick)


def _sent(
    links: LinkFaults, bursts: Sequence[bool], active: Sequence[bool], seed: int, tick: int
) -> list[InFlight]:
    """The copies of the report of `tick` that are not lost at once."""
    copies = [InFlight(tick, tick, overtaken=False, damaged=False, copy=0)]
    for (i, fault), burst, there in zip(links.faults, bursts, active, strict=True):
        if there:
            copies = [copy for one in copies for copy in _befallen(one, i, fault, burst, links, seed)]
    return copies


def _befallen(
    one: InFlight, place: int, fault: Fault, burst: bool, links: LinkFaults, seed: int
) -> list[InFlight]:
    """What becomes of a copy."""

    def happens(what: str, chance: float, copy: int = one.copy) -> bool:
        return chance > 0.0 and _draw(seed, place, f"{what}/{copy}", links, one.tick) < chance

    if fault.partition or happens("loss", fault.loss) or (burst and happens("burst-loss", fault.burst_loss)):
        return []
    twice = happens("duplicate", fault.duplicate)
    least, most = fault.delay
    copies = []
    for k in (one.copy, one.copy | 1 << place) if twice else (one.copy,):
        due = one.due + least
        if most > least:
            due += int(_draw(seed, place, f"delay/{k}", links, one.tick) * (most - least + 1))
        overtaken = happens("reorder", fault.reorder, k)
        damaged = happens("corrupt", fault.corrupt, k)
        copies.append(
            InFlight(due + overtaken, one.tick, one.overtaken or overtaken, one.damaged or damaged, copy=k)
        )
    return copies


def _let_through(
    due: Sequence[InFlight], links: LinkFaults, air: LinkState, tick: int
) -> tuple[list[InFlight], tuple[float, ...]]:
    """Those of `due` for which every fault's bandwidth has room, and the room that is left.

    What is left is kept, up to one report's: else of 0.6 a tick only one in two ticks would come.
    """
    rates = [
        fault.reports_per_tick if fault.active(tick, air.contacts) else None for _, fault in links.faults
    ]
    room = [
        min(before, 1.0) + rate if rate is not None else before
        for before, rate in zip(air.room or (1.0,) * len(rates), rates, strict=True)
    ]
    coming = []
    for one in due:
        if all(rate is None or left >= 1.0 for rate, left in zip(rates, room, strict=True)):
            room = [left if rate is None else left - 1.0 for rate, left in zip(rates, room, strict=True)]
            coming.append(one)
    return coming, tuple(room)
