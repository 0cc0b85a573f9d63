"""The contracts of range and radio models: what two radios measure of each other, and what they deliver.

Models are pure functions of true positions, tick and keyed random numbers, so a run is the same in all modes,
and the audit computes it again. `range_models` and `radio_models` have those that are shipped.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Generic, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from protocol.mission import Option, OptionValue
from protocol.units import Finite
from world.random_streams import gaussian, uniform

S = TypeVar("S")
"""The type of the state of a radio link: a frozen value."""
Point = tuple[float, float]
"""A position in <W>, in m."""
ModelName = Annotated[
    str, Meta(pattern=r"\A[A-Za-z_][A-Za-z0-9_.-]*(:[A-Za-z_][A-Za-z0-9_]*)?\Z", max_length=64)
]
"""The name of a model that is shipped, or MODULE:CLASS."""
ModelOptions = Annotated[
    dict[Option, OptionValue | Annotated[list[list[Finite] | Finite], Meta(max_length=1000)]],
    Meta(max_length=32),
]
"""The options of a model: the keyword arguments of its class."""


class ModelSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The name of a model, with its options."""

    model: ModelName
    """The model: a shipped one, or MODULE:CLASS."""
    options: ModelOptions = {}
    """The keyword arguments of its class."""


class Radios(NamedTuple):
    """Two radios at one tick."""

    name: str
    """The name of what happens between them: "anchor/a" (a range of a to its anchor), "mutual/a" (a range of
    a and its peer), or "report/a->b". It keys the random numbers."""
    one: Point
    """The position of the first radio: the robot that ranges or sends."""
    other: Point
    """The position of the second radio: the anchor, the peer, or the robot that receives."""
    tick: int
    seed: int
    """The seed of the scenario."""

    @property
    def distance(self) -> float:
        """The distance between the two, in m."""
        return math.dist(self.one, self.other)

    def uniform(self, what: str) -> float:
        """Return a random number in (0, 1), of its own for each tick and each word `what`."""
        return uniform(self.seed, f"model/{what}", self.name, self.tick)

    def gaussian(self, what: str) -> float:
        """Return a Gaussian random number, of its own for each tick and each word `what`."""
        return gaussian(self.seed, f"model/{what}", self.name, self.tick)

    def fixed_gaussian(self, what: str) -> float:
        """Return a Gaussian random number that is the same in all ticks of the mission."""
        return gaussian(self.seed, f"fixed-model/{what}", self.name, 0)


class RangeModel:
    """A model of the detection and the measurement of ranges: here, a disc of radius R."""

    def detects(self, radios: Radios, reach: float) -> bool:
        """Return whether the two radios detect each other. `reach` is the true sensing range R in m.

        Robots that do not detect each other have no contact: no range, and no reports.
        """
        return radios.distance <= reach

    def measured(self, radios: Radios, rho: float) -> float | None:
        """Return the range in m that is measured instead of `rho`, which has the noise of the sensors.

        None is a drop-out: robots stay in contact.
        """
        del radios
        return rho


class Transmission(NamedTuple):
    """A report that one robot sends to its peer at one tick."""

    radios: Radios
    """The sender and the receiver."""
    reach: float
    """The true sensing range R in m."""
    period: float
    """The duration of a tick in s."""
    senders: tuple[tuple[str, Point], ...]
    """The names and positions of all robots that send a report at this tick."""
    sender: str
    """The robot that sends."""


class RadioModel(Generic[S]):
    """A model of the delivery of reports between robots in contact: here, all of them at once.

    The faults of the fault plan apply to what it delivers.
    """

    def start(self) -> S | None:
        """Return the state of a link before the first report."""
        return None

    def sent(self, state: S | None, transmission: Transmission) -> tuple[S | None, int | None]:
        """Return the state of the link after a report, and its delay in ticks; None if the report is lost."""
        del transmission
        return state, 0


OWN_MODELS: dict[str, Any] = {}
"""The classes of models that the user of this process has named, by name (see `compose.launch`)."""
