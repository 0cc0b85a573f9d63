"""Tables of the pages, generated from code and expected results: `uv run docs/reference.py [--check]`.

The script writes each of TABLES into the page that has its two marker lines, between them: README.md, or one
of docs. `uv run docs/peers.py` measures the results of peers. With `--check` it writes
nothing, and its exit status is 1 if a page would change.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, get_args

import msgspec
from msgspec import NODEFAULT
from msgspec import inspect as types

from agent.estimation import claim, judged
from agent.planning.planner import Planner
from compose.audit import rules
from compose.cli.commands import COMMANDS
from compose.cli.main import command_parser
from compose.cli.removed import REMOVED
from compose.recording import rows
from compose.recording.estimating.estimate_rows import (
    EstimatedAnchor,
    EstimateSummary,
    LearnedErrors,
    PoseEstimate,
    PoseEstimateRow,
    RobotEstimate,
)
from compose.recording.group_localisation import MeetingResult
from compose.recording.ranging import recording_rows
from compose.recording.ranging.ros_bag import BagFile, TopicTable
from compose.scenario.fault_syntax import FaultTable
from compose.scenario.json_schema import described
from compose.scenario.kills import KillTable
from compose.scenario.scenario_tables import (
    AnchorTable,
    ClockTable,
    GroupTable,
    MissionTable,
    PlannerTable,
    RobotTable,
    ScenarioFile,
    TeamTable,
    WorldTable,
)
from compose.sweep import spec
from compose.sweep.draws import DrawTable, StartsTable
from compose.sweep.group_columns import GroupColumns
from compose.sweep.paired_differences import PairedDifference
from compose.sweep.spec import AxisTable, RowTable, SpecFile
from compose.sweep.statistics import CellSummary
from compose.sweep.trial import RobotRow, TrialRow
from docs import peer_tables
from protocol import messages, wire
from protocol.attack import Attack
from protocol.network import keys
from protocol.noise import Noise, VelocityNoise
from tandem.results import Run
from tests.expected import tables as expected_tables
from tests.expected.tables import table as results_of
from world.radio_models import RADIO_MODELS
from world.range_models import RANGE_MODELS
from world.world_noise import WorldNoise, WorldOdometryNoise, WorldVelocityNoise

DOCS = Path(__file__).parent
BEGIN = re.compile(r"^<!-- written by docs/reference.py: (?P<name>[\w-]+) -->$", re.MULTILINE)
"""the first marker line of a table"""
PLACE = re.compile(f"(?P<begin>{BEGIN.pattern}\n).*?(?P<end>^<!-- end of (?P=name) -->$)", re.M | re.S)
"""a table on a page, with its marker lines"""
NO_VALUE = "none"
PARTS = (
    messages.Contact,
    messages.Ranged,
    messages.NamedRange,
    messages.Pairing,
    messages.Team,
    messages.TeamAnchor,
    messages.LostReport,
    messages.Cause,
    messages.Localised,
    messages.Undecided,
    messages.Inconsistent,
    messages.ReportedPose,
    messages.Member,
    messages.Appointment,
)
"""structs that messages contain, and that have no tables on other pages"""
NAMES = {
    "TopicTable": "`[[topic]]`",
    "AnchorRow": "`[[anchor]]`",
    "AntennaRow": "`[[antenna]]`",
    "MissionTable": "table `[mission]`",
    "RobotTable": "`[[robot]]`",
    "GroupTable": "`[group]`",
    "AnchorTable": "`[[anchor]]`",
    "TeamTable": "`[team]`",
    "PlannerTable": "table `[planner]`",
    "FaultTable": "`[[fault]]`",
    "KillTable": "`[[kill]]`",
    "ClockTable": "`[[clock]]`",
    "AxisTable": "`[[axis]]`",
    "DrawTable": "`[[draw]]`",
    "StartsTable": "table `[starts]`",
    "WorldTable": "table `[world]`",
    "ModelSpec": "table with `model` and `options`",
    "Attack": "table",
    "Noise": "table",
    "VelocityNoise": "table",
    "WorldNoise": "table",
    "WorldVelocityNoise": "table",
    "WorldOdometryNoise": "table",
    "RowTable": "table",
}
"""the types of tables of files, as a user writes them"""


def _bounds(kind: Any) -> str:
    low = kind.ge if kind.ge is not None else kind.gt
    high = kind.le if kind.le is not None else kind.lt
    if low is None and high is None:
        return ""
    if high is None:
        return f", at least {low:g}"
    above = "above " if kind.ge is None else ""
    return f", {above}{_number(low)} to {_number(high)}"


def _number(value: float) -> str:
    """Return a bound; powers of 2 that bound integers are written as powers."""
    if value < 0:
        return f"-{_number(-value)}"
    for power in (31, 53, 63):
        for less in (0, 1):
            if value == 2**power - less and isinstance(value, int):
                return f"2^{power}{' - 1' if less else ''}"
    return f"{value:g}"


def _typed(kind: types.Type) -> str:  # noqa: C901, PLR0912  # one line a kind
    """Return a type as a reader of a file or a frame sees it."""
    match kind:
        case types.Metadata():
            return _typed(kind.type)
        case types.NoneType():
            return NO_VALUE
        case types.BoolType():
            return "true or false"
        case types.IntType():
            return f"integer{_bounds(kind)}"
        case types.FloatType():
            return f"number{_bounds(kind)}"
        case types.StrType(max_length=longest):
            return f"text of at most {longest} characters" if longest is not None else "text"
        case types.BytesType(max_length=longest):
            return f"at most {longest} bytes"
        case types.LiteralType(values=values):
            return ", ".join(f"`{value}`" for value in values)
        case types.UnionType(types=several):
            return " or ".join(dict.fromkeys(_typed(one) for one in several))
        case types.StructType(cls=cls):
            return NAMES.get(cls.__name__, cls.__name__)
        case types.TupleType(item_types=items):
            return f"[{'; '.join(_typed(one) for one in items)}]"
        case types.VarTupleType(item_type=item) | types.ListType(item_type=item):
            return f"list of {_typed(item)}"
        case types.DictType(value_type=value):
            return f"table of {_typed(value)}"
        case _:
            return "any value"


def _cell(text: str) -> str:
    """Return `text` so that it fits a cell of a table; a frame such as <W> would be a tag of HTML."""
    return re.sub(r"<\w+>", r"`\g<0>`", text.replace("|", "\\|").replace("\n", " "))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)


def _default(field: types.Field) -> str:
    if field.required:
        return "required"
    if field.default is NODEFAULT or isinstance(field.default, msgspec.Struct):
        return ""
    value = field.default
    return "left out" if value is None else f"`{msgspec.json.encode(value).decode()}`"


@cache
def _info(struct: type[msgspec.Struct]) -> types.StructType:
    info = types.type_info(struct)
    assert isinstance(info, types.StructType)
    return info


def fields_of(struct: type[msgspec.Struct], *, defaults: bool = True) -> str:
    """Return the table of the fields of `struct`: name, type and bounds, default, meaning."""
    info = _info(struct)
    head = ["field", "type", *(["default"] if defaults else []), "meaning"]
    rows = [
        [
            f"`{field.encode_name}`",
            _typed(field.type),
            *([_default(field)] if defaults else []),
            described(struct, field.name),
        ]
        for field in info.fields
    ]
    return _table(head, rows)


def columns_of(struct: type[msgspec.Struct]) -> str:
    """Return the table of the columns that a row of `struct` fills: name and meaning."""
    info = _info(struct)
    return _table(
        ["column", "type", "meaning"],
        [[f"`{field.name}`", _typed(field.type), described(struct, field.name)] for field in info.fields],
    )


def _first_line(cls: type) -> str:
    return " ".join((cls.__doc__ or "").split("\n\n")[0].split())


def _chapter(struct: type[msgspec.Struct], *, tagged: bool) -> str:
    tag = f"Tag `{_info(struct).tag}`. " if tagged else ""
    return f"### {struct.__name__}\n\n{tag}{_first_line(struct)}\n\n{fields_of(struct, defaults=False)}"


def wire_messages() -> str:
    """Return a table for each message, in the order of protocol/messages.py."""
    found = [
        one
        for one in vars(messages).values()
        if inspect.isclass(one) and issubclass(one, messages.Message) and one is not messages.Message
    ]
    return "\n\n".join(_chapter(one, tagged=True) for one in found)


def wire_parts() -> str:
    """Return a table for each struct that messages contain."""
    tagged = (messages.Localised, messages.Undecided, messages.Inconsistent)
    return "\n\n".join(_chapter(one, tagged=one in tagged) for one in PARTS)


def wire_version() -> str:
    """Return the version and the limits of frames."""
    return _table(
        ["quantity", "value"],
        [
            ["protocol version", str(wire.VERSION)],
            ["largest frame that is sent", f"{wire.MAX_SENT_BYTES} bytes"],
            ["largest Report", f"{wire.MAX_REPORT_BYTES} bytes"],
            ["largest frame in a journal", f"{wire.MAX_FRAME_BYTES} bytes"],
        ],
    )


def wire_keys() -> str:
    """Return the table of Zenoh keys: their form, and the participants that may send and receive on them."""
    ways = {"put": "put", "answer": "queryable", "show": "liveliness token"}
    rows = []
    for kind, rule in keys.KEY_RULES.items():
        names = {name: name.upper() for name in inspect.signature(kind).parameters}
        receivers = ", ".join(_participant(one) for one in rule.to)
        rows.append([f"`{kind(**names)}`", ways[rule.way], _participant(rule.by), receivers])
    return _table(["key", "operation", "sender", "receivers"], rows)


def _participant(name: str) -> str:
    return {"robot": "robot ROBOT", "peer": "robot PEER", "robots": "all robots"}.get(name, name)


def claim_conditions() -> str:
    """Return the table of the conditions for a claim, in their order, and of those whom each concerns."""
    users = get_args(judged.User)
    rows = [
        [
            f"`{one.name}`",
            " ".join((one.blocks.__doc__ or "").format_map(vars(judged) | vars(claim)).split()),
            *["yes" if user in one.users else "-" for user in users],
        ]
        for one in claim.CONDITIONS
    ]
    return _table(["condition", "statement", *users], rows)


def command_line() -> str:
    """Return a chapter for each command: its help, its usage and its options."""
    return "\n\n".join([_command(one.name, command_parser(one)) for one in COMMANDS])


def _command(name: str, sub: argparse.ArgumentParser) -> str:
    rows = []
    for action in sub._actions:
        if action.help == argparse.SUPPRESS or isinstance(action, argparse._HelpAction):
            continue
        value = action.metavar if isinstance(action.metavar, str) else ""
        if not value and action.choices is not None:
            value = "{" + ",".join(map(str, action.choices)) + "}"
        names = ", ".join(f"`{flag}`" for flag in action.option_strings) or f"`{value or action.dest}`"
        shown = f"{names} `{value}`" if action.option_strings and value else names
        rows.append([shown, _help(action)])
    table = _table(["argument", "meaning"], rows) if rows else "The command has no arguments."
    return f"## tandem {name}\n\n{(sub.description or '').strip()}\n\n{table}"


def _help(action: argparse.Action) -> str:
    values = {name: value for name, value in vars(action).items() if name not in ("type", "help")}
    text = action.help or ""
    try:
        return text % (values | {"prog": "tandem"})
    except (KeyError, TypeError, ValueError):
        return text


def audit_rules() -> str:
    """Return the table of the rules of the audit, in their order, by their docstrings."""
    texts = [" ".join((rule.__doc__ or "").removeprefix("Check that ").split()) for rule in rules.AUDIT_RULES]
    names = [f"`{rule.__name__}`" for rule in rules.AUDIT_RULES]
    return _table(["rule", "condition"], zip(names, texts, strict=True))


def models(shipped: Mapping[str, type]) -> str:
    """Return the table of the shipped range or radio models: name, options with defaults, docstrings."""
    rows = []
    for name, cls in shipped.items():
        options = []
        for one in inspect.signature(cls).parameters.values():
            value = "" if one.default is one.empty else f" = {msgspec.json.encode(one.default).decode()}"
            options.append(f"`{one.name}`{value}")
        texts = [cls.__doc__ or "", getattr(vars(cls).get("__init__"), "__doc__", None) or ""]
        rows.append([f"`{name}`", ", ".join(options) or "-", " ".join(" ".join(texts).split())])
    return _table(["model", "options and defaults", "effect"], rows)


def members_of(cls: type) -> str:
    """Return the table of the public methods and attributes of `cls`, in their order, by their docstrings."""
    (node,) = ast.parse(inspect.getsource(cls)).body
    assert isinstance(node, ast.ClassDef)
    rows = []
    for one, after in zip(node.body, [*node.body[1:], ast.Pass()], strict=True):
        match one, after:
            case ast.FunctionDef(name=name), _:
                words = [argument.arg for argument in one.args.args[1:]]
                words += [f"*{one.args.vararg.arg}"] if one.args.vararg else []
                words += [f"{argument.arg}=" for argument in one.args.kwonlyargs]
                shown = (
                    name
                    if any("property" in ast.unparse(of) for of in one.decorator_list)
                    else f"{name}({', '.join(words)})"
                )
                text = ast.get_docstring(one) or ""
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                shown = name
            case _:
                continue
        if not name.startswith("_"):
            rows.append([f"`{shown}`", " ".join(text.split())])
    return _table(["name", "meaning"], rows)


def packages() -> str:
    """Return the table of the packages: what each is, by its docstring, and the names of its modules."""
    rows = []
    for package in ("protocol", "agent", "world", "compose", "tandem"):
        for path in sorted((DOCS.parent / package).rglob("__init__.py")):
            text = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
            modules = sorted(one.stem for one in path.parent.glob("*.py") if not one.stem.startswith("__"))
            names = ", ".join(f"`{one}`" for one in modules) or "-"
            rows.append([f"`{path.parent.relative_to(DOCS.parent)}`", text.splitlines()[0], names])
    return _table(["package", "content", "modules"], rows)


def printed(scenario: str) -> str:
    """Return the output of `tandem run SCENARIO`."""
    command = [sys.executable, "-m", "tandem", "run", scenario, "--in-process"]
    return (
        f"```text\n{subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()}\n```"
    )


TABLES: dict[str, Callable[[], str]] = {
    "results-summary": expected_tables.summary,
    "results-attacked-links": expected_tables.link_attacks,
    "results-run-noisy": partial(printed, "noisy"),
    "results-peers": peer_tables.short_table,
    "results-peers-tiers": partial(peer_tables.full_table, "TIERS"),
    "results-peers-lias": partial(peer_tables.full_table, "LIAS"),
    "results-peers-plaza": partial(peer_tables.full_table, "Plaza 1"),
    "results-peers-mrclam": partial(peer_tables.full_table, "MRCLAM 6"),
    "scenario": partial(fields_of, ScenarioFile),
    "mission": partial(fields_of, MissionTable),
    "planner": partial(fields_of, PlannerTable),
    "robot": partial(fields_of, RobotTable),
    "group": partial(fields_of, GroupTable),
    "anchor": partial(fields_of, AnchorTable),
    "team": partial(fields_of, TeamTable),
    "attack": partial(fields_of, Attack),
    "noise": partial(fields_of, Noise),
    "velocity-noise": partial(fields_of, VelocityNoise),
    "world": partial(fields_of, WorldTable),
    "world-noise": partial(fields_of, WorldNoise),
    "world-actuation-noise": partial(fields_of, WorldVelocityNoise),
    "world-odometry-noise": partial(fields_of, WorldOdometryNoise),
    "fault": partial(fields_of, FaultTable),
    "kill": partial(fields_of, KillTable),
    "clock": partial(fields_of, ClockTable),
    "sweep": partial(fields_of, SpecFile),
    "axis": partial(fields_of, AxisTable),
    "row": partial(fields_of, RowTable),
    "draw": partial(fields_of, DrawTable),
    "starts": partial(fields_of, StartsTable),
    "trial-columns": partial(columns_of, TrialRow),
    "group-columns": partial(columns_of, GroupColumns),
    "robot-columns": partial(columns_of, RobotRow),
    "summary-columns": partial(columns_of, CellSummary),
    "difference-columns": partial(columns_of, PairedDifference),
    "tick-columns": partial(columns_of, rows.TickRow),
    "truth-table": partial(columns_of, rows.TruthRow),
    "observation-table": partial(columns_of, rows.ObservationRow),
    "command-table": partial(columns_of, rows.CommandRow),
    "estimate-table": partial(columns_of, rows.EstimateRow),
    "message-table": partial(columns_of, rows.MessageRow),
    "claim-table": partial(columns_of, rows.ClaimRow),
    "meeting-table": partial(columns_of, MeetingResult),
    "odometry-columns": partial(fields_of, recording_rows.OdometryRow),
    "bag-fields": partial(fields_of, BagFile),
    "bag-topic-fields": partial(fields_of, TopicTable),
    "pose-columns": partial(fields_of, recording_rows.PoseRow),
    "range-columns": partial(fields_of, recording_rows.RangeRow),
    "anchor-columns": partial(fields_of, recording_rows.AnchorRow),
    "antenna-columns": partial(fields_of, recording_rows.AntennaRow),
    "truth-columns": partial(fields_of, recording_rows.TruePoseRow),
    "estimate-columns": partial(columns_of, PoseEstimateRow),
    "estimate-fields": partial(fields_of, EstimateSummary, defaults=False),
    "robot-estimate-fields": partial(fields_of, RobotEstimate, defaults=False),
    "estimate-pose-fields": partial(fields_of, PoseEstimate, defaults=False),
    "anchor-estimate-fields": partial(fields_of, EstimatedAnchor, defaults=False),
    "learned-fields": partial(fields_of, LearnedErrors, defaults=False),
    "final-report": partial(columns_of, messages.FinalReport),
    "claim-conditions": claim_conditions,
    "wire-version": wire_version,
    "wire-keys": wire_keys,
    "wire-messages": wire_messages,
    "wire-parts": wire_parts,
    "command-line": command_line,
    "audit-rules": audit_rules,
    "planner-methods": partial(members_of, Planner),
    "run-members": partial(members_of, Run),
    "range-models": partial(models, RANGE_MODELS),
    "radio-models": partial(models, RADIO_MODELS),
    "packages": packages,
    "removed": lambda: _table(
        ["removed", "instead"], [[f"`{one}`", instead] for one, instead in REMOVED.items()]
    ),
    **{f"results-{name}": partial(results_of, name) for name in spec.shipped()},
}
"""the tables by the names that pages use"""


def written(page: str) -> str:
    """Return the text of a page with its tables as the code has them.

    Raises ValueError if a table has no second marker line, and KeyError if its name is unknown.
    """
    if BEGIN.findall(page) != (names := [place["name"] for place in PLACE.finditer(page)]):
        raise ValueError(
            f"a table has no line `<!-- end of NAME -->`; those that have one: {', '.join(names)}"
        )
    return PLACE.sub(lambda place: f"{place['begin']}\n{_generated(place['name'])}\n\n{place['end']}", page)


@cache
def _generated(name: str) -> str:
    return TABLES[name]()


def main(arguments: Sequence[str] | None = None, docs: Path = DOCS) -> None:
    """Write the tables into the pages in `docs`, or compare them."""
    parser = argparse.ArgumentParser(description="Write the generated tables into the pages of docs.")
    parser.add_argument("--check", action="store_true", help="only compare; exit status 1 if they differ")
    options = parser.parse_args(arguments)
    stale = []
    readme = [DOCS.parent / "README.md"] if docs == DOCS else []
    for path in [*readme, *sorted(docs.glob("*.md"))]:
        before = path.read_text()
        try:
            after = written(before)
        except (KeyError, ValueError) as error:
            sys.exit(f"{path.name}: {error}")
        if after != before:
            stale.append(path.name)
            if not options.check:
                path.write_text(after)
    print(*stale, sep="\n", end="\n" if stale else "")
    sys.exit(1 if stale and options.check else 0)


if __name__ == "__main__":
    main()
