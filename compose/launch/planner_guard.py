"""A guard around a planner of the user: its mistakes are one line that names the method and the tick."""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from agent.planning.planner import Planner, Summary, body_of, report_of
from compose.errors import PlannerFailed
from protocol.messages import Command, Estimate, Observation, Report, RobotConfig
from protocol.mission import Mission
from protocol.orbits import Rendezvous
from protocol.wire import MAX_REPORT_BYTES, MalformedFrame, decode, encode

ANSWERS = {"command": Command, "estimate": Estimate, "summary": Summary, "rendezvous": Rendezvous}
"""The types of the answers, by method."""
LIMIT_ROUNDING = 1e-12
"""The part of a limit by which rounding may move a quotient of a length and a period beyond it."""


def beyond_limits(v: float, omega: float, mission: Mission) -> str | None:
    """Return which of two speeds (m/s, rad/s) is beyond its limit, for a user; None if both keep it."""
    for name, value, limit in (("v", v, mission.max_speed), ("omega", omega, mission.max_turn_rate)):
        if abs(value) > limit * (1.0 + LIMIT_ROUNDING):
            return f"{name} = {value:.14g}, expected at most {limit:g}"  # digits that show the excess
    return None


def _field_first(error: str, message: msgspec.Struct) -> str:
    """Return msgspec's `error` about `message` between the name of the field and its value."""
    match = re.fullmatch(r"(.*) - at `\$\[(\d+)\].*`", error, re.DOTALL)
    place = int(match[2]) - 1 if match is not None else -1  # the first element is the tag
    if match is None or not 0 <= place < len(message.__struct_fields__):
        return error
    field = message.__struct_fields__[place]
    return f"{field}: {match[1].replace('`', chr(39))}, got {getattr(message, field)!r:.40}"


def _guarded(method: str) -> Any:
    """Return the method of a guard that calls `method` of its planner."""

    def called(self: GuardedPlanner, *arguments: Any) -> Any:
        return self.answered(method, *arguments)

    return called


class GuardedPlanner(Planner[Any, Any]):
    """A planner whose answers are checked. There is one for each robot.

    Its methods raise PlannerFailed for whatever the planner raises, and for answers that no message can have.
    """

    def __init__(self, name: str, planner: Planner[Any, Any]) -> None:
        """`planner` is the planner of the user, and `name` its name."""
        self._name = name
        self._planner = planner
        self._robot = ""
        self._config: RobotConfig | None = None
        self._tick: int | None = None
        """The tick of the latest Observation."""
        self.decoder_error: str | None = None
        """The latest exception of the planner's decoder; None if it has raised none."""
        self.BODY = planner.BODY
        self.MANOEUVRES = planner.MANOEUVRES
        self.ACTIVE_SENSING = planner.ACTIVE_SENSING
        self.REQUIRED_PLACES = planner.REQUIRED_PLACES

    def start(self, config: RobotConfig) -> Any:
        """Return the first state."""
        self._robot, self._config = config.robot, config
        return self._called(self._planner.start, config)

    def observe(self, state: Any, observation: Observation) -> Any:
        """Return the state with the sensor data."""
        self._tick = observation.tick
        return self._called(self._planner.observe, state, observation)

    def report(self, state: Any) -> Any:
        """Return the body of the report, once it is certain that the peer's decoder takes it."""
        return self._sendable("report", self._called(self._planner.report, state))

    def report_to(self, state: Any, peer: str) -> Any:
        """Return the body of the report to one of several peers, checked likewise."""
        return self._sendable("report_to", self._called(self._planner.report_to, state, peer))

    def _sendable(self, method: str, body: Any) -> Any:
        try:
            report = report_of(body, self._tick or 0, self._robot)
            frame = encode(report)
            if len(frame) > MAX_REPORT_BYTES:
                raise self._failed(method, f"its report has {len(frame)} bytes, at most {MAX_REPORT_BYTES}")
            sent = decode(frame, type(report), MAX_REPORT_BYTES)
            received = body_of(sent, self._planner)
        except (MalformedFrame, TypeError, ValueError, OverflowError, msgspec.MsgspecError) as error:
            raise self._failed(method, f"its report cannot be sent: {error}") from None
        if isinstance(body, Report):
            self._check_address(method, body)
        why = self._called(self._planner.malformed, received)
        if why is not None:
            raise self._failed(method, f"its own decoder refuses its report: {why}")
        return body

    def malformed(self, body: Any) -> str | None:
        """Return why the planner's decoder refuses a body, or what it raises."""
        try:
            return self._planner.malformed(body)
        except (Exception, SystemExit) as error:  # noqa: BLE001  # an unknown process may have sent the body
            self.decoder_error = f"the decoder of {self._name} raises {type(error).__name__}: {error}"
            return self.decoder_error

    decide, misreport, required_mutual_ranges = map(
        _guarded, ("decide", "misreport", "required_mutual_ranges")
    )
    command, estimate, summary, rendezvous = map(_guarded, ANSWERS)

    def answered(self, method: str, *arguments: Any) -> Any:
        """Return the answer of a method, once it is certain that it is of its kind, and of this tick."""
        found, kind = self._called(getattr(self._planner, method), *arguments), ANSWERS.get(method, object)
        if not isinstance(found, kind):
            raise self._failed(method, f"returns {type(found).__name__}, expected {kind.__name__}")
        if isinstance(found, Command | Estimate):
            try:
                decode(encode(found), kind)
            except (MalformedFrame, TypeError, ValueError, OverflowError, msgspec.MsgspecError) as error:
                why = _field_first(str(error), found)
                raise self._failed(method, f"its {kind.__name__} cannot be sent: {why}") from None
            self._check_address(method, found)
        if isinstance(found, Command) and self._config is not None:
            others = self._config.others
            if found.peer not in (None, *others):
                raise self._failed(method, f"returns the peer {found.peer}, expected {' or '.join(others)}")
            if (beyond := beyond_limits(found.v, found.omega, self._config.mission)) is not None:
                raise self._failed(method, f"returns {beyond}")
        return found

    def _check_address(self, method: str, found: Any) -> None:
        if (found.tick, found.robot) != (self._tick, self._robot):
            raise self._failed(
                method, f"returns a message of {found.robot} at tick {found.tick}, not of {self._robot} now"
            )

    def _called(self, method: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return method(*arguments)
        except (Exception, SystemExit) as error:  # the user's code may raise anything
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(place.filename).name}:{place.lineno}"
            raise self._failed(
                method.__name__, f"raises {type(error).__name__}: {error} ({where})"
            ) from error

    def _failed(self, method: str, what: str) -> PlannerFailed:
        tick = f" at tick {self._tick}" if self._tick is not None else ""
        colon = ":" if what.startswith("its ") else ""
        return PlannerFailed(f"the planner {self._name}: {method}(){tick}{colon} {what}")
