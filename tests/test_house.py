"""The architecture: imports point down, planners are pure, and processes load only what they use."""

from __future__ import annotations

import ast
import copy
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import msgspec
import pytest

from agent.planning.state import RobotState
from compose.scenario.scenario_file import load
from protocol.messages import Message
from protocol.wire import encode
from tests.steps import planner_of, steps
from world.scenario import Scenario
from world.tick import advance, observations, release

HOUSE = Path(__file__).parents[1]
BELOW = {
    "protocol": {"protocol"},
    "agent": {"agent", "protocol"},
    "world": {"world", "protocol"},
    "compose": {"compose", "agent", "world", "protocol"},
    "tandem": {"tandem", "compose", "agent", "world", "protocol"},
}
"""The packages of the project that each package may import."""

BUDGETS = {"protocol": 4_928, "agent": 19_276, "world": 4_621, "compose": 31_329, "tandem": 1_981}
"""The largest number of lines of Python and C of each package. Raising one needs a reason in the commit."""

SHELL = {
    "protocol.network.session",
    "protocol.journal.journal_file",
    "protocol.journal.resume",
    "protocol.network.inbox",
}
"""The modules for I/O (files, networks, clocks) that each package may import."""

PURE = {
    *(
        ".".join(path.relative_to(HOUSE).with_suffix("").parts)
        for room in ("planning", "estimation", "peer")
        for path in sorted((HOUSE / "agent" / room).rglob("*.py"))
        if path.name not in ("__init__.py", "kernel.py", "elementary.py", "compiled.py")
    ),
    "world.tick",
    "world.truth",
    "world.hardware.driver",
    "world.near_pairs",
    "world.sensors",
    "world.random_streams",
    "world.faults",
    "world.channel",
    "world.referee",
    "world.scenario",
    "world.sensor_model",
    "world.world_noise",
    "world.world_models",
    "world.range_models",
    "world.radio_models",
    "protocol.messages",
    "protocol.mission",
    "protocol.motion",
    "protocol.noise",
    "protocol.orbits",
    "protocol.rounding",
    "protocol.units",
}
ALLOWED = {
    "__future__",
    "functools",
    "bisect",
    "math",
    "itertools",
    "operator",
    "collections.abc",
    "typing",
    "msgspec",
    "numpy",
    "numpy.typing",
    "re",
    "hashlib",
}
KERNEL = {f"agent.estimation.{name}" for name in ("kernel", "elementary", "compiled")}
"""The modules that call compiled functions, which are pure."""
IMPURE = {
    "open", "print", "input", "eval", "exec", "compile", "globals", "setattr", "delattr", "breakpoint",
    "__import__", "importlib", "os", "sys", "time", "datetime", "random", "secrets", "uuid", "threading",
}  # fmt: skip


