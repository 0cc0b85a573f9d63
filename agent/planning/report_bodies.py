"""The bodies of reports: what a planner returns and receives, and the messages in which it is sent.

The body of a planner that exchanges motion logs is a `Report`, which is a message itself. Any other body is
encoded, and sent in the field `body` of one.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import msgspec

from agent.planning.planner import Planner
from protocol.messages import Inconsistent, Report, Undecided, Verdict
from protocol.wire import MalformedFrame

SHORT_REASON = 24
"""The maximum number of characters of a reason beside a body, so that most of a report is the body."""


def report_of(body: Any, tick: int, robot: str, heard: int = 0, verdict: Verdict | None = None) -> Report:
    """Return the message of `robot` at `tick` with the `body` that its planner has returned.

    `heard` is the tick of the peer's latest report, and `verdict` that of the latest Command.
    """
    if isinstance(body, Report):
        return body
    match verdict:
        case Undecided(reason):
            verdict = Undecided(reason[:SHORT_REASON])
        case Inconsistent(claim, residual, p_value):
            verdict = Inconsistent(claim[:SHORT_REASON], residual, p_value)
    return Report(tick, robot, heard=heard, verdict=verdict, body=msgspec.msgpack.encode(body))


def body_of(report: Report, planner: Planner[Any, Any]) -> Any:
    """Return the body of `report`, as `planner` receives it.

    Raises MalformedFrame if it is not of the planner's type.
    """
    return report if planner.BODY is Report else decoded(report, planner)


def decoded(report: Report, planner: Planner[Any, Any]) -> Any:
    """Return what is encoded in `report`, of the type of the planner's bodies. Raises MalformedFrame."""
    if report.body is None:
        raise MalformedFrame("a report without a body, and this robot's planner has reports of its own")
    try:
        return _decoder(planner.BODY).decode(report.body)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedFrame(f"its body: {error}") from None


@cache
def _decoder(body: Any) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(body)


def malformed(report: Report, planner: Planner[Any, Any]) -> str | None:
    """Return why the planner's decoder refuses `report`; None if it does not."""
    try:
        return planner.malformed(body_of(report, planner))
    except MalformedFrame as error:
        return str(error)
