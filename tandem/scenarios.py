"""A scenario as a value: read from a file or a dict, and changed by field paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from compose.errors import BadScenario, NoSuchField, UserError
from compose.launch.class_loader import name_of
from compose.scenario.fault_syntax import table_of
from compose.scenario.scenario_file import (
    ScenarioTemplate,
    scenario_table,
    trust_classes,
    validate,
    with_planner,
)
from compose.sweep.field_paths import field_steps, with_value

if TYPE_CHECKING:
    from tandem.planning import Planner

Faults = str | Mapping[str, Any] | Sequence[str | Mapping[str, Any]]
"""Faults of the radio: texts such as "a->b: loss=0.3" (see `--fault`), or `[[fault]]` tables as dicts."""


class Scenario(msgspec.Struct, frozen=True):
    """A valid scenario. It is immutable: `with_` returns a changed one.

    >>> import tandem
    >>> scenario = tandem.Scenario.load("random").with_({"mission.period": 0.5}, seed=7)
    >>> scenario
    <Scenario random, seed 7: a, b>
    >>> scenario.table["mission"]["period"]
    0.5
    >>> scenario.with_({"mission.tick": 0.5})
    Traceback (most recent call last):
    ...
    compose.errors.BadScenario: random: 'mission.tick': mission: unknown field 'tick'
    """

    table: dict[str, Any]
    """The content of the scenario file, as a dict of its TOML. Do not change it; use `with_`."""
    source: str
    """The name that begins errors: that of the shipped scenario, or the path of the file."""
    template: ScenarioTemplate
    """The validated file, on which the command line works; it may change with any version."""

    @classmethod
    def load(cls, source: str | Path) -> Scenario:
        """Return the shipped scenario named `source`, or the one in the TOML file at that path.

        Raises NotToml, BadScenario and Unworkable.
        """
        return cls.from_dict(scenario_table(str(source)), str(source))

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], source: str = "scenario") -> Scenario:
        """Return the scenario whose file has the content `table`. `source` begins errors.

        Raises BadScenario and Unworkable.

        >>> import tandem
        >>> tandem.Scenario.from_dict({
        ...     "name": "two",
        ...     "mission": {"sensing_range": 3.0, "max_speed": 0.25, "max_turn_rate": 0.5, "period": 1.0},
        ...     "robot": [{"id": "a", "anchor": [0, 0]}, {"id": "b", "anchor": [8, 0]}],
        ... })
        <Scenario two, seed 0: a, b>
        """
        content = plain(table)
        trust_classes(content)
        return cls(content, source, validate(content, source))

    def with_(self, fields: Mapping[str, Any] | None = None, /, **top: Any) -> Scenario:
        """Return the scenario with other values of `fields`, given by path, and of fields at the `top`.

        Paths are those of sweeps, such as "mission.noise.range_sigma", "robot.a.start" or "fault[0].loss".
        Raises BadScenario and Unworkable.
        """
        table, changed = self.table, {**(fields or {}), **top}
        seed = plain(changed.get("seed"))
        if [*changed] == ["seed"] and type(seed) is int and 0 <= seed < 2**63:
            # all else stays valid, and its validation would take as long as a mission
            return Scenario({**table, "seed": seed}, self.source, self.template.reseeded(seed))
        for path, value in changed.items():
            try:
                way = field_steps(path, table)
            except NoSuchField as error:
                raise BadScenario(f"{self.source}: '{path}': {error}") from None
            table = with_value(table, way, plain(value))
        return Scenario.from_dict(table, self.source)

    def with_faults(self, faults: Faults) -> Scenario:
        """Return the scenario with `faults` added to its own. Raises BadScenario.

        >>> import tandem
        >>> lossy = tandem.Scenario.load("random").with_faults("a->b: loss=0.3, delay=0..3")
        >>> lossy.table["fault"]
        [{'link': 'a->b', 'loss': 0.3, 'delay': [0, 3]}]
        """
        given = [faults] if isinstance(faults, str | Mapping) else list(faults)
        if not given:
            return self
        texts = [one for one in given if isinstance(one, str)]
        validate(self.table, self.source, texts)  # its errors name the text
        tables = [*self.table.get("fault", [])]
        tables += [table_of(one) if isinstance(one, str) else one for one in given]
        return Scenario.from_dict({**self.table, "fault": tables}, self.source)

    def with_planner(self, planner: str | type[Planner[Any, Any]], **options: Any) -> Scenario:
        """Return the scenario with another planner and its options: a name as in a file, or the class.

        A class has to be defined at the top level of a module, or of the script. Raises BadScenario.

        >>> import tandem
        >>> tandem.run(tandem.Scenario.load("paper-1").with_planner("assured")).outcome
        'localised'
        """
        name = planner if isinstance(planner, str) else name_of(planner)
        return Scenario.from_dict(
            {**self.table, "planner": with_planner(None, name, plain(options))}, self.source
        )

    @property
    def name(self) -> str:
        """The name of the scenario."""
        return self.template.scenario.name

    @property
    def seed(self) -> int:
        """The seed of all random draws."""
        return self.template.scenario.seed

    @property
    def robots(self) -> tuple[str, ...]:
        """The names of the robots."""
        return tuple([robot.id for robot in self.template.scenario.robots])

    def __repr__(self) -> str:
        return f"<Scenario {self.name}, seed {self.seed}: {', '.join(self.robots)}>"


def scenario_of(given: Scenario | str | Path | Mapping[str, Any]) -> Scenario:
    """Return the scenario that `given` is, names, or has the content of. Raises like `Scenario.load`."""
    match given:
        case Scenario():
            return given
        case Mapping():
            return Scenario.from_dict(given)
        case str() | Path():
            return Scenario.load(given)
        case _:
            raise UserError(f"scenario: not a name, path, dict or tandem.Scenario: {type(given).__name__}")


def plain(value: Any) -> Any:
    """Return `value` as in a TOML file: tuples and arrays become lists, and classes their names."""
    match value:
        case Mapping():
            return {str(key): plain(one) for key, one in value.items()}
        case list() | tuple():
            return [plain(one) for one in value]
        case type():  # a planner
            return name_of(value)
        case _ if hasattr(value, "tolist"):  # an array or number of numpy
            return value.tolist()
        case _:
            return value