def modules(room: str) -> list[str]:
    return [
        ".".join(path.relative_to(HOUSE).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted((HOUSE / room).rglob("*.py"))
    ]


@cache
def tree(module: str) -> ast.Module:
    path = HOUSE.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(file.read_text(encoding="utf-8"))


def imports(source: ast.Module) -> Iterator[str]:
    """Yield all modules that `source` imports, at any place."""
    for node in ast.walk(source):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "the house has no relative imports"
            assert node.module is not None
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield whole if _is_module(whole) else node.module


@cache
def _is_module(name: str) -> bool:
    path = HOUSE.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").exists()


def room(module: str) -> str:
    return module.partition(".")[0]


# --- imports point down -------------------------------------------------------------------------------


@pytest.mark.parametrize("package", BELOW)
def test_a_room_imports_only_what_is_below_it(package: str) -> None:
    found = {
        module: {name for name in imports(tree(module)) if room(name) in {*BELOW, "tests"}}
        for module in modules(package)
    }
    upwards = {
        module: {name for name in names if room(name) not in BELOW[package]}
        for module, names in found.items()
    }
    assert {module: names for module, names in upwards.items() if names} == {}


@pytest.mark.parametrize("package", ["protocol", "agent", "world"])
def test_no_module_hides_an_import(package: str) -> None:
    hidden = {"__import__", "import_module", "exec", "eval"}
    found = {
        module: {
            name
            for node in ast.walk(tree(module))
            if (name := getattr(node, "id", None) or getattr(node, "attr", None)) in hidden
        }
        for module in modules(package)
    }
    assert {module: names for module, names in found.items() if names} == {}


def test_every_module_of_the_house_is_looked_at() -> None:
    assert {"agent.planning.phase1_anchor", "compose.cli.main", "protocol.wire", "world.process"} <= {
        module for room in BELOW for module in modules(room)
    }


def test_no_import_escapes_wherever_it_stands() -> None:
    source = """
import agent.planning.planner as p
from world import tick, referee as judge
from world.tick import World
if TYPE_CHECKING:
    from compose.recording.run import Record
def f():
    class C:
        def g(self):
            from agent.estimation import closed_forms
            import compose.cli.main, math
"""
    assert sorted(imports(ast.parse(source))) == [
        "agent.estimation.closed_forms",
        "agent.planning.planner",
        "compose.cli.main",
        "compose.recording.run",
        "math",
        "world.referee",
        "world.tick",
        "world.tick",
    ]


# --- planners are pure --------------------------------------------------------------------------------


def test_a_pure_module_imports_only_what_is_pure() -> None:
    found = {module: {name for name in imports(tree(module)) if not _is_pure(name)} for module in PURE}
    assert {module: names for module, names in found.items() if names} == {}


def _is_pure(imported: str) -> bool:
    if room(imported) in BELOW:
        return imported in PURE | KERNEL or (room(imported) == "protocol" and imported not in SHELL)
    return imported in ALLOWED or room(imported) == "msgspec"


def test_a_pure_module_names_nothing_that_acts_or_changes_by_itself() -> None:
    found = set()
    for module in PURE:
        for node in ast.walk(tree(module)):
            match node:
                case ast.Name(id=name) | ast.Attribute(attr=name) if name in IMPURE:
                    found.add((module, name))
                case ast.Global() | ast.Nonlocal():
                    found.add((module, "global"))
    assert found == set()


def test_a_pure_module_keeps_no_variable() -> None:
    """Each top-level statement is a definition, or a constant of an immutable type."""
    for module in sorted(PURE):
        for node in tree(module).body:
            value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
            if isinstance(value, ast.List | ast.Set | ast.ListComp | ast.SetComp | ast.DictComp):
                pytest.fail(f"{module}, line {node.lineno}: something that can change")
            if isinstance(value, ast.Dict):
                target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
                assert isinstance(target, ast.Name)
                assert target.id.isupper(), f"{module}, line {node.lineno}: a table is a constant"


def frozen(value: object) -> bytes:
    """Return all bits of a value as encoded on the wire. States of different types differ."""
    return repr(value).encode()


@pytest.mark.parametrize(
    "name", ["paper-1", "paper-2", "random", pytest.param("noisy", marks=pytest.mark.long)]
)
def test_the_same_values_give_the_same_step_and_are_left_as_they_were(name: str) -> None:
    for world, sensed, before, observed, reports, commands in steps(name):
        for observation in sensed:
            planner = planner_of(before[observation.robot])
            state, heard = before[observation.robot], reports[observation.robot]
            was = frozen((state, observation))
            once, again = (
                planner.observe(state, observation),
                planner.observe(copy.deepcopy(state), observation),
            )
            assert once == again == observed[observation.robot]
            assert frozen(once) == frozen(again)
            assert frozen((state, observation)) == was

            was = frozen((once, heard))
            decided = planner.decide(once, heard)
            anew = planner.decide(copy.deepcopy(once), list(heard))
            assert decided == anew
            assert frozen(decided) == frozen(anew)
            assert (
                encode(planner.command(decided))
                == encode(planner.command(anew))
                == encode(commands[observation.robot])
            )
            assert encode(planner.report(decided)) == encode(planner.report(anew))
            assert encode(planner.estimate(decided)) == encode(planner.estimate(anew))
            assert frozen((once, heard)) == was

        was = frozen((world, commands))
        assert observations(world) == sensed
        assert frozen(advance(world, commands)) == frozen(advance(copy.deepcopy(world), commands))
        assert frozen((world, commands)) == was


def test_robot_states_and_worlds_are_immutable() -> None:
    scenario = load("paper-1")
    state, world = RobotState(scenario.config("a")), release(scenario)
    for value in (
        state,
        state.log,
        state.peer_state,
        state.posterior,
        state.config,
        world,
        world.truth,
        scenario,
    ):
        assert isinstance(value, msgspec.Struct)
        field = value.__struct_fields__[0]
        with pytest.raises(AttributeError, match="immutable"):
            setattr(value, field, None)


# --- contracts instead of questions -------------------------------------------------------------------

ASKED_IN = {
    "planner_name": set(),
    "exact": {"agent.planning.state", "agent.estimation.gaussian.joint_ranges"},
}
"""The modules of the agent that read these fields: they select a planner, an estimator, or a claim."""


@pytest.mark.parametrize("field", ASKED_IN)
def test_no_planner_asks_for_its_name_or_for_exact_sensors(field: str) -> None:
    asking = {
        module
        for module in modules("agent")
        for node in ast.walk(tree(module))
        if isinstance(node, ast.Attribute) and node.attr == field
    }
    assert asking == ASKED_IN[field]


def test_a_kind_of_message_is_one_class() -> None:
    kinds: list[type] = [*Message.__subclasses__(), Scenario]
    assert [kind.__name__ for kind in kinds if kind.__subclasses__()] == []


def test_few_functions_ask_whether_a_value_is_a_configuration_or_a_scenario() -> None:
    """They tell a message from another one, or what a user of the Python API gives."""
    asking = [
        module
        for package in BELOW
        for module in modules(package)
        for node in ast.walk(tree(module))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance"
        if {"RobotConfig", "Scenario"}
        & {one.id for one in ast.walk(node.args[1]) if isinstance(one, ast.Name)}
    ]
    assert len(asking) <= 4, asking


# --- size and names -----------------------------------------------------------------------------------


@pytest.mark.parametrize("package", BUDGETS)
def test_no_package_exceeds_its_budget_of_lines(package: str) -> None:
    files = [path for path in (HOUSE / package).rglob("*") if path.suffix in (".py", ".c")]
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in files)
    assert lines <= BUDGETS[package]


