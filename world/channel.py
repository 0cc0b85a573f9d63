"""The channel model: which Reports are received on a link, the way from one robot to its peer, in each tick.

Without faults, every Report is received in the tick in which it is sent. A Report is only received if the
robots are in contact both when it is sent and when it is due.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec

from world.faults import LATEST, Fault
from world.random_streams import uniform


class InFlight(NamedTuple):
    """A copy of a Report that has been sent, and is not due yet."""

    due: int
    """The tick in which it is received."""
    tick: int
    """The tick in which it was sent."""
    overtaken: bool
    """True if it is received after the Reports that are sent in the tick in which it is due."""
    damaged: bool
    """True if it arrives damaged."""
    copy: int
    """The identity of the copy: bit i is set if the fault at index i has duplicated it."""
    arrived: bool = False
    """True if another copy has arrived before."""


class LinkState(msgspec.Struct, frozen=True):
    """The state of a link at one tick."""

    heard: tuple[int, ...] = ()
    """The ticks of the Reports that are received in this tick, in the order of their arrival."""
    damaged: tuple[int, ...] = ()
    """The ticks of the Reports that arrive damaged in this tick."""
    lost: tuple[int, ...] = ()
    """The ticks of the Reports of which no copy has arrived, and from this tick on none can."""
    flying: tuple[InFlight, ...] = ()
    """The copies that are not due yet."""
    contacts: int = 0
    """The number of ticks so far in which the two robots were in contact."""
    bursts: tuple[bool, ...] = ()
    """A flag for each fault of the link: True during a burst."""
    room: tuple[float, ...] = ()
    """The number of Reports, for each fault of the link, for which its bandwidth still has room."""
    radio: Any = None
    """The state of the link in the radio model."""


class LinkFaults(NamedTuple):
    """The faults that affect one link."""

    sender: str
    """The robot that sends."""
    receiver: str
    """The robot that receives."""
    faults: tuple[tuple[int, Fault], ...]
    """The faults, each with its index in the fault plan."""

    @property
    def name(self) -> str:
        """The name of the link, such as "a->b", which keys its random numbers."""
        return f"{self.sender}->{self.receiver}"


def link_faults(plan: Sequence[Fault], sender: str, receiver: str) -> LinkFaults:
    """Return the faults of `plan` that affect the link from `sender` to `receiver`."""
    on_it = [(i, fault) for i, fault in enumerate(plan) if fault.on(sender, receiver)]
    return LinkFaults(sender, receiver, tuple(on_it))


def idle_link_state(links: LinkFaults, tick: int, radio: Any = None) -> LinkState:
    """Return the state before `tick` of a link whose robots have not been in contact before.

    Only the room under the bandwidths of its faults may have changed. `radio` is that in the radio model.
    """
    room = [
        1.0 + (fault.reports_per_tick or 0.0 if _has_begun(fault, tick) else 0.0) for _, fault in links.faults
    ]
    return LinkState(room=tuple(room), radio=radio)


def _has_begun(fault: Fault, tick: int) -> bool:
    """Return whether `fault` was active in a tick before `tick`, on a link that was never in contact."""
    first = fault.ticks[0] if fault.ticks is not None else 0
    return first < tick and fault.active(first, 0)


def next_link_state(
    air: LinkState,
    links: LinkFaults,
    seed: int,
    tick: int,
    *,
    in_contact: bool,
    delivered: tuple[Any, int | None] = (None, 0),
) -> LinkState:
    """Return the state of the link at `tick`, given its state `air` at the tick before.

    The sender sends a Report at `tick` if the robots are in contact. Reports that are due while they are not
    in contact are lost. `delivered` is the answer of the radio model to this Report: the state of the link,
    and the delay in ticks, None if it is lost. The faults apply to what the model delivers.
    """
    flying, open_ticks = air.flying, {one.tick for one in air.flying if not one.arrived}
    bursts = air.bursts or (False,) * len(links.faults)
    if in_contact:
        open_ticks.add(tick)
        active = [fault.active(tick, air.contacts) for _, fault in links.faults]
        bursts = tuple(
            [
                _burst(burst if air.contacts else None, fault, _draw(seed, i, "burst", links, tick))
                for (i, fault), burst in zip(links.faults, bursts, strict=True)
            ]
        )
        if delivered[1] is not None:
            sent = _sent(links, bursts, active, seed, tick, max(0, delivered[1]))
            flying += tuple([one for one in sent if one.due - tick <= LATEST])
    due = sorted([one for one in flying if one.due <= tick], key=lambda one: one.overtaken)
    coming, room = _limited(due if in_contact else [], links, air, tick)
    came = {one.tick for one in coming}
    left = [one for one in flying if one.due > tick]
    return LinkState(
        heard=tuple([one.tick for one in coming if not one.damaged]),
        damaged=tuple([one.tick for one in coming if one.damaged]),
        lost=tuple(sorted(open_ticks - came - {one.tick for one in left})),
        flying=tuple([one._replace(arrived=True) if one.tick in came else one for one in left]),
        contacts=air.contacts + in_contact,
        bursts=bursts,
        room=room,
        radio=delivered[0] if in_contact else air.radio,
    )


def _burst(burst: bool | None, fault: Fault, draw: float) -> bool:
    """Return whether the link is in a burst next, in a Gilbert-Elliott chain.

    The first state is drawn from the stationary distribution. The chain also runs outside the fault's window.
    """
    if burst is None:
        return draw < fault.bursty
    return draw >= fault.burst_end if burst else draw < fault.burst_start


def _draw(seed: int, fault: int, what: str, links: LinkFaults, tick: int) -> float:
    return uniform(seed, f"fault/{fault}/{what}", links.name, tick)


def _sent(
    links: LinkFaults, bursts: Sequence[bool], active: Sequence[bool], seed: int, tick: int, delay: int = 0
) -> list[InFlight]:
    """Return the copies of the Report of `tick` that are not lost, after all active faults.

    Without them, it would be received after `delay` ticks.
    """
    copies = [InFlight(tick + delay, tick, overtaken=False, damaged=False, copy=0)]
    for (i, fault), burst, is_active in zip(links.faults, bursts, active, strict=True):
        if is_active:
            copies = [copy for one in copies for copy in _faulty(one, i, fault, burst, links, seed)]
    return copies


def _faulty(
    report: InFlight, index: int, fault: Fault, burst: bool, links: LinkFaults, seed: int
) -> list[InFlight]:
    """Return the copies that the fault with this `index` makes of `report`: none if it is lost."""

    def happens(what: str, chance: float, copy: int = report.copy) -> bool:
        return chance > 0.0 and _draw(seed, index, f"{what}/{copy}", links, report.tick) < chance

    if fault.partition or happens("loss", fault.loss) or (burst and happens("burst-loss", fault.burst_loss)):
        return []
    twice = happens("duplicate", fault.duplicate)
    least, most = fault.delay
    copies = []
    for k in (report.copy, report.copy | 1 << index) if twice else (report.copy,):
        due = report.due + least
        if most > least:
            due += int(_draw(seed, index, f"delay/{k}", links, report.tick) * (most - least + 1))
        overtaken = happens("reorder", fault.reorder, k)
        damaged = happens("corrupt", fault.corrupt, k)
        copies.append(
            InFlight(
                due + overtaken, report.tick, report.overtaken or overtaken, report.damaged or damaged, copy=k
            )
        )
    return copies


def _limited(
    due: Sequence[InFlight], links: LinkFaults, air: LinkState, tick: int
) -> tuple[list[InFlight], tuple[float, ...]]:
    """Return those of `due` that fit the bandwidth of every fault, and the room that remains.

    Up to one Report of unused room is carried over to the next tick. If it were dropped after each Report, a
    bandwidth of 0.6 Reports per tick would only let one through in two ticks.
    """
    rates = [
        fault.reports_per_tick if fault.active(tick, air.contacts) else None for _, fault in links.faults
    ]
    room = [
        min(before, 1.0) + rate if rate is not None else before
        for before, rate in zip(air.room or (1.0,) * len(rates), rates, strict=True)
    ]
    coming = []
    for report in due:
        if all(rate is None or left >= 1.0 for rate, left in zip(rates, room, strict=True)):
            room = [left if rate is None else left - 1.0 for rate, left in zip(rates, room, strict=True)]
            coming.append(report)
    return coming, tuple(room)
