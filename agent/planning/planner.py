"""The planner contract: one robot's decisions as pure functions over frozen values.

A tick has two halves, because two robots in contact exchange their new measurements before either decides:

    observe(state, observation) -> state    adds the sensor data; `report(state)` is what the peer receives
    decide(state, reports)      -> state    adds the peer's reports; `command(state)` is the motion command

The body of a report is a `Report`, which is a message itself, or of the planner's own type: then it is
encoded, and sent in the field `body` of one.

There is no I/O, no clock and no randomness, so simulation, network, replay and recovery make decisions that
are identical to the bit. A planner is a subclass of `Planner`. Its instances hold options, and never change.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Generic, TypeVar

import msgspec

from protocol.messages import (
    BranchKind,
    Command,
    Estimate,
    Inconsistent,
    Observation,
    Probability,
    Report,
    RobotConfig,
    Undecided,
    Verdict,
)
from protocol.mission import Mission
from protocol.orbits import Rendezvous, rendezvous
from protocol.wire import MalformedFrame

S = TypeVar("S")
"""The type of the state of a planner: a frozen value."""
B = TypeVar("B")
"""The type of the body of its reports."""


class Summary(msgspec.Struct, frozen=True):
    """The planner's part of a robot's FinalReport. A field that does not apply is None."""

    anchor_ranges: int | None = None
    """The number of anchor ranges that the planner has used; None for all that were measured."""
    mutual_ranges: int | None = None
    """The number of mutual ranges that the planner has used; None for all that were measured."""
    reports_heard: int | None = None
    """The number of reports that the planner has used; None for all that were received."""
    branch: BranchKind | None = None
    """The observation that decided the branch in phase 1."""
    alpha: float | None = None
    """The signed angle alpha of eq. (2), in rad."""
    candidates: tuple[int, int] | None = None
    """The number of solutions of eq. (7), or of hypotheses: at first and at last."""
    last_turn_rate: float | None = None
    """The latest planned omega_2 of eq. (8), in rad/s."""
    separation_m2: float | None = None
    """The cost J of eq. (8) for it, in m^2."""
    hypotheses: int | None = None
    """The number of remaining hypotheses about the poses of both robots."""
    probability: Probability | None = None
    """The probability of the most probable hypothesis."""
    blocking_reason: str | None = None
    """The condition that still prevents a claim, for a user."""
    p_value: Probability | None = None
    """The smallest p-value of all consistency tests."""
    unverified_anchors: dict[str, str] = {}
    """The anchors of which no range tells whether they stand elsewhere than told, with the direction."""


class Planner(Generic[S, B]):
    """The decisions of a robot. Subclasses define `start`, `observe`, `decide`, `command` and `estimate`.

    All methods are pure: they do not change their arguments or the planner, and return equal values for equal
    arguments. The keyword arguments of the class are the options of a scenario's `[planner]` table.
    """

    BODY: Any = type(None)
    """The type of the body of a report, from which its decoder is made: `messages.Report` (the log that the
    shipped planners exchange), a msgspec Struct, or another type that msgspec decodes. Default: no body."""

    MANOEUVRES: Manoeuvres | None = None
    """The manoeuvres that the planner compares, for figures. None: its states are not a `RobotState`, and
    figures show nothing of them."""

    ACTIVE_SENSING: bool = False
    """True if robots choose noisy ranges by their information, for figures of a `RobotState`."""

    REQUIRED_PLACES: int = 0
    """The number of different relative placements with a mutual range that a claim from exact ranges needs.

    The audit checks it."""

    # --- decisions ---

    def start(self, config: RobotConfig) -> S:
        """Return the state of a robot that has measured nothing yet."""
        raise NotImplementedError

    def observe(self, state: S, observation: Observation) -> S:
        """Return `state` with the sensor data of one tick: odometry, anchor range, contact and mutual range.

        Whatever depends only on the robot's own sensors is also decided.
        """
        raise NotImplementedError

    def report(self, state: S) -> B:
        """Return the body of the report of this tick to the peer, a BODY. It is sent only in contact.

        Its encoding has at most `messages.MAX_BODY_BYTES` bytes.
        """
        del state
        return None  # type: ignore[return-value]  # the default BODY

    def decide(self, state: S, reports: Sequence[B] = ()) -> S:
        """Return `state` with the peer's `reports` of this tick, and with the decisions that follow.

        There may be none, several, and late or repeated ones: the bodies are in the order of their arrival.
        """
        raise NotImplementedError

    def command(self, state: S) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        raise NotImplementedError

    def estimate(self, state: S) -> Estimate:
        """Return the robot's pose under each hypothesis, in its anchor's frame and in <W>."""
        raise NotImplementedError

    # --- optional ---

    def report_to(self, state: S, peer: str) -> B:
        """Return the body of the report of this tick to the robot `peer`, which is in contact.

        In a group, several robots may be. Default: the same report for all.
        """
        del peer
        return self.report(state)

    def meet(self, state: S, config: RobotConfig) -> S:
        """Return the state in a new meeting of a group, with the peer and the role of `config`.

        What the robot knows of itself stays, and what it knew of the earlier peer goes. It may have its
        verdict already: then it visits the peer, which has none. Robots form groups with a planner that
        defines this, and with subclasses of `Assured`.
        """
        raise NotImplementedError

    def rendezvous(self, mission: Mission, distance: float) -> Rendezvous:
        """Return the orbits of a pair whose anchors are `distance` m apart, and the bound of their duration.

        They are part of each RobotConfig, and `max_ticks` follows from them. Default: those of `assured`.
        """
        return rendezvous(mission, distance, "assured")

    def malformed(self, body: B) -> str | None:
        """Return why a received `body` is refused, like a damaged one; None if it is not.

        The decoder calls it once it has checked the types of all fields. It depends on the body alone.
        """
        del body
        return None

    def summary(self, state: S) -> Summary:
        """Return the planner's part of the FinalReport."""
        del state
        return Summary()

    def misreport(self, body: B, observations: Sequence[Observation]) -> str | None:
        """Return how `body` contradicts the robot's own `observations` until then; None if it does not.

        The audit checks reports of honest robots with it.
        """
        del body, observations
        return None

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim. The audit checks it."""
        del mission
        return 0


class Manoeuvres(msgspec.Struct, frozen=True):
    """The directions and speeds among which a planner chooses."""

    directions: tuple[float, ...]
    """The signs of v in phase 1: 1 forward, -1 backward."""
    sides: tuple[float, ...]
    """The signs of omega_1 in eq. (4): 1 to the left, -1 to the right."""
    last_speeds: tuple[float, ...] | None
    """The values of v_2 in eq. (8), in units of A_0 / T_s; None for v_max alone."""
    fewest_out_of_range: bool
    """True if only last manoeuvres count that leave the fewest placements out of range.

    No detection selects those placements.
    """


# --- the bodies of reports ------------------------------------------------------------------------------

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