def test_no_constant_is_defined_twice() -> None:
    """Type variables are no constants."""
    found: dict[str, list[str]] = {}
    for module in [module for package in BELOW for module in modules(package)]:
        for node in tree(module).body:
            match node:
                case (
                    ast.Assign(targets=[ast.Name(name)])
                    | ast.AnnAssign(target=ast.Name(name), value=ast.expr())
                ):
                    if name.isupper() and len(name) > 1:
                        found.setdefault(name, []).append(module)
    assert not {name: places for name, places in found.items() if len(places) > 1}


# --- processes load only what they use ----------------------------------------------------------------


def loaded_by(module: str) -> set[str]:
    """Return the top-level packages that a process has loaded after importing `module`."""
    code = f"import sys, {module}; print(*{{name.partition('.')[0] for name in sys.modules}})"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(found.stdout.split())


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("tandem", {"compose", "protocol", "msgspec", "numpy", "zenoh", "scipy", "rich"}),
        ("tandem.missions", {"zenoh", "scipy", "rich", "matplotlib", "pyarrow", "pandas", "polars"}),
        ("tandem.results", {"agent", "zenoh", "scipy", "rich", "matplotlib", "pyarrow", "pandas", "polars"}),
        ("tandem.sweeps", {"zenoh", "rich", "distributed", "matplotlib", "pyarrow", "pandas", "polars"}),
        ("compose.cli.main", {"zenoh", "numpy", "scipy", "rich"}),
        ("agent.process.node", {"world", "compose", "scipy", "rich"}),
        ("world.hardware.bridge", {"numpy", "scipy", "rich", "agent", "compose", "rosbags"}),
        ("compose.cli.robot", {"numpy", "scipy", "rich", "agent", "rosbags"}),
        ("world.process", {"numpy", "scipy", "rich", "agent", "compose"}),
        ("agent.planning.assured", {"zenoh", "scipy", "rich", "world", "compose"}),
        ("compose.launch.in_process", {"zenoh", "rich"}),
        ("compose.sweep.worker", {"zenoh", "rich", "distributed", "dask", "pyarrow", "matplotlib"}),
        ("compose.cli.audit", {"zenoh", "rich", "distributed", "matplotlib", "pyarrow"}),
        ("compose.recording.run", {"zenoh", "numpy", "scipy", "rich", "agent"}),
        ("compose.cli.figures", {"zenoh", "numpy", "rich", "distributed", "matplotlib"}),
        ("compose.cli.run", {"numpy", "scipy", "rich", "agent", "foxglove", "pyarrow"}),
        ("compose.cli.replay", {"zenoh", "rich", "foxglove", "pyarrow", "matplotlib"}),
        ("compose.cli.export", {"zenoh", "numpy", "rich", "agent", "foxglove", "pyarrow"}),
        ("compose.cli.run", {"numpy", "scipy", "rich", "agent", "starlette", "uvicorn"}),
        ("compose.cli.watch", {"zenoh", "numpy", "scipy", "rich", "agent", "starlette", "uvicorn"}),
        ("compose.view.recorded", {"zenoh", "numpy", "scipy", "rich", "agent", "starlette", "uvicorn"}),
        ("compose.cli.keys", {"zenoh", "numpy", "rich", "agent", "world", "cryptography"}),
        ("compose.cli.doctor", {"numpy", "scipy", "rich", "agent", "world", "cryptography"}),
        ("compose.cli.ps", {"numpy", "scipy", "rich", "agent", "world", "cryptography"}),
        ("compose.extras", {"zenoh", "numpy", "rich", "cryptography"}),
        ("compose.cli.agent", {"rich", "cryptography"}),
        ("compose.cli.world", {"numpy", "scipy", "rich", "cryptography"}),
        ("compose.cli.sweep", {"zenoh", "rich", "distributed", "dask", "pyarrow", "matplotlib"}),
    ],
)
@pytest.mark.long
def test_a_process_does_not_import_what_it_does_not_use(module: str, absent: set[str]) -> None:
    assert loaded_by(module) & absent == set()
