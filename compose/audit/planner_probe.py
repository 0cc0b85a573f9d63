"""Planners that watch a planner of the user while it runs a mission: is it pure, and can reports harm it?"""

from __future__ import annotations

import pickle
import random
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec

from agent.planning.planner import Planner, body_of, malformed, report_of
from compose.errors import PlannerFailed
from compose.launch.planner_guard import GuardedPlanner
from protocol.messages import Observation, Report, RobotConfig
from protocol.wire import MAX_REPORT_BYTES, MalformedFrame, decode, encode

MUTANTS = 24
"""The number of false reports that are made of each true one."""
EXTREMES: tuple[Any, ...] = (
    0,
    -1,
    2**31,
    2**53,
    -(2**53),
    1e-300,
    1e18,
    -1e18,
    float("inf"),
    float("nan"),
    "",
    None,
    [],
    True,
)
"""The values that false reports contain."""


class BreaksContract(Exception):
    """The planner breaks a rule of its contract; the text says which, where and when."""


class Watched(GuardedPlanner):
    """A planner of the user that is watched. Subclasses check it."""

    report_to = Planner.report_to

    def __init__(self, name: str, fresh: Callable[[], Planner[Any, Any]]) -> None:
        """`fresh` returns a new planner of the kind `name`, without a guard."""
        super().__init__(name, fresh())
        self.fresh = fresh

    def broken(self, what: str) -> BreaksContract:
        """Return the error that says what the planner does, with robot and tick."""
        return BreaksContract(f"{what} ({self._robot}, tick {self._tick or 0})")


def _asked_again(method: str) -> Any:
    """Return the method of a PurityProbe that calls `method` of its planner, and compares other answers."""

    def called(self: PurityProbe, state: Any) -> Any:
        answer = self.unchanged(method, getattr(super(PurityProbe, self), method), state)
        self.compare(method, answer, state)
        return answer

    return called


class PurityProbe(Watched):
    """A planner whose every call is made again, on copies of the arguments.

    Raises BreaksContract if it changes an argument, if a state cannot be pickled, if a second call has
    another answer, or if a new planner with a copy of the state has another answer.
    """

    def start(self, config: RobotConfig) -> Any:
        """Return the first state, and start the copy."""
        state = super().start(config)
        self._copy = self._of_copy("start", config)
        return state

    def observe(self, state: Any, observation: Observation) -> Any:
        """Return the state with the sensor data."""
        self._tick = observation.tick
        self._copy = self._of_copy("observe", self._copied(self._copy), observation)
        return self.unchanged("observe", super().observe, state, observation)

    def decide(self, state: Any, reports: Sequence[Any] = ()) -> Any:
        """Return the state with the reports."""
        self._copy = self._of_copy("decide", self._copied(self._copy), self._copied(list(reports)))
        return self.unchanged("decide", super().decide, state, reports)

    report, command, estimate = map(_asked_again, ("report", "command", "estimate"))

    def _copied(self, value: Any) -> Any:
        return pickle.loads(self._pickled(value))  # it was pickled here

    def _pickled(self, value: Any) -> bytes:
        try:
            return pickle.dumps(value)
        except (Exception, SystemExit) as error:  # noqa: BLE001  # the user's classes may raise anything
            raise self.broken(f"its state cannot be pickled: {type(error).__name__}: {error}") from None

    def unchanged(self, method: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of `call`. Raises BreaksContract if it changes an argument."""
        before = self._pickled(arguments)
        result = call(*arguments)
        if self._pickled(arguments) != before:
            raise self.broken(f"{method}() changes the state or the message that it is given")
        return result

    def _of_copy(self, method: str, *arguments: Any) -> Any:
        """Return the result of `method` of a new planner."""
        try:
            return getattr(self.fresh(), method)(*arguments)
        except (Exception, SystemExit) as error:  # noqa: BLE001  # the user's code may raise anything
            raise self.broken(
                f"{method}() of a new object of the class raises {type(error).__name__}: {error}"
            ) from None

    def compare(self, method: str, answer: Any, state: Any) -> None:
        """Raise BreaksContract if `method` has another answer for copies of the state and the planner."""
        if _frame(getattr(GuardedPlanner, method)(self, self._copied(state))) != _frame(answer):
            raise self.broken(f"{method}() gives another answer when it is called again with an equal state")
        if _frame(self._of_copy(method, self._copied(self._copy))) != _frame(answer):
            raise self.broken(
                f"{method}() gives another answer for a copy of the state and a new object of the class"
            )


class HostilityProbe(Watched):
    """A planner that gets, besides each true report, false ones made of it.

    Raises BreaksContract if one harms it.
    """

    def decide(self, state: Any, reports: Sequence[Any] = ()) -> Any:
        """Return the state with the true reports, after false ones have been tried."""
        for body in reports:
            for false in _mutants(
                report_of(body, self._tick or 0, self._robot), f"{self._robot}/{self._tick}"
            ):
                self._try(state, false)
        return super().decide(state, reports)

    def _try(self, state: Any, report: Report) -> None:
        why = malformed(report, self)
        if why is not None:
            if self.decoder_error is not None:
                raise self.broken(f"a false report: {self.decoder_error}")
            return
        try:
            decided = super().decide(state, [body_of(report, self)])
            self.command(decided)
            self.report(decided)
            self.estimate(decided)
        except PlannerFailed as error:
            raise self.broken(f"a false report that its decoder takes: {error}") from None


def _frame(answer: Any) -> bytes:
    return msgspec.msgpack.encode(answer)


def _mutants(report: Report, key: str) -> Iterator[Report]:
    """Yield reports like `report` with another content that is still a message."""
    draw = random.Random(key)
    for _ in range(MUTANTS):
        try:
            if report.body is None:
                tree = _changed(msgspec.msgpack.decode(msgspec.msgpack.encode(report)), draw)
                frame = msgspec.msgpack.decode(msgspec.msgpack.encode(tree), type=Report)
                yield decode(encode(frame), Report, MAX_REPORT_BYTES)
            else:
                yield msgspec.structs.replace(report, body=_changed_body(report.body, draw))
        except (MalformedFrame, msgspec.MsgspecError, OverflowError, UnicodeEncodeError):
            continue


def _changed_body(body: bytes, draw: random.Random) -> bytes:
    """Return `body` with a bit flipped, cut short, or with an extreme value in it."""
    kind = draw.randrange(4)
    if not body or kind == 0:
        return draw.randbytes(draw.randrange(40))
    if kind == 1:
        place = draw.randrange(len(body))
        return body[:place] + bytes([body[place] ^ 1 << draw.randrange(8)]) + body[place + 1 :]
    return msgspec.msgpack.encode(_changed(msgspec.msgpack.decode(body), draw))


def _changed(tree: Any, draw: random.Random) -> Any:
    """Return a copy of `tree` in which one value is another."""
    if isinstance(tree, list) and tree and draw.random() < 0.9:
        place = draw.randrange(len(tree))
        return [_changed(one, draw) if i == place else one for i, one in enumerate(tree)]
    if isinstance(tree, dict) and tree and draw.random() < 0.9:
        place = draw.choice(sorted(tree, key=str))
        return {key: _changed(one, draw) if key == place else one for key, one in tree.items()}
    if isinstance(tree, int | float) and not isinstance(tree, bool) and draw.random() < 0.5:
        return tree + draw.choice((-1, 1, 0.5, 100))
    return draw.choice(EXTREMES)
