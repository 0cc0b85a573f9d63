"""The syntax of fault plans: `[[fault]]` in a scenario file, `--fault "a->b: loss=0.3, delay=0..3"`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from msgspec.structs import asdict

from compose.errors import BadFault
from compose.scenario.toml_file import field_first
from world.faults import MAX_DELAY, MAX_FAULTS, Delay, Fault, LinkSelector

_LINK = re.compile(r"\s*(?P<one>[A-Za-z0-9_-]+)\s*(?P<way><->|->)\s*(?P<other>[A-Za-z0-9_-]+)\s*")
_FAULT_NUMBER = re.compile(r"-?[0-9]*\.?[0-9]+(?:[eE]-?[0-9]+)?")
EVERYWHERE = "*"
"""The text of a link that selects all links."""


class FaultTable(Fault, frozen=True, array_like=False, forbid_unknown_fields=True):
    """A `[[fault]]` table: a `Fault` with its link and its delay in the syntax of scenario files."""

    link: str = EVERYWHERE  # type: ignore[assignment]
    """Link a->b, both directions a<->b, or * for all links."""
    delay: Delay | Annotated[list[Delay], Meta(min_length=2, max_length=2)] = 0  # type: ignore[assignment]
    """Delay in ticks, or the bounds between which it is drawn, both included."""


def fault(table: FaultTable, pairs: Iterable[tuple[str, str]]) -> Fault:
    """Return the fault that `table` describes, where `pairs` are the pairs of robots. Raises BadFault."""
    least, most = table.delay if isinstance(table.delay, list) else (table.delay, table.delay)
    for name, window in (
        ("delay", (least, most)),
        ("ticks", table.ticks),
        ("contact_ticks", table.contact_ticks),
    ):
        if window is not None and window[0] > window[1]:
            raise BadFault(f"{name}: the lower bound {window[0]} is above the upper bound {window[1]}")
    if table.burst_start > 0.0 and table.burst_end == 0.0:
        raise BadFault("burst_end: must be above 0; for a burst that never ends, set partition")
    return Fault(**asdict(table) | {"link": _link(table.link, list(pairs)), "delay": (least, most)})


def added(plan: Sequence[Fault], table: FaultTable, pairs: Sequence[tuple[str, str]]) -> tuple[Fault, ...]:
    """Return `plan` with the fault that `table` describes appended.

    `pairs` holds each pair of robots in both orders. Raises BadFault.
    """
    plan = (*plan, fault(table, pairs))
    for sender, receiver in pairs:
        if plan[-1].on(sender, receiver):
            on_link = [one for one in plan if one.on(sender, receiver)]
            if len(on_link) > MAX_FAULTS:
                raise BadFault(f"link: more than {MAX_FAULTS} faults from '{sender}' to '{receiver}'")
            delay = sum([one.delay[1] for one in on_link])
            if delay > MAX_DELAY:
                raise BadFault(
                    f"delay: up to {delay} ticks in total from '{sender}' to '{receiver}', "
                    f"more than {MAX_DELAY}"
                )
    return plan


def _link(text: str, pairs: Sequence[tuple[str, str]]) -> LinkSelector | None:
    if text.strip() == EVERYWHERE:
        return None
    match = _LINK.fullmatch(text)
    if match is None:
        raise BadFault(f"link: '{text}' is not a link; expected a->b, a<->b or *")
    one, other = match["one"], match["other"]
    if (one, other) not in pairs and (other, one) not in pairs:
        raise BadFault(f"link: '{one}' and '{other}' are not a pair of the scenario")
    return LinkSelector(one, other, both=match["way"] == "<->")


def table_of(text: str) -> dict[str, Any]:
    """Return the fault table of `text`, which is `LINK: NAME=VALUE, ...`; without LINK, all links.

    Raises BadFault.
    """
    link, colon, rest = text.rpartition(":")
    table: dict[str, Any] = {"link": link.strip()} if colon else {}
    for part in rest.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not name:
            raise BadFault(f"'{text}' has an empty entry; expected the form a->b: loss=0.3, delay=0..3")
        if "->" in name:
            raise BadFault(f"'{name}' has no colon after its link; expected the form a->b: loss=0.3")
        if name in table:
            raise BadFault(f"{name}: given twice")
        table[name] = _value(name, value) if equals else True
    try:
        msgspec.convert(table, FaultTable)
    except msgspec.ValidationError as error:
        raise BadFault(field_first(str(error), FaultTable)) from None
    return table


def _value(name: str, text: str) -> bool | float | list[float]:
    if text in ("true", "false"):
        return text == "true"
    numbers = text.split("..")
    if len(numbers) > 2 or not all(_FAULT_NUMBER.fullmatch(number) for number in numbers):
        raise BadFault(f"{name}: '{text}' is neither a number nor a range such as 0..3")
    values = [int(number) if number.isdigit() else float(number) for number in numbers]
    return values if len(values) == 2 else values[0]
